"""The methods that the paper names, and ours, on recordings of the same gyros with the same noise and length.

python tests/bench/baselines.py              20 seeds: error, stated sigma, time and work of each method
python tests/bench/baselines.py --seeds 200

Least squares, the two observations of the table rates, the covariance filter and ours take the 360 s script. The two
six-position methods need their own positions, and get scripts of the same 360 s. Every method ends in the states of
``estimator.geometry.model``, decoded without approximation, so that what differs is the method and not the model. ``w``
is the body rate (rows, 3), ``y`` the outputs (rows, n), both in rad/s.

Operations are counted from the dimensions, one multiplication, addition or division each; sums of products by their
upper half; work that does not grow with the rows is left out.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from paper_study.filter import covariance_filter, decoded, regressors
from paper_study.study import MEMS_NOISE, SOURCE, our_recording, rows_of
from paper_study.text import NAMES, RATE_DPS, SAMPLE_HZ, TABLE_1, UNITS, from_si

from drivers.types import Floats
from estimator.errors import EstimatorError
from estimator.estimation.calibrate import calibrate
from estimator.geometry.array import SensorArray, tetrahedron
from estimator.geometry.model import Prior, regressor_maps
from estimator.observations.rows import Observations
from estimator.recordings.recording import Recording
from station.render.terminal import rich_table, stdout
from station.scripts.script import Move, Rest, Rotate, Script, paper_script

_NULL_SHARE = 1e-9  # of the greatest eigenvalue: below it a direction carries no information
_SEEN = 1e-6  # share of a state that may lie in directions without information
_FORMATS = (".4f", ".1f", ".4f", ".4f")
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


@dataclass(frozen=True, slots=True, eq=False)
class BaselineEstimate:
    """States and their stated sigmas (n, 4), NaN where the method does not determine them.

    ``operations`` is the arithmetic of the whole estimate. ``unseen`` (d, n, 4) spans what the observation
    cannot see, as combinations of x = [k, b, s_j, s_k]; see ``unseen_directions`` for their order.
    """

    states: Floats
    sd: Floats
    operations: int
    unseen: Floats = field(default_factory=lambda: np.empty((0, 0, 4)))


def least_squares(w_rps: Floats, y_rps: Floats, array: SensorArray) -> BaselineEstimate:
    """Fit the output error of each gyro on [1, w] by an orthogonal transform; the noise from the residual."""
    rows, n = y_rps.shape
    q, r = np.linalg.qr(regressors(w_rps))
    z = y_rps - w_rps @ array.p.T
    projected = q.T @ z
    coefficients = np.linalg.solve(r, projected)
    noise = np.sqrt((np.sum(z**2, axis=0) - np.sum(projected**2, axis=0)) / (rows - 4))
    inverse = np.linalg.inv(r)
    covariance = noise[:, None, None] ** 2 * (inverse @ inverse.T)
    states, sd = decoded(*_from_coefficients(array, coefficients.T, covariance))
    # Output error 6n, QR with Q 4 x 4^2, projection and squares 8n + 2n + 2n.
    return BaselineEstimate(states, sd, rows * (18 * n + 64))


def six_position(pairs: Sequence[tuple[Observations, Observations]], array: SensorArray) -> BaselineEstimate:
    """Solve the means at three pairs of positions, plus and minus, by the classic sums and differences.

    A position is the rows at one attitude, or during one steady rotation.

    Half of the difference of a pair is g . (w+ - w-)/2 in each gyro, free of its bias: three pairs give the row
    g = (1 - k) pbar of any gyro, whatever its direction. With rotation about the axes this is
    g_axis = (y+ - y-) / 2w. The mean of all six gives the bias. The stated sigma takes the scatter within the
    positions for white noise, as is the custom.

    Raises EstimatorError if the half differences of the input do not span space.
    """
    positions = [position for pair in pairs for position in pair]
    w = np.array([position.w_rps.mean(axis=0) for position in positions])
    y = np.array([position.y_rps.mean(axis=0) for position in positions])
    halves = np.kron(np.eye(3), [0.5, -0.5])
    if len(pairs) != 3 or np.linalg.matrix_rank(halves @ w, tol=1e-9) < 3:
        raise EstimatorError("six positions need three pairs whose inputs differ along three directions")
    row_of = np.linalg.solve(halves @ w, halves)  # (3, 6): g from the six means
    minus_bias_of = np.full(6, 1 / 6) - w.mean(axis=0) @ row_of
    solution = np.vstack([minus_bias_of, row_of])
    means = y - w @ array.p.T
    scatter = np.array([np.var(p.y_rps - p.w_rps @ array.p.T, axis=0, ddof=1) for p in positions])
    counts = np.array([len(p.y_rps) for p in positions])
    of_means = scatter.mean(axis=0)[:, None] / counts  # (n, 6)
    covariance = np.einsum("ap,np,bp->nab", solution, of_means, solution)
    states, sd = decoded(*_from_coefficients(array, (solution @ means).T, covariance))
    n = len(array)
    return BaselineEstimate(states, sd, int(counts.sum()) * (n + 3))


def direct_observation(w_rps: Floats, y_rps: Floats, array: SensorArray) -> BaselineEstimate:
    """Observe the three table rates, pinv(P) y, alone: n gyros are seen through three numbers a sample."""
    return _through(w_rps, y_rps, array, table_rates(array))


def augmented_observation(w_rps: Floats, y_rps: Floats, array: SensorArray) -> BaselineEstimate:
    """Observe the three table rates and the n - 3 parity combinations that no body rate reaches.

    Both together are an invertible transform of the n outputs.
    """
    rates = table_rates(array)
    return _through(w_rps, y_rps, array, np.vstack([rates, _null_rows(rates)]))


def table_rates(array: SensorArray) -> Floats:
    """Return the combinations (3, n) of the outputs that give the body rate of perfect gyros, pinv(P)."""
    return np.asarray(np.linalg.pinv(array.p), dtype=np.float64)


def unseen_directions(array: SensorArray, transform: Floats) -> Floats:
    """Return what ``transform`` (m, n) of the outputs cannot see, as unit vectors of x: (4 (n - m), n, 4).

    For each combination v of gyros that the transform loses come four directions: the biases in the ratio of v,
    then the sensitivity rows shifted in that ratio along body x, y, z. The latter mix k, s_j and s_k.
    """
    directions = []
    maps = regressor_maps(array)
    for v in _null_rows(transform):
        for column in range(4):
            shift = np.zeros(4)
            shift[column] = 1.0 if column else -1.0  # a bias lowers the output
            x = np.array([v_i * np.linalg.solve(a.T, shift) for v_i, a in zip(v, maps, strict=True)])
            directions.append(x / np.linalg.norm(x))
    return np.array(directions).reshape(-1, len(array), 4)


def _through(w_rps: Floats, y_rps: Floats, array: SensorArray, transform: Floats) -> BaselineEstimate:
    """Estimate all 4n states together from ``transform`` (m, n) of the output error, weighted for its noise."""
    rows, (m, n) = len(y_rps), transform.shape
    white = np.linalg.solve(np.linalg.cholesky(transform @ transform.T), transform)
    observed = (y_rps - w_rps @ array.p.T) @ white.T
    columns, maps = regressors(w_rps), regressor_maps(array)
    shared = columns.T @ columns
    each = np.einsum("iab,bc,ldc->iald", maps, shared, maps)  # [1, w] products seen by gyros i and l
    information = (each * (white.T @ white)[:, None, :, None]).reshape(4 * n, 4 * n)
    right = np.einsum("iab,bm,mi->ia", maps, columns.T @ observed, white).ravel()
    values, vectors = np.linalg.eigh(information)
    sees = values > _NULL_SHARE * values[-1]
    inverse = (vectors[:, sees] / values[sees]) @ vectors[:, sees].T
    x = inverse @ right
    noise = np.sqrt((np.sum(observed**2) - right @ x) / (rows * m - int(sees.sum())))
    covariance = np.array([noise**2 * inverse[4 * i : 4 * i + 4, 4 * i : 4 * i + 4] for i in range(n)])
    states, sd = decoded(x.reshape(n, 4), covariance)
    hidden = np.sum(vectors[:, ~sees] ** 2, axis=1).reshape(n, 4) > _SEEN
    # A misalignment is s / (1 - k): it is seen where both are.
    hidden[:, 2:] |= hidden[:, :1]
    states[hidden], sd[hidden] = np.nan, np.nan
    # Output error 6n, transform 2mn, squares 2m, products of [1, w] with each other 20 and with the transformed 8m.
    return BaselineEstimate(states, sd, rows * (6 * n + 2 * m * n + 10 * m + 20), unseen_directions(array, transform))


def _null_rows(matrix: Floats) -> Floats:
    """Return an orthonormal basis (n - m, n) of what ``matrix`` (m, n) maps to zero, its largest entries positive."""
    _, singular, right = np.linalg.svd(matrix)
    basis = right[int(np.sum(singular > _NULL_SHARE * singular[0])) :]
    largest = np.take_along_axis(basis, np.abs(basis).argmax(axis=1)[:, None], axis=1)
    return np.asarray(basis * np.sign(largest))


def _from_coefficients(array: SensorArray, coefficients: Floats, covariance: Floats) -> tuple[Floats, Floats]:
    """Return x (n, 4) and its covariance from the coefficients (n, 4) of the output error on [1, w]."""
    inverse = np.linalg.inv(regressor_maps(array).transpose(0, 2, 1))
    return np.einsum("nab,nb->na", inverse, coefficients), inverse @ covariance @ inverse.transpose(0, 2, 1)


Method = Callable[[Recording], BaselineEstimate]
Outcome = tuple[BaselineEstimate, float]
"""What one method made of one recording, and the seconds that it took."""


def run_study(seeds: int) -> BaselineStudy:
    """Run every method on this many seeds."""
    outcomes = [one_seed(seed) for seed in range(seeds)]
    methods = tuple(_summary(name, [o[i] for o in outcomes]) for i, (name, _, _) in enumerate(METHODS))
    return BaselineStudy(methods, tuple(direct_blind_spots(tetrahedron())), len(outcomes))


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
    moving_s = Script("moves", tuple(moves)).least_s
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


def static_six_position(recording: Recording) -> BaselineEstimate:
    """Six positions at rest, with Earth rate as the input: z up and down, x down and up, y up and down."""
    rests = _steady(recording, static_script())
    y90, y180, y270, y360, x90, x270 = rests
    return six_position(((y360, y180), (y270, y90), (x90, x270)), recording.sources[SOURCE].array)


def rotating_six_position(recording: Recording) -> BaselineEstimate:
    """Steady rotation both ways about each axis."""
    steady = _steady(recording, rotation_script())
    return six_position([(steady[i], steady[i + 1]) for i in (0, 2, 4)], recording.sources[SOURCE].array)


def direct_blind_spots(array: SensorArray) -> list[str]:
    """Return the combinations of states that the three table rates do not show, in words.

    A state x of the sum may grow by its coefficient times any number, all at once, and the rates stay as they are.
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
    n, samples = len(gyros), len(recording.sources[SOURCE].t_ns)
    # Output error 6n, sums of [w, z] over blocks and of their products; what follows works on blocks, not samples.
    operations = samples * (6 * n + (3 + n) + (3 + n) * (4 + n))
    return BaselineEstimate(np.array([g.states for g in gyros]), np.array([g.sd for g in gyros]), operations)


