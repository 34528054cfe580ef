"""The methods that the paper names, and this station's, on recordings of the same gyros with the same noise and length.

Least squares, the two observations of the table rates, the covariance filter and this station take the 360 s script.
The two six-position methods need their own positions, and get scripts of the same 360 s.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from drivers.types import Floats
from estimator.estimation.calibrate import calibrate
from estimator.geometry.array import SensorArray, tetrahedron
from estimator.geometry.model import Prior
from estimator.observations.rows import Observations
from estimator.recordings.recording import Recording
from station.campaigns.campaigns import Failure, run_all
from station.errors import UsageError
from station.scripts.script import Move, Rest, Rotate, Script, paper_script
from station.studies.methods import (
    BaselineEstimate,
    augmented_observation,
    direct_observation,
    least_squares,
    six_position,
    table_rates,
    unseen_directions,
)
from station.studies.paper import MEMS_NOISE, SOURCE, our_recording, rows_of
from station.studies.paper_filter import covariance_filter, decoded
from station.studies.published import RATE_DPS, SAMPLE_HZ, TABLE_1, from_si

_DEG = math.pi / 180
_TOTAL_S = 360.0
_SETTLE_S = 0.5
"""Left out at each end of a position: table readings within a ramp are interpolated."""
_LEAST_SHARE = 5e-3  # of a state in a direction: smaller ones are not written

Method = Callable[[Recording], BaselineEstimate]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MethodSummary:
    """One method over all seeds: rms error, rms stated sigma and their ratio (4,), NaN where a state is not seen.

    ``seconds`` is the median processor time of an estimate.
    """

    name: str
    rms: Floats
    stated: Floats
    seconds: float
    operations_a_sample: float

    @property
    def ratio(self) -> Floats:
        """Rms error over stated sigma (4,): 1 where stated sigmas match the errors."""
        return self.rms / self.stated


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BaselineStudy:
    """All methods in the order of ``METHODS``, over ``seeds`` seeds.

    ``unseen`` are the combinations of states that the table rates alone do not show, in words. ``failures`` are the
    seeds that raised an error.
    """

    methods: tuple[MethodSummary, ...]
    unseen: tuple[str, ...]
    seeds: int
    failures: tuple[Failure, ...]

    def named(self, name: str) -> MethodSummary:
        """Return the method of a name."""
        return next(method for method in self.methods if method.name == name)


@dataclass(frozen=True, slots=True, eq=False)
class Timed:
    """An estimate and the processor time that it took."""

    estimate: BaselineEstimate
    seconds: float


def run_study(seeds: int, **where: Any) -> BaselineStudy:
    """Run every method on the seeds from 0 to below ``seeds``, and summarise each; seeds that fail are listed.

    ``where`` goes to ``run_all``: scheduler, workers, quiet. UsageError if every seed fails.
    """
    found, failures = run_all(one_seed, range(seeds), label="all methods", **where)
    outcomes = [outcome for outcome in found if outcome is not None]
    if not outcomes:
        raise UsageError(f"the study has no result: seed {failures[0].item}: {failures[0].reason}")
    methods = tuple(_summary(name, [o[number] for o in outcomes]) for number, (name, *_) in enumerate(METHODS))
    return BaselineStudy(
        methods=methods,
        unseen=tuple(direct_blind_spots(tetrahedron())),
        seeds=len(outcomes),
        failures=tuple(failures),
    )


def one_seed(seed: int) -> list[Timed]:
    """Simulate the three scripts once, and return what each method finds on its own of them and how long it takes.

    Results are in the order of ``METHODS``.
    """
    import filterpy.kalman  # noqa: F401  its 0.8 s of import are no part of the time of a filter

    recordings = {script.name: our_recording(MEMS_NOISE, seed, script) for script in _SCRIPTS}
    for recording in recordings.values():
        rows_of(recording)  # what the recording keeps of it would be counted for whichever method comes first
    return [_timed(method, recordings[script.name]) for _, script, method in METHODS]


def static_script() -> Script:
    """Return six positions at rest, each body axis up and down once, in 360 s: the Earth is the only input."""
    quarter = math.pi / 2
    stops = (("y", 1), ("y", 2), ("y", 3), ("y", 4), ("x", 1), ("x", 3))
    moves = [Move(axis, n * quarter, 20 * _DEG, 20 * _DEG, f"{axis} to {90 * n} deg") for axis, n in stops]
    moving_s = Script("moves", tuple(moves)).least_s
    rest = Rest((_TOTAL_S - moving_s) / len(moves))
    return Script("six-position-static", tuple(step for move in moves for step in (move, rest)))


def rotation_script() -> Script:
    """Return both directions about each axis at 20 deg/s, 60 s each, ramps of 6 s, each turning three whole turns."""
    rate_rps = RATE_DPS * _DEG
    turns = [
        Rotate(axis, sign * rate_rps, _TOTAL_S / 6, rate_rps / 6, f"{axis} at {sign * RATE_DPS:g} deg/s")
        for axis in "xyz"
        for sign in (1, -1)
    ]
    return Script("six-position-rotation", tuple(turns))


def static_six_position(recording: Recording) -> BaselineEstimate:
    """Six positions at rest, with Earth rate as the input: z up and down, x down and up, y up and down."""
    y90, y180, y270, y360, x90, x270 = _rows_during(recording, _standstills(static_script()))
    return six_position(((y360, y180), (y270, y90), (x90, x270)), recording.sources[SOURCE].array)


def rotating_six_position(recording: Recording) -> BaselineEstimate:
    """Steady rotation both ways about each axis."""
    steady = _rows_during(recording, _rotations(rotation_script()))
    return six_position([(steady[i], steady[i + 1]) for i in (0, 2, 4)], recording.sources[SOURCE].array)


def direct_blind_spots(array: SensorArray) -> list[str]:
    """Return the combinations of states that the three table rates do not show, in words.

    All states of a combination may change by their coefficient times one number, and the rates stay as they are.
    """
    directions = unseen_directions(array, table_rates(array))
    labels = ("biases", *(f"sensitivity of all gyros along body {axis}" for axis in "xyz"))
    return [f"{labels[i % 4]}: {_combination(direction)}" for i, direction in enumerate(directions)]


def _on_rows(method: Callable[[Floats, Floats, SensorArray], BaselineEstimate]) -> Method:
    return lambda recording: method(*rows_of(recording), recording.sources[SOURCE].array)


def _filter(recording: Recording) -> BaselineEstimate:
    data = recording.sources[SOURCE]
    noise_rps = MEMS_NOISE.arw * math.sqrt(SAMPLE_HZ)
    prior_sd = np.sqrt(Prior().variances())
    run = covariance_filter(*rows_of(recording), data.array, prior_sd, noise_rps, every=len(data.t_ns))
    return BaselineEstimate(*decoded(run.x[-1], run.covariance[-1]), run.operations)


def _ours(recording: Recording) -> BaselineEstimate:
    gyros = calibrate(recording, innovations=False).gyros
    n = len(gyros)
    samples = len(recording.sources[SOURCE].t_ns)
    # Output error 6n, sums of [w, z] over blocks and of their products; what follows works on blocks, not samples.
    operations = samples * (6 * n + (3 + n) + (3 + n) * (4 + n))
    return BaselineEstimate(np.array([g.states for g in gyros]), np.array([g.sd for g in gyros]), operations)


STATIC = "six positions, Earth rate as input"
ROTATION = "six positions, rotation both ways"
DIRECT = "table rates observed directly"
LEAST_SQUARES = "least squares"
FILTER = "covariance filter on each sample"
OURS = "this station"
_SCRIPTS = (static_script(), rotation_script(), paper_script())
METHODS: tuple[tuple[str, Script, Method], ...] = (
    (STATIC, _SCRIPTS[0], static_six_position),
    (ROTATION, _SCRIPTS[1], rotating_six_position),
    (DIRECT, _SCRIPTS[2], _on_rows(direct_observation)),
    ("the same, null space augmented", _SCRIPTS[2], _on_rows(augmented_observation)),
    (LEAST_SQUARES, _SCRIPTS[2], _on_rows(least_squares)),
    (FILTER, _SCRIPTS[2], _filter),
    (OURS, _SCRIPTS[2], _ours),
)
"""Name, script and estimator of each method, in the order shown."""


def _timed(method: Method, recording: Recording) -> Timed:
    begun_s = time.process_time()
    estimate = method(recording)
    return Timed(estimate, time.process_time() - begun_s)


def _summary(name: str, outcomes: Sequence[Timed]) -> MethodSummary:
    """Return the errors of a method over its outcomes: rms, sigmas that it states, median time, operations a sample.

    Errors are differences from the set values of the paper, in its units and order.
    """
    return MethodSummary(
        name=name,
        rms=_rms([from_si(outcome.estimate.states) - TABLE_1 for outcome in outcomes]),
        stated=_rms([from_si(outcome.estimate.sd) for outcome in outcomes]),
        seconds=float(np.median([outcome.seconds for outcome in outcomes])),
        operations_a_sample=outcomes[0].estimate.operations / (_TOTAL_S * SAMPLE_HZ),
    )


def _rms(values: Sequence[Floats]) -> Floats:
    """Return the root of the mean square (4,) over seeds and gyros."""
    return np.asarray(np.sqrt(np.mean(np.square(values), axis=(0, 1))))


def _standstills(script: Script) -> Iterator[tuple[float, float]]:
    """Yield when each step in which all axes stand begins and ends, in s."""
    for timed in script.timeline():
        if not timed.step.turns:
            yield timed.start_s, timed.start_s + timed.span.least_s


def _rotations(script: Script) -> Iterator[tuple[float, float]]:
    """Yield when the steady rate of each turn begins and ends, in s."""
    for timed in script.timeline():
        for start_s, turn in timed.turns():
            yield start_s + turn.ramp_s, start_s + turn.duration_s - turn.ramp_s


def _rows_during(recording: Recording, spans: Iterator[tuple[float, float]]) -> list[Observations]:
    """Return body rates and outputs within each of ``spans`` (begin and end in s), which are used up.

    The first and the last half second of each are left out.
    """
    w_rps, y_rps = rows_of(recording)
    t_s = np.arange(1, len(w_rps) + 1) / SAMPLE_HZ
    positions = []
    for start_s, end_s in spans:
        inside = (t_s > start_s + _SETTLE_S) & (t_s < end_s - _SETTLE_S)
        positions.append(Observations(w_rps[inside], y_rps[inside]))
    return positions


def _combination(direction: Floats) -> str:
    """Return a direction (n, 4) of x = [k, b, s_j, s_k] of n gyros as a sum, leaving out shares below 0.005."""
    terms = [
        f"{value:+.2f} {name}{gyro + 1}"
        for name, column in zip(("k", "b", "sigma_j", "sigma_k"), direction.T, strict=True)
        for gyro, value in enumerate(column)
        if abs(value) > _LEAST_SHARE
    ]
    return " ".join(terms)
