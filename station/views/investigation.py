"""An investigation for display: by the terminal, the screen and reports to people, by --json to machines.

SI units, shares between 0 and 1, None for what is not known.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NotRequired, TypedDict, cast

from drivers.types import Floats
from estimator.effects.catalogue import records
from estimator.effects.constructed import readable
from estimator.tracing.investigation import (
    Added,
    Finding,
    GyroErrors,
    Investigation,
    ResidualView as ResidualCourse,
)
from estimator.tracing.residuals.residual import GyroResidual, Residual
from station.views.json_values import by_state, json_object, named

_NUMBERS = ("nis", "nis_sd", "lag1", "lag1_sd", "white_p", "beyond")
_MOST_SUSPECTS = 3
_SPECTRUM = ("frequency_hz", "density", "noise")


class ErrorsView(TypedDict):
    """Error of the compensated rate: rms and largest in rad/s, and the share of its 95 % intervals that hold."""

    rms_rps: float | None
    max_rps: float | None
    coverage95: float | None


class ResidualView(TypedDict):
    """The remaining output errors: by gyro its NIS and what it depends on; to what they belong (``split``)."""

    gyros: dict[str, dict[str, Any]]
    split: dict[str, Any] | None
    no_split: str | None


class InvestigationView(TypedDict):
    """The result as --json prints it. ``parameters`` of added effects are (value, standard deviation, unit).

    ``residual`` has "before" and "after" for the fitted recordings and, or None, both for the "verification" run.
    """

    verdict: str
    reason: str
    added: list[dict[str, Any]]
    rivals: list[list[str]]
    unexplained: dict[str, Any] | None
    before: ErrorsView
    after: ErrorsView
    improvement: dict[str, float | None] | None
    in_sample: bool
    next_script: str | None
    models: list[dict[str, Any]]
    gyros: dict[str, dict[str, Any]]
    suspects: list[dict[str, Any]]
    residual: dict[str, Any] | None
    left_out: dict[str, str]
    taken_back: list[str]
    notes: list[str]
    rival_sizes: NotRequired[list[dict[str, Any]]]
    record_next: NotRequired[list[str]]
    recordings: list[str]
    verification: list[str]


def investigation_view(
    found: Investigation, next_script: Path | None, recordings: Sequence[str] = (), verification: Sequence[str] = ()
) -> InvestigationView:
    """Return the view of an investigation of ``recordings``, judged by those in ``verification``."""
    models = [{"effects": m.effects, "log_evidence": m.log_evidence, **asdict(m.errors)} for m in found.models]
    fitted = _both(found.residual_before, found.residual_after)
    whole = {
        "verdict": str(found.finding),
        "reason": found.reason,
        **named(found, ("added", "rivals", "unexplained", "before", "after", "improvement", "in_sample")),
        "next_script": None if next_script is None else str(next_script),
        "models": models,
        "gyros": {gyro.name: _gyro(gyro) for gyro in found.gyros},
        "suspects": found.suspects,
        "residual": fitted and {**fitted, "verification": _both(found.verified_before, found.verified_after)},
        **named(found, ("left_out", "taken_back", "notes", "rival_sizes")),
        "record_next": what_shows(found),
        "recordings": recordings,
        "verification": verification,
    }
    return cast(InvestigationView, json_object(whole))


def what_shows(found: Investigation) -> list[str]:
    """Return, for each candidate that the data could not separate, "effect: what a recording must hold to show it".

    Empty if nothing was found or the effects were added.
    """
    if found.finding in (Finding.NOTHING, Finding.ADDED):
        return []
    known = {record.name: record for record in records()}
    names = [name for own in found.rivals for name in own]
    if not names:
        names = [suspect.effect for suspect in found.suspects[:_MOST_SUSPECTS]]
    motions = [f"{readable(name)}: {known[name].shown_by}" for name in dict.fromkeys(names) if name in known]
    return [line for line in motions if not line.endswith(": ")]


def is_investigation(found: Mapping[str, Any]) -> bool:
    """Return whether an object of JSON is an investigation of this version, with a verdict."""
    return InvestigationView.__required_keys__ <= found.keys() and all(
        set(Added.__dataclass_fields__) <= added.keys() for added in found["added"]
    )


def _gyro(gyro: GyroErrors) -> dict[str, Any]:
    states = {key: by_state(getattr(gyro, key)) for key in ("states_before", "states_after", "sd_before", "sd_after")}
    moved = {"moved_sigmas": by_state(gyro.moved)}
    return {"before": gyro.before, "after": gyro.after, **states, **moved, "phases": gyro.phases}


def _both(before: Residual | None, after: Residual | None) -> dict[str, Any] | None:
    return None if before is None or after is None else {"before": residual_view(before), "after": residual_view(after)}


def residual_view(residual: Residual) -> ResidualView:
    """Return the displayed values of a residual."""
    split = None if residual.split is None else asdict(residual.split)
    gyros = {gyro.name: _gyro_residual(gyro) for gyro in residual.gyros}
    return {"gyros": gyros, "split": split, "no_split": residual.no_split or None}


def _gyro_residual(gyro: GyroResidual) -> dict[str, Any]:
    depends_on = {d.variable: {"share": d.share, "p_value": d.p_value} for d in gyro.dependences}
    return {**named(gyro, _NUMBERS), "spectrum": named(gyro.spectrum, _SPECTRUM), "depends_on": depends_on}


@dataclass(frozen=True, slots=True, eq=False)
class Spectra:
    """One-sided densities (f,) of a gyro's residual before and after, and of its noise, (rad/s)^2/Hz."""

    frequency_hz: Floats
    before: Floats
    after: Floats
    noise: Floats


def spectra_of(before: Residual | None, after: Residual | None) -> dict[str, Spectra]:
    """Return the spectra by gyro; empty if a residual was not analysed."""
    if before is None or after is None:
        return {}
    pairs = zip(before.gyros, after.gyros, strict=True)
    return {
        old.name: Spectra(old.spectrum.frequency_hz, old.spectrum.density, new.spectrum.density, old.spectrum.noise)
        for old, new in pairs
    }


def judged_spectra(found: Investigation) -> dict[str, Spectra]:
    """Return the spectra of the run that verifies, without one of the recordings that were fitted."""
    verified = spectra_of(found.verified_before, found.verified_after)
    return verified or spectra_of(found.residual_before, found.residual_after)


def judged_views(views: Iterable[ResidualCourse]) -> list[ResidualCourse]:
    """Return the views that judge, of one run: the verification run, without one the first recording."""
    known = list(views)
    judging = [view for view in known if view.verification] or known
    return [view for view in judging if view.run == judging[0].run]
