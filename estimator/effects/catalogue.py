"""The catalogue: every effect that is searched for, stored or undone, by its name."""

from collections.abc import Sequence
from dataclasses import replace

from estimator.effects import disturbances, drift, dynamics, scale, site, table, thermal
from estimator.effects.constructed import CONSTRUCTED
from estimator.effects.effect import Effect, EffectError, Kind, Record

_FAMILIES = (site, thermal, drift, scale, dynamics, table, disturbances)
_BUILT_IN = {r.name: r for r in (*(record for family in _FAMILIES for record in family.RECORDS), CONSTRUCTED)}
_BY_NAME = dict(_BUILT_IN)


def records() -> tuple[Record, ...]:
    """Return every effect that is known: built-in ones by family, then those registered, in that order."""
    return tuple(_BY_NAME.values())


def record_of(name: str) -> Record | None:
    """Return the effect of a name; None if it is not known."""
    return _BY_NAME.get(name)


def register(*effects: Record, origin: str = "") -> None:
    """Add effects to the catalogue, replacing others of the same name that came from outside.

    ``origin`` is the file or package. EffectError for an invalid record, or one with the name of a built-in effect;
    the effects before it have then been added.
    """
    for record in effects:
        record.check()
        if record.name in _BUILT_IN:
            raise EffectError(f"there is an effect {record.name} already: give yours another name")
        _BY_NAME[record.name] = replace(record, origin=origin)


def everything(gimbals: Sequence[str] = ("z", "y", "x"), duration_s: float = 360.0) -> tuple[Effect, ...]:
    """Return the effects searched for on a table with these gimbals, for a run's duration: planned ones first."""
    ordered = sorted(records(), key=lambda record: not _planned(record))
    return tuple(record.effect(gimbals, **settings) for record in ordered for settings in record.listed(duration_s))


def catalogue(gimbals: Sequence[str], duration_s: float) -> tuple[Effect, ...]:
    """Return the effects whose smallest visible sizes a plan gives: neither noise nor faults of the data."""
    return tuple(effect for effect in everything(gimbals, duration_s) if _planned(effect.record))


def _planned(record: Record) -> bool:
    return record.kind is Kind.LAW and record.planned
