"""An investigation for display: by the terminal, the screen and reports to people, by --json to machines.

SI units, shares between 0 and 1, None for what is not known.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from drivers.types import Floats
from estimator.effects.catalogue import records
from estimator.effects.constructed import readable
from estimator.tracing.investigation import (
    Finding,
    GyroErrors,
    Investigation,
    ResidualView as ResidualCourse,
)
from estimator.tracing.residuals.residual import GyroResidual, Residual
from station.views.json_values import by_state, json_object, named
from station.views.typed_json import view_of

_NUMBERS = ("nis", "nis_sd", "lag1", "lag1_sd", "white_p", "beyond")
_MOST_SUSPECTS = 3
_SPECTRUM = ("frequency_hz", "density", "noise")


@dataclass(kw_only=True, frozen=True, slots=True)
class ErrorsView:
    """Error of the compensated rate: rms and largest in rad/s, and the share of its 95 % intervals that hold."""

    rms_rps: float | None
    max_rps: float | None
    coverage95: float | None


@dataclass(kw_only=True, frozen=True, slots=True)
class OutOfSampleView:
    """By how much (natural logarithm) an effect makes left out recordings, and steps, more probable."""

    by_run: float | None
    by_step: float | None


@dataclass(kw_only=True, frozen=True, slots=True)
class AddedView:
    """An effect with its gyros, probability and parameters, see ``Added``.

    ``parameters`` are by name (value, standard deviation, unit).
    """

    effect: str
    gyros: tuple[str, ...]
    probability: float | None
    parameters: Mapping[str, tuple[float | None, float | None, str]]
    out_of_sample: OutOfSampleView | None
    same: tuple[str, ...]
    constructed: bool
    expression: str


@dataclass(kw_only=True, frozen=True, slots=True)
class UnexplainedView:
    """Structure of the residual that no effect explains: what it depends on, and its share of the residual."""

    depends_on: str
    share: float | None


@dataclass(kw_only=True, frozen=True, slots=True)
class ImprovementView:
    """Ratio of the error before to that after, and its 95 % interval; None for what is infinite."""

    ratio: float | None
    low: float | None
    high: float | None


@dataclass(kw_only=True, frozen=True, slots=True)
class ModelView:
    """One model of the chain: its effects, log evidence over that of the first, and its errors."""

    effects: tuple[str, ...]
    log_evidence: float | None
    rms_rps: float | None
    max_rps: float | None
    coverage95: float | None


@dataclass(kw_only=True, frozen=True, slots=True)
class PhaseView:
    """Mean error of one gyro over a rest, ramp or steady rate of a run, see ``PhaseErrors``."""

    run: str
    start_s: float | None
    end_s: float | None
    rate_dps: float | None
    kind: str
    before_rps: float | None
    after_rps: float | None
    noise_rps: float | None


@dataclass(kw_only=True, frozen=True, slots=True)
class GyroView:
    """Errors and states of one gyro before and after; ``moved_sigmas`` is the change in old sigmas.

    States are by name.
    """

    before: ErrorsView
    after: ErrorsView
    states_before: Mapping[str, float | None]
    states_after: Mapping[str, float | None]
    sd_before: Mapping[str, float | None]
    sd_after: Mapping[str, float | None]
    moved_sigmas: Mapping[str, float | None]
    phases: tuple[PhaseView, ...]


@dataclass(kw_only=True, frozen=True, slots=True)
class SuspectView:
    """An effect that was tried, and the probability that the first model lacks it most."""

    effect: str
    log_evidence: float | None
    probability: float | None


@dataclass(kw_only=True, frozen=True, slots=True)
class SpectrumView:
    """Densities (rad/s)^2/Hz of a residual and of its noise at some frequencies."""

    frequency_hz: tuple[float | None, ...]
    density: tuple[float | None, ...]
    noise: tuple[float | None, ...]


@dataclass(kw_only=True, frozen=True, slots=True)
class DependenceView:
    """Share of a residual's power beyond the noise that depends on a variable, and how probable that is by chance."""

    share: float | None
    p_value: float | None


@dataclass(kw_only=True, frozen=True, slots=True)
class GyroResidualView:
    """The residual of one gyro, see ``GyroResidual``; ``depends_on`` is by variable."""

    nis: float | None
    nis_sd: float | None
    lag1: float | None
    lag1_sd: float | None
    white_p: float | None
    beyond: float | None
    spectrum: SpectrumView
    depends_on: Mapping[str, DependenceView]


@dataclass(kw_only=True, frozen=True, slots=True)
class SplitView:
    """The part of a residual that gyros have in common, and their own part, see ``Split``."""

    origin: str
    common: float | None
    own: float | None
    own_share: float | None
    spare: int


@dataclass(kw_only=True, frozen=True, slots=True)
class ResidualView:
    """The remaining output errors by gyro, and whether gyros have them in common.

    ``split`` is None where that is not known, with the reason in ``no_split``.
    """

    gyros: Mapping[str, GyroResidualView]
    split: SplitView | None
    no_split: str | None


@dataclass(kw_only=True, frozen=True, slots=True)
class ResidualPair:
    """Residuals of the same recordings, under the models before and after."""

    before: ResidualView
    after: ResidualView


@dataclass(kw_only=True, frozen=True, slots=True)
class ResidualsView:
    """Residuals of the fitted recordings before and after, and those of the verification run if there is one."""

    before: ResidualView
    after: ResidualView
    verification: ResidualPair | None


