"""The methods that the paper names, and ours, on recordings of the same gyros with the same noise and length.

Least squares, the two observations of the table rates, the covariance filter and ours take the 360 s script. The two
six-position methods need their own positions, and get scripts of the same 360 s.
"""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from drivers.types import Floats
from estimator.estimation import baselines
from estimator.estimation.calibrate import calibrate
from estimator.geometry.array import SensorArray, tetrahedron
from estimator.geometry.model import Prior
from estimator.observations.rows import Observations
from estimator.recordings.recording import Recording
from station.campaigns.campaigns import Failure, run_all
from station.errors import UsageError
from station.scripts.script import Move, Rest, Rotate, Script, paper_script
from station.studies.paper import MEMS_NOISE, SOURCE, our_recording, rows_of
from station.studies.paper_text import RATE_DPS, SAMPLE_HZ, TABLE_1, from_si

_DEG = math.pi / 180
_TOTAL_S = 360.0
_SETTLE_S = 0.5
"""Left out at each end of a position: table readings within a ramp are interpolated."""


@dataclass(frozen=True, slots=True, eq=False)
class MethodSummary:
    """One method over all seeds: rms error, rms stated sigma and their ratio (4,), NaN where not seen."""

    name: str
    rms: Floats
    stated: Floats
    seconds: float
    operations_a_sample: float

    @property
    def ratio(self) -> Floats:
        """Rms error over stated sigma (4,); 1 for a sigma that is true."""
        return self.rms / self.stated


@dataclass(frozen=True, slots=True, eq=False)
class BaselineStudy:
    """All methods in the order they are shown, what the direct observation cannot see, and how many seeds ran."""

    methods: tuple[MethodSummary, ...]
    unseen: tuple[str, ...]
    seeds: int
    failures: tuple[Failure, ...]


Method = Callable[[Recording], baselines.BaselineEstimate]
Outcome = tuple[baselines.BaselineEstimate, float]
"""What one method made of one recording, and the seconds that it took."""


def run_study(seeds: int, **where: Any) -> BaselineStudy:
    """Run every method on this many seeds; UsageError if no seed came through. ``where`` is that of ``run_all``."""
    results, failures = run_all(one_seed, range(seeds), label="baselines", **where)
    outcomes = [result for result in results if result is not None]
    if not outcomes:
        raise UsageError(f"the study came to nothing: {failures[0].item}: {failures[0].reason}")
    methods = tuple(_summary(name, [o[i] for o in outcomes]) for i, (name, _, _) in enumerate(METHODS))
    return BaselineStudy(methods, tuple(direct_blind_spots(tetrahedron())), len(outcomes), tuple(failures))


def one_seed(seed: int) -> list[Outcome]:
    """Simulate the three scripts once and run every method on its own."""
    import filterpy.kalman  # noqa: F401  its 0.8 s of import are no part of the time of a filter

    recordings = {script.name: our_recording(MEMS_NOISE, seed, script) for script in _SCRIPTS}
    return [_outcome(method, recordings[script.name]) for _, script, method in METHODS]


def static_script() -> Script:
    """Return six positions at rest, each body axis up and down once, in 360 s: the Earth is the only input."""
    quarter = math.pi / 2
    stops = (("y", 1), ("y", 2), ("y", 3), ("y", 4), ("x", 1), ("x", 3))
    moves = [Move(axis, n * quarter, 20 * _DEG, 20 * _DEG, f"{axis} to {90 * n} deg") for axis, n in stops]
    moving_s = sum(Script("moves", tuple(moves)).durations_s())
    rest = Rest((_TOTAL_S - moving_s) / len(moves))
    return Script("six-position-static", tuple(step for move in moves for step in (move, rest)))


def rotation_script() -> Script:
    """Return both directions about each axis at 20 deg/s, 60 s each, ramps of 6 s, each turning three whole turns."""
    rate, acceleration = RATE_DPS * _DEG, RATE_DPS / 6 * _DEG
    return Script(
        "six-position-rotation",
        tuple(
            Rotate(axis, sign * rate, _TOTAL_S / 6, acceleration, f"{axis} at {sign * RATE_DPS:g} deg/s")
            for axis in "xyz"
            for sign in (1, -1)
        ),
    )


def static_six_position(recording: Recording) -> baselines.BaselineEstimate:
    """Six positions at rest, with Earth rate as the input: z up and down, x down and up, y up and down."""
    rests = _steady(recording, static_script())
    y90, y180, y270, y360, x90, x270 = rests
    return baselines.six_position(((y360, y180), (y270, y90), (x90, x270)), recording.sources[SOURCE].array)