_SCRIPTS = (static_script(), rotation_script(), paper_script())
METHODS: tuple[tuple[str, Script, Method], ...] = (
    ("six positions, Earth rate as the input", _SCRIPTS[0], static_six_position),
    ("six positions, rotation both ways", _SCRIPTS[1], rotating_six_position),
    ("table rates observed directly", _SCRIPTS[2], _on_rows(direct_observation)),
    ("the same, null space augmented", _SCRIPTS[2], _on_rows(augmented_observation)),
    ("least squares", _SCRIPTS[2], _on_rows(least_squares)),
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
            inside = (t_s > timed.start_s + margin_s) & (t_s < timed.start_s + timed.span.least_s - margin_s)
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20)
    study = run_study(parser.parse_args().seeds)
    heads = [
        "method",
        *(f"{name}, {unit}" for name, unit in zip(NAMES, UNITS, strict=True)),
        "ms",
        "operations a sample",
    ]
    table = rich_table(f"Rms error over {study.seeds} seeds and four gyros; rms error / stated sigma", heads, "lr")
    for method in study.methods:
        cells = [
            "not seen" if np.isnan(rms) else f"{rms:{form}} ({ratio:.2f})"
            for rms, ratio, form in zip(method.rms, method.ratio, _FORMATS, strict=True)
        ]
        table.add_row(method.name, *cells, f"{1e3 * method.seconds:.0f}", f"{method.operations_a_sample:,.0f}")
    console = stdout()
    console.print(table)
    console.print("What the table rates alone do not show, however long they are watched:")
    for line in study.unseen:
        console.print(f"- {line}", highlight=False)


if __name__ == "__main__":
    main()
