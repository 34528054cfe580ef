"""Effects that are built from a law where the catalogue has none: records made at run time."""

from collections.abc import Sequence
from dataclasses import replace

from estimator.effects.effect import Effect, Parameter, Record, Setting, Settings
from estimator.effects.law import in_words, parsed

_LONG = 60  # characters


def _of_terms(gimbals: Sequence[str], settings: Settings) -> tuple[Parameter, ...]:
    """Return a parameter for each term of a law, named after it; a single term that is long is "the law"."""
    terms = [term.strip() for term in str(settings["law"]).split(";")]
    if len(terms) == 1 and len(terms[0]) > _LONG:
        terms = ["the law"]
    return tuple(Parameter(f"of {term}", "rad/s per unit", 1.0) for term in terms)


def _checked(key: str, law: object) -> str:
    parsed(str(law))
    return str(law)


CONSTRUCTED = Record(
    name="constructed",
    label="constructed: {law}",
    parameters=_of_terms,
    law="{law}",
    settings=(Setting("law", "", "", read=_checked),),
    listed=lambda duration_s: (),
    not_live="needs all that went before",
)
"""A law without a name, a gyro its own."""


def constructed(law: str, largest: tuple[float, ...] = ()) -> Effect:
    """Return the effect of a law, separate for each gyro.

    ``largest`` are the largest plausible sizes of its coefficients, one for each term (else ValueError), by default 1.
    LawError for a text that is not a law.
    """
    effect = CONSTRUCTED.effect(law=_checked("law", law))
    sizes = largest or (1.0,) * len(effect.parameters)
    sized = zip(effect.parameters, sizes, strict=True)
    return replace(effect, parameters=tuple(replace(parameter, largest=size) for parameter, size in sized))


def readable(called: str) -> str:
    """Return the readable name of an effect, or of a law in a model."""
    kind, _, law = called.partition(" ")
    return f"{kind}: {in_words(law)}" if kind == CONSTRUCTED.name and law else called.replace("_", " ")