@dataclass(kw_only=True, frozen=True, slots=True)
class InvestigationView:
    """The result as --json prints it, with the same names in the same order.

    ``rival_sizes`` are the effects that cannot be told apart, each as if it alone were there. ``record_next`` says what
    a recording must hold to show the candidates.
    """

    verdict: str
    reason: str
    added: tuple[AddedView, ...]
    rivals: tuple[tuple[str, ...], ...]
    unexplained: UnexplainedView | None
    before: ErrorsView
    after: ErrorsView
    improvement: ImprovementView | None
    in_sample: bool
    next_script: str | None
    models: tuple[ModelView, ...]
    gyros: Mapping[str, GyroView]
    suspects: tuple[SuspectView, ...]
    residual: ResidualsView | None
    left_out: Mapping[str, str]
    taken_back: tuple[str, ...]
    notes: tuple[str, ...]
    rival_sizes: tuple[AddedView, ...] = ()
    record_next: tuple[str, ...] = ()
    recordings: tuple[str, ...]
    verification: tuple[str, ...]


def investigation_view(
    investigation: Investigation,
    next_script: Path | None,
    recordings: Sequence[str] = (),
    verification: Sequence[str] = (),
) -> InvestigationView:
    """Return the view of an investigation of ``recordings``, judged by those in ``verification``.

    Both are names of files. ``next_script`` is the file of the script to run next, None without one. The residual is
    None unless it was analysed before and after; numbers that are not finite are None.
    """
    models = [
        {"effects": m.effects, "log_evidence": m.log_evidence, **json_object(m.errors)} for m in investigation.models
    ]
    fitted = _both(investigation.residual_before, investigation.residual_after)
    whole = {
        "verdict": str(investigation.finding),
        "reason": investigation.reason,
        **named(investigation, ("added", "rivals", "unexplained", "before", "after", "improvement", "in_sample")),
        "next_script": None if next_script is None else str(next_script),
        "models": models,
        "gyros": {gyro.name: _gyro(gyro) for gyro in investigation.gyros},
        "suspects": investigation.suspects,
        "residual": fitted
        and {**fitted, "verification": _both(investigation.verified_before, investigation.verified_after)},
        **named(investigation, ("left_out", "taken_back", "notes", "rival_sizes")),
        "record_next": what_shows(investigation),
        "recordings": recordings,
        "verification": verification,
    }
    return investigation_of(json_object(whole))


def investigation_of(answer: Mapping[str, Any]) -> InvestigationView:
    """Return the view in an object of JSON that ``investigation_object`` made.

    KeyError or TypeError if it is none, or one of another version of the station.
    """
    return view_of(InvestigationView, answer)


def investigation_object(view: InvestigationView) -> dict[str, Any]:
    """Return the view for --json."""
    whole: dict[str, Any] = json_object(view)
    return whole


def what_shows(investigation: Investigation) -> list[str]:
    """Return, for each candidate that the data could not separate, "effect: what a recording must hold to show it".

    Without rivals the candidates are the first three suspects. Those of which the catalogue does not say it are left
    out. Empty if nothing was found or the effects were added.
    """
    if investigation.finding in (Finding.NOTHING, Finding.ADDED):
        return []
    known = {record.name: record for record in records()}
    names = [name for own in investigation.rivals for name in own]
    if not names:
        names = [suspect.effect for suspect in investigation.suspects[:_MOST_SUSPECTS]]
    motions = [f"{readable(name)}: {known[name].shown_by}" for name in dict.fromkeys(names) if name in known]
    return [line for line in motions if not line.endswith(": ")]


def _gyro(gyro: GyroErrors) -> dict[str, Any]:
    states = {key: by_state(getattr(gyro, key)) for key in ("states_before", "states_after", "sd_before", "sd_after")}
    moved = {"moved_sigmas": by_state(gyro.moved)}
    return {"before": gyro.before, "after": gyro.after, **states, **moved, "phases": gyro.phases}


def _both(before: Residual | None, after: Residual | None) -> dict[str, Any] | None:
    if before is None or after is None:
        return None
    return {"before": _residual(before), "after": _residual(after)}


def _residual(residual: Residual) -> dict[str, Any]:
    gyros = {gyro.name: _gyro_residual(gyro) for gyro in residual.gyros}
    return {"gyros": gyros, "split": residual.split, "no_split": residual.no_split or None}


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
    """Return by gyro the spectra of its residual under the models before and after; empty if either was not analysed.

    The noise is that of the model before.
    """
    if before is None or after is None:
        return {}
    pairs = zip(before.gyros, after.gyros, strict=True)
    return {
        old.name: Spectra(old.spectrum.frequency_hz, old.spectrum.density, new.spectrum.density, old.spectrum.noise)
        for old, new in pairs
    }


def judged_spectra(investigation: Investigation) -> dict[str, Spectra]:
    """Return the spectra of the run that verifies, without one of the recordings that were fitted."""
    verified = spectra_of(investigation.verified_before, investigation.verified_after)
    return verified or spectra_of(investigation.residual_before, investigation.residual_after)


def judged_views(views: Iterable[ResidualCourse]) -> list[ResidualCourse]:
    """Return the views that judge, of one run: the verification run, without one the first recording."""
    known = list(views)
    judging = [view for view in known if view.verification] or known
    return [view for view in judging if view.run == judging[0].run]