def rotating_six_position(recording: Recording) -> baselines.BaselineEstimate:
    """Steady rotation both ways about each axis."""
    steady = _steady(recording, rotation_script())
    return baselines.six_position([(steady[i], steady[i + 1]) for i in (0, 2, 4)], recording.sources[SOURCE].array)


def direct_blind_spots(array: SensorArray) -> list[str]:
    """Return the combinations of states that the three table rates do not show, in words.

    A state x of the sum may grow by its coefficient times any number, all at once, and the rates stay as they are.
    """
    directions = baselines.unseen_directions(array, baselines.table_rates(array))
    labels = ("biases", *(f"sensitivity of all gyros along body {axis}" for axis in "xyz"))
    return [f"{labels[i % 4]}: {_combination(direction)}" for i, direction in enumerate(directions)]


def _on_rows(method: Callable[[Floats, Floats, SensorArray], baselines.BaselineEstimate]) -> Method:
    return lambda recording: method(*rows_of(recording), recording.sources[SOURCE].array)


def _filter(recording: Recording) -> baselines.BaselineEstimate:
    data = recording.sources[SOURCE]
    noise_rps = MEMS_NOISE.arw * math.sqrt(SAMPLE_HZ)
    prior_sd = np.sqrt(Prior().variances())
    return baselines.covariance_filter(
        *rows_of(recording), data.array, prior_sd, noise_rps, every=len(data.t_ns)
    ).final()


def _ours(recording: Recording) -> baselines.BaselineEstimate:
    gyros = calibrate(recording, innovations=False).gyros
    n, samples = len(gyros), len(recording.sources[SOURCE].t_ns)
    # Output error 6n, sums of [w, z] over blocks and of their products; what follows works on blocks, not samples.
    operations = samples * (6 * n + (3 + n) + (3 + n) * (4 + n))
    return baselines.BaselineEstimate(np.array([g.states for g in gyros]), np.array([g.sd for g in gyros]), operations)


_SCRIPTS = (static_script(), rotation_script(), paper_script())
METHODS: tuple[tuple[str, Script, Method], ...] = (
    ("six positions, Earth rate as the input", _SCRIPTS[0], static_six_position),
    ("six positions, rotation both ways", _SCRIPTS[1], rotating_six_position),
    ("table rates observed directly", _SCRIPTS[2], _on_rows(baselines.direct_observation)),
    ("the same, null space augmented", _SCRIPTS[2], _on_rows(baselines.augmented_observation)),
    ("least squares", _SCRIPTS[2], _on_rows(baselines.least_squares)),
    ("covariance filter, each sample", _SCRIPTS[2], _filter),
    ("this station", _SCRIPTS[2], _ours),
)
"""Name, script and estimator of each method, in the order shown."""


def _outcome(method: Method, recording: Recording) -> Outcome:
    begun = time.perf_counter()
    estimate = method(recording)
    return estimate, time.perf_counter() - begun


def _summary(name: str, outcomes: Sequence[Outcome]) -> MethodSummary:
    return MethodSummary(
        name,
        _rms([from_si(estimate.states) - TABLE_1 for estimate, _ in outcomes]),
        _rms([from_si(estimate.sd) for estimate, _ in outcomes]),
        float(np.median([seconds for _, seconds in outcomes])),
        outcomes[0][0].operations / (_TOTAL_S * SAMPLE_HZ),
    )


def _rms(values: Sequence[Floats]) -> Floats:
    """Return the root of the mean square (4,) over seeds and gyros."""
    return np.asarray(np.sqrt(np.mean(np.square(values), axis=(0, 1))))


def _steady(recording: Recording, script: Script) -> list[Observations]:
    """Return the rows of each rest, or of each rotation between its ramps, in the order of the script."""
    w_rps, y_rps = rows_of(recording)
    t_s = np.arange(1, len(w_rps) + 1) / SAMPLE_HZ
    positions = []
    for timed in script.timeline():
        step = timed.step
        ramp_s = abs(step.rate_rps) / step.acceleration_rps2 if isinstance(step, Rotate) else 0.0
        margin_s = ramp_s + _SETTLE_S
        if not isinstance(step, Move):
            inside = (t_s > timed.start_s + margin_s) & (t_s < timed.start_s + timed.duration_s - margin_s)
            positions.append(Observations(w_rps[inside], y_rps[inside]))
    return positions


def _combination(direction: Floats) -> str:
    """Return a direction (n, 4) of x = [k, b, s_j, s_k] as a sum, leaving out what has no share in it."""
    terms = [
        f"{value:+.2f} {name}{gyro + 1}"
        for name, column in zip(("k", "b", "sigma_j", "sigma_k"), direction.T, strict=True)
        for gyro, value in enumerate(column)
        if abs(value) > 5e-3
    ]
    return " ".join(terms)
