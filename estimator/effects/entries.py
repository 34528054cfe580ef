"""All that the station knows to be wrong with gyros and tables, as a person reads it.

Most are laws with regressors (``catalogue``). A random walk of the bias is no law but noise: it has a strength that is
estimated with the noise, and nothing to take off. Faults of the data are seen in the samples, which are left out.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from estimator.effects.catalogue import catalogue
from estimator.effects.dynamics import latency
from estimator.effects.effect import Effect, Parameter
from estimator.effects.scale import dead_band


class Kind(StrEnum):
    """How an effect is dealt with."""

    LAW = "law"
    NOISE = "noise"
    SAMPLES = "fault of the data"


@dataclass(frozen=True, slots=True)
class Entry:
    """One effect: its linear parameters with their largest plausible sizes; ``free``: what is not linear, its unit."""

    name: str
    kind: Kind
    parameters: tuple[Parameter, ...]
    free: tuple[tuple[str, str], ...]
    shared: bool
    shown_by: str
    confused_with: tuple[str, ...]
    needs: frozenset[str] = frozenset()


_FREE = {
    "warm_up": (("time constant", "s"),),
    "bias_step": (("instant", "s"),),
    "tone": (("frequency", "Hz"),),
    "dead_band": (("width", "rad/s"),),
}
_NOMINAL_S = 360.0


def entries(gimbals: Sequence[str] = ("z", "y", "x")) -> tuple[Entry, ...]:
    """Return every effect that is looked for on a table with these gimbals."""
    laws = [*catalogue(gimbals, _NOMINAL_S), dead_band(float(np.radians(0.1)))]
    hold = latency()
    noise = Entry(
        "bias_walk",
        Kind.NOISE,
        (Parameter("rate random walk", "rad/s/rts", float(np.radians(100 / 3600 / 60))),),
        (),
        False,
        "long rests",
        ("bias_drift", "warm_up"),
    )
    samples = [
        Entry(
            "sample_hold",
            Kind.SAMPLES,
            hold.parameters,
            (("samples held", "1"),),
            True,
            "samples that repeat in a rhythm, and ramps",
            ("latency",),
        ),
        Entry("saturation", Kind.SAMPLES, (), (("limit", "rad/s"),), False, "rates beyond the range", ("scale_cubic",)),
        Entry("stuck", Kind.SAMPLES, (), (("from", "s"), ("until", "s")), False, "any motion", ("dead_band",)),
    ]
    return (*(_law(effect) for effect in laws), noise, *samples)


def _law(effect: Effect) -> Entry:
    free = _FREE.get(effect.name, ())
    # Names of parameters state the nominal value of what is free.
    sizes = tuple(replace(p, name=p.name.split(" at ")[0] if " at " in p.name else "size") for p in effect.parameters)
    return Entry(
        effect.name.split(":")[0],
        Kind.LAW,
        sizes if free else effect.parameters,
        free,
        effect.shared,
        effect.shown_by,
        effect.confused_with,
        effect.needs,
    )
