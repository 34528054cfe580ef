"""What an investigation ends with: values, without the way they were found."""

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
    """How an investigation ends."""

    NOTHING = "nothing to add"
    ADDED = "added"
    PARTLY = "added in part"
    CANNOT_TELL = "cannot tell"
    UNEXPLAINED = "unexplained"


class Value(NamedTuple):
    """One number of an effect in SI units, its standard deviation, its unit."""

    value: float
    sd: float
    unit: str


@dataclass(kw_only=True, frozen=True, slots=True)
class Added:
    """An effect that was added: which gyros show it, how probable it is, its parameters.

    Parameters of an effect that each gyro has to itself are named "gyro1 linear", those that all share "delay".
    ``out_of_sample`` is what recordings and steps say of it that were left out of the fit; None for tones and for
    faults of the data, which are seen in the samples themselves. ``same`` are effects that could put out the same
    in these recordings, but are much less expected.
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
    """By how much an effect makes what was left out more probable (natural logarithm): whole recordings, and steps.

    ``by_run`` is None where there is one recording only.
    """

    by_run: float | None
    by_step: float

    @property
    def least(self) -> float:
        """The smaller of both."""
        return self.by_step if self.by_run is None else min(self.by_run, self.by_step)


@dataclass(frozen=True, slots=True)
class Unexplained:
    """Structure of the residual that no effect explains: what it depends on, and the share of it that does."""

    depends_on: str
    share: float


@dataclass(frozen=True, slots=True)
class Errors:
    """Error of the compensated rate: rms and largest (rad/s), share of its 95 % intervals that hold (0 to 1).

    The share is over the rests, ramps and steady rates in which the models before and after say different things.
    """

    rms_rps: float
    max_rps: float
    coverage95: float


@dataclass(kw_only=True, frozen=True, slots=True)
class PhaseErrors:
    """Mean error of one gyro over a rest, a ramp or a steady rate of a run: before, after, its noise; rad/s."""

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
    """One gyro before and after.

    ``states_before`` and ``states_after`` (4,) have standard deviations ``sd_before`` and ``sd_after``; ``moved`` (4,):
    by how many of their old sigmas the states moved.
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
    """Error before over error after, and its 95 % interval."""

    ratio: float
    low: float
    high: float


@dataclass(frozen=True, slots=True, eq=False)
class ModelStep:
    """One model of the chain: its effects, its log evidence beside the first model's, its errors where judged."""

    effects: tuple[str, ...]
    log_evidence: float
    errors: Errors


@dataclass(frozen=True, slots=True, eq=False)
class Suspect:
    """An effect that was tried: probability that it is what the first model lacks most, and why it was left out."""

    effect: str
    log_evidence: float
    probability: float


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class ResidualView:
    """What pictures of one gyro need: residual before and after over time, all of one run.

    ``t_s``, ``rate_rps``, ``temperature_c``, ``before_rps``, ``after_rps`` are (b,) block means, ``noise_rps`` the
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
    """Everything that an investigation says. ``in_sample``: no verification run was given.

    ``rivals``: sets of effects that these recordings cannot tell apart; ``rival_sizes``: each of these with its
    numbers, if it alone were there beside what was added. ``models``: the chain from the first model to the last;
    ``model`` is the last itself. ``left_out``: effects that could not be tried, with the reason.
    ``taken_back``: effects that the recordings spoke for and that did not lower the error on the verification run.
    ``residual_before`` and ``residual_after`` are those of the recordings that were fitted, ``verified_before`` and
    ``verified_after`` those of the verification run.
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
