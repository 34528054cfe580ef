"""The catalogue of effects for display, SI units."""

from dataclasses import dataclass

from estimator.effects.effect import Effect, Kind


@dataclass(kw_only=True, frozen=True, slots=True)
class ParameterView:
    """One parameter of an effect, with its unit and its largest plausible size."""

    name: str
    unit: str
    largest: float


@dataclass(kw_only=True, frozen=True, slots=True)
class SettingView:
    """A constant of an effect that is found from the data, with its unit."""

    name: str
    unit: str


@dataclass(kw_only=True, frozen=True, slots=True)
class EffectView:
    """An effect: its kind, parameters, what shows it, effects that look like it, and quantities that it needs.

    ``non_linear`` are its constants that are found from the data.
    """

    effect: str
    kind: str
    parameters: tuple[ParameterView, ...]
    non_linear: tuple[SettingView, ...]
    shared: bool
    shown_by: str
    confused_with: tuple[str, ...]
    needs: tuple[str, ...]


def effect_view(effect: Effect) -> EffectView:
    """Return the view of an effect; of a law with constants to search for, names of parameters leave them out."""
    record = effect.record
    searched = tuple(SettingView(name=s.name, unit=s.unit) for s in record.settings if s.name)
    names = [parameter.name for parameter in effect.parameters]
    if record.kind is Kind.LAW and searched:
        names = [_without_constant(name) for name in names]
    parameters = zip(effect.parameters, names, strict=True)
    return EffectView(
        effect=effect.name,
        kind=str(record.kind),
        parameters=tuple(ParameterView(name=name, unit=p.unit, largest=p.largest) for p, name in parameters),
        non_linear=searched,
        shared=effect.shared,
        shown_by=record.shown_by,
        confused_with=tuple(effect.confused_with),
        needs=tuple(sorted(effect.needs)),
    )


def _without_constant(name: str) -> str:
    """Return the name of a parameter without its constant, such as "cosine" for "cosine at 2 Hz"."""
    before, at, _ = name.partition(" at ")
    return before if at else "size"
