"""The results of an investigation: values, without the way they were found."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from estimator.types import Floats

if TYPE_CHECKING:
    from estimator.tracing.augmented import Augmented
    from estimator.tracing.residuals.residual import Residual


class Finding(StrEnum):
    """The possible results of an investigation."""

    NOTHING = "nothing to add"
    ADDED = "added"
    PARTLY = "added in part"
    CANNOT_TELL = "cannot tell"
    UNEXPLAINED = "unexplained"


class Value(NamedTuple):
    """One number of an effect in SI units: value, standard deviation, unit."""

    value: float
    sd: float
    unit: str


@dataclass(kw_only=True, frozen=True, slots=True)
class Added:
    """An effect added to the model: its gyros, probability and parameters.

    Parameters of an effect that each gyro has to itself are named "gyro1 linear", those that all share "delay".
    ``out_of_sample`` is what recordings and steps left out of the fit say of it; None for tones and for faults of the
    data, which the samples themselves show. ``same`` are effects that could give the same outputs in these recordings,
    but are much less expected. ``constructed``: the effect is a composed law, which ``expression`` holds.
    """

    effect: str
    gyros: tuple[str, ...]
    probability: float
    parameters: Mapping[str, Value]
    out_of_sample: "OutOfSample | None" = None
    same: tuple[str, ...] = ()
    constructed: bool = False
    expression: str = ""


@dataclass(frozen=True, slots=True)
class OutOfSample:
    """By how much (natural logarithm) an effect makes data left out of the fit more probable: whole recordings, and
    steps.

    ``by_run`` is None if there is one recording only.
    """

    by_run: float | None
    by_step: float

    @property
    def least(self) -> float:
        """The smaller of both."""
        return self.by_step if self.by_run is None else min(self.by_run, self.by_step)


COMMON_CAUSE = "a cause that acts on all gyros"
"""What the unexplained part depends on if the gyros share it and it depends on no measured variable."""


@dataclass(frozen=True, slots=True)
class Unexplained:
    """Structure of the residual that no effect explains: what it depends on, and the share of the residual that does.

    With ``COMMON_CAUSE`` the share is that of the slow residual.
    """

    depends_on: str
    share: float


@dataclass(frozen=True, slots=True)
class Errors:
    """Error of the compensated rate: rms and largest in rad/s, and the share (0 to 1) of its 95 % intervals that hold.

    The share is over the rests, ramps and steady rates in which the models before and after differ.
    """

    rms_rps: float
    max_rps: float
    coverage95: float


@dataclass(kw_only=True, frozen=True, slots=True)
class PhaseErrors:
    """Mean error of one gyro over a rest, ramp or steady rate of a run, in rad/s: before, after, and its noise."""

    run: str
    start_s: float
    end_s: float
    rate_dps: float
    kind: str
    before_rps: float
    after_rps: float
    noise_rps: float


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class GyroErrors:
    """The errors and states of one gyro before and after.

    ``states_before`` and ``states_after`` (4,) have standard deviations ``sd_before`` and ``sd_after``; ``moved`` (4,)
    is the change in old sigmas.
    """

    name: str
    before: Errors
    after: Errors
    phases: tuple[PhaseErrors, ...]
    states_before: Floats
    states_after: Floats
    moved: Floats
    sd_before: Floats = field(default_factory=lambda: np.full(4, np.nan))
    sd_after: Floats = field(default_factory=lambda: np.full(4, np.nan))


@dataclass(frozen=True, slots=True)
class Improvement:
    """Ratio of the error before to that after, and its 95 % interval."""

    ratio: float
    low: float
    high: float


@dataclass(frozen=True, slots=True, eq=False)
class ModelStep:
    """One model of the chain: its effects, log evidence over that of the first, and its errors where they were
    judged.
    """

    effects: tuple[str, ...]
    log_evidence: float
    errors: Errors


@dataclass(frozen=True, slots=True, eq=False)
class Suspect:
    """An effect that was tried: probability that the first model lacks it most, and why it was left out."""

    effect: str
    log_evidence: float
    probability: float


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class ResidualView:
    """The data for pictures of one gyro: residual before and after over time, all of one run.

    ``t_s``, ``rate_rps``, ``temperature_c``, ``before_rps``, ``after_rps`` are (b,) block means; ``noise_rps`` is the
    white noise of one.
    """

    run: str
    gyro: str
    verification: bool
    t_s: Floats
    rate_rps: Floats
    temperature_c: Floats | None
    before_rps: Floats
    after_rps: Floats
    noise_rps: float


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class Investigation:
    """The results of an investigation. ``in_sample``: no verification run was given.

    ``rivals`` are sets of effects that these recordings cannot tell apart, ``rival_sizes`` their numbers, each as if it
    alone were there beside what was added. ``models`` is the chain from the first model to the last, ``model`` the last
    one itself. ``left_out`` are effects that could not be tried, with the reason. ``taken_back`` are effects that the
    recordings support but that did not lower the error on the verification run. ``residual_before`` and
    ``residual_after`` are those of the fitted recordings, ``verified_before`` and ``verified_after`` those of the
    verification run.
    """

    finding: Finding
    reason: str
    added: tuple[Added, ...]
    rivals: tuple[tuple[str, ...], ...]
    unexplained: Unexplained | None
    before: Errors
    after: Errors
    improvement: Improvement | None
    in_sample: bool
    gyros: tuple[GyroErrors, ...]
    models: tuple[ModelStep, ...]
    suspects: tuple[Suspect, ...]
    left_out: Mapping[str, str]
    notes: tuple[str, ...]
    taken_back: tuple[str, ...] = ()
    views: tuple[ResidualView, ...] = field(default=(), repr=False)
    model: "Augmented | None" = field(default=None, repr=False)
    residual_before: "Residual | None" = field(default=None, repr=False)
    residual_after: "Residual | None" = field(default=None, repr=False)
    verified_before: "Residual | None" = field(default=None, repr=False)
    verified_after: "Residual | None" = field(default=None, repr=False)
    rival_sizes: tuple[Added, ...] = ()
