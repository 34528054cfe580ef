"""From a recording to the calibration of its gyros."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.array import SensorArray
from estimator.errors import RecordingError
from estimator.filter import LiveFilter
from estimator.gram import Gram, Solution, solve
from estimator.model import Prior, decode, regressor_maps
from estimator.recording import ImuData, Recording
from estimator.reference import AttitudeReadings, BodyRates, RateReadings, TableReadings, Turns, rates_from_attitude

Floats = NDArray[np.float64]

BLOCK_S = 0.2
"""Length of a block of the live filter."""
MEAN_S = 0.1
"""Length of the means over which an attitude reference is compared: a low pass of 10 Hz on both sides."""
_CHUNK_ROWS = 65536
CLUSTER_S = 5.0
"""Length over which residuals against a foreign reference may hang together without the sigma being wrong."""
_FEWEST_CLUSTERS = 8
_COLOURED = 2.0  # sigmas that grow by more than this are told
_UNSEEN = 0.5  # a posterior sigma above this share of the prior's: the run did not show the state


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """Rows of body rate (rows, 3) and output (rows, m); ``weight`` is 1 / noise relative to other rows."""

    w_rps: Floats
    y_rps: Floats
    weight: Floats | None = None


@dataclass(frozen=True, slots=True, eq=False)
class GyroCalibration:
    """States of one gyro [k, b_rps, sigma_j_rad, sigma_k_rad], their covariance, the noise of one sample."""

    name: str
    source: str
    states: Floats
    covariance: Floats
    noise_rps: float

    @property
    def sd(self) -> Floats:
        """Standard deviations of the states (4,)."""
        return np.sqrt(np.diag(self.covariance))


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """What one recording says of its gyros. ``samples`` counts gyro samples used, ``lost`` those missing."""

    gyros: tuple[GyroCalibration, ...]
    nis_mean: float
    samples: int
    lost: int
    notes: tuple[str, ...]


def calibrate(recording: Recording, *, innovations: bool = True) -> Calibration:
    """Return the batch estimate of every gyro under its data sheet's prior, the noise taken from the residual.

    ``innovations`` also runs the filter over the rows, for their mean NIS; without, that is NaN.

    Raises RecordingError if a source has no samples that the reference covers.
    """
    gyros: list[GyroCalibration] = []
    notes: list[str] = []
    nis_sum, nis_dof, samples = 0.0, 0, 0
    for source, data in recording.sources.items():
        gram, prior = source_gram(recording, source), data.prior
        noise = None
        if isinstance(recording.reference, Turns):  # a few rows: their doubt is stated, not found
            # The rows are weighted by the noise of the worst channel, so that is what the noise is relative to.
            noise = np.maximum(sample_noise(data).max(), solve(gram, data.array, prior).noise_rps)
        solution = solve(gram, data.array, prior, noise)
        # The innovations need the noise that the batch estimate finds, so the rows are walked twice.
        live = LiveFilter(data.array, solution.noise_rps, prior)
        rows = 1 if isinstance(recording.reference, AttitudeReadings) else block_rows(data)
        for part in observations(recording, source) if innovations else ():
            for start in range(0, len(part.w_rps) if part.weight is None else 0, rows):
                live.update(part.w_rps[start : start + rows], part.y_rps[start : start + rows])
        samples += gram.rows * len(data.array)
        nis_sum += live.nis_sum
        nis_dof += live.nis_dof
        covariances = solution.covariance
        if isinstance(recording.reference, (AttitudeReadings, RateReadings)):
            covariances, coloured = _clustered(recording, source, solution, prior)
            notes.extend(coloured)
        for i, name in enumerate(data.array.names):
            states, covariance = decode(solution.x[i], covariances[i])
            gyros.append(GyroCalibration(name, source, states, covariance, float(solution.noise_rps[i])))
            notes.extend(_unseen(name, covariances[i], prior))
    lost = sum(data.lost * len(data.array) for data in recording.sources.values())
    nis_mean = nis_sum / nis_dof if nis_dof else float("nan")
    return Calibration(tuple(gyros), nis_mean, samples, lost, tuple(notes))


def source_gram(recording: Recording, source: str) -> Gram:
    """Return the Gram matrix of one source over all rows that the reference covers."""
    data = recording.sources[source]
    gram = Gram.empty(len(data.array))
    for part in observations(recording, source):
        gram += Gram.of(part.w_rps, part.y_rps, part.weight)
    if isinstance(recording.reference, Turns) and gram.rows < 4:
        raise RecordingError(
            f"{recording.name}: {gram.rows} of {len(recording.reference.sd_rad)} turns hold samples of {source}: "
            "four states a gyro need four turns or rests at the least"
        )
    if not isinstance(recording.reference, Turns) and gram.rows < 8:
        raise RecordingError(
            f"{recording.name}: source {source} has {len(data.t_ns)} samples, of which {gram.rows} lie within the "
            "reference: too few to estimate four states a gyro"
        )
    return gram


def block_rows(data: ImuData, length_s: float = BLOCK_S) -> int:
    """Return how many samples of this source make a block, by default of the live filter."""
    if len(data.t_ns) < 2:
        return 1
    return max(round(length_s / (float(np.median(np.diff(data.t_ns))) * 1e-9)), 1)


def observations(recording: Recording, source: str) -> Iterator[Observations]:
    """Yield rows of body rate and output of one source, in parts of bounded size, in order of time."""
    data = recording.sources[source]
    reference = recording.reference
    if isinstance(reference, AttitudeReadings):
        yield from _means(data, rates_from_attitude(reference))
        return
    if isinstance(reference, Turns):
        yield _segments(data, reference)
        return
    t_ns, rate = _usable(data)
    if isinstance(reference, RateReadings):
        known = np.isfinite(reference.rate_rps).all(axis=1)
        reference = RateReadings(reference.t_ns[known], reference.rate_rps[known])
        if not known.any():
            return
    if isinstance(reference, TableReadings):
        rates = BodyRates(reference.gimbals, recording.site)
        rates.add(reference.t_ns, reference.angle_rad, reference.rate_rps)
        rates.finish()
        inside = (t_ns >= rates.starts_ns) & (t_ns <= rates.final_until_ns)
    else:
        inside = (t_ns >= reference.t_ns[0]) & (t_ns <= reference.t_ns[-1])
    t_ns, rate = t_ns[inside], rate[inside]
    block = block_rows(data)
    chunk = max(_CHUNK_ROWS // block, 1) * block  # whole blocks, so that a replay is cut as the live run was
    for start in range(0, len(t_ns), chunk):
        t = t_ns[start : start + chunk]
        if isinstance(reference, TableReadings):
            w = rates.at(t)
        else:
            w = np.column_stack([np.interp(t, reference.t_ns, reference.rate_rps[:, c]) for c in range(3)])
        known = np.isfinite(w).all(axis=1)
        yield Observations(w[known], rate[start : start + chunk][known])


def sample_noise(data: ImuData) -> Floats:
    """Return the white noise of one sample of each channel (m,), from differences of neighbours."""
    # Median of |N(0, 2 s^2)| is 0.954 s; the quantum is the floor for data rounded so that most do not differ.
    rate = _usable(data)[1]
    quantum = _quantum(rate)
    floor = np.where(np.isfinite(quantum), quantum, 1e-9) / np.sqrt(12)
    return np.asarray(np.maximum(np.median(np.abs(np.diff(rate, axis=0)), axis=0) / 0.954, floor))


def _quantum(rate_rps: Floats) -> Floats:
    """Return the smallest step between neighbouring samples of each channel (m,); infinite if all are equal."""
    steps = np.abs(np.diff(rate_rps, axis=0))
    # Differences of the same two decimals differ in their last binary digits: 1e-9 rad/s is no step.
    return np.array([float(column[column > 1e-9].min(initial=np.inf)) for column in steps.T])


def _usable(data: ImuData) -> tuple[NDArray[np.int64], Floats]:
    finite = np.isfinite(data.rate_rps).all(axis=1)
    t_ns, rate = data.t_ns[finite], data.rate_rps[finite]
    if np.any(np.diff(t_ns) <= 0):
        order = np.argsort(t_ns, kind="stable")
        t_ns, rate = t_ns[order], rate[order]
    return t_ns, rate


def _means(data: ImuData, reference: RateReadings) -> Iterator[Observations]:
    """Yield means of both sides over blocks: differentiated attitudes are too noisy to compare by sample."""
    t_ns, rate = _usable(data)
    w = np.column_stack([np.interp(t_ns, reference.t_ns, reference.rate_rps[:, c]) for c in range(3)])
    rows = block_rows(data, MEAN_S)
    inside = (t_ns >= reference.t_ns[0]) & (t_ns <= reference.t_ns[-1])
    first = int(np.argmax(inside)) if inside.any() else 0
    count = int(inside.sum()) // rows
    if not count:
        return
    w_mean = w[first : first + count * rows].reshape(count, rows, 3).mean(axis=1)
    y_mean = rate[first : first + count * rows].reshape(count, rows, -1).mean(axis=1)
    whole = np.isfinite(w_mean).all(axis=1)
    yield Observations(w_mean[whole], y_mean[whole])


def _segments(data: ImuData, turns: Turns) -> Observations:
    """Return one row a segment: mean rate from the angle turned, mean output, weight from the doubt of both.

    The mean is over time, not over samples: foreign samples may be unevenly spaced.
    """
    t_ns, rate = _usable(data)
    white, quantum = float(sample_noise(data).max()), _quantum(rate)
    w, y, weight = [], [], []
    for start, end, turn, sd in zip(turns.t_start_ns, turns.t_end_ns, turns.turn_rad, turns.sd_rad, strict=True):
        inside = (t_ns >= start) & (t_ns <= end)
        n = int(inside.sum())
        if n < 2:
            continue
        t_s, part = (t_ns[inside] - start) * 1e-9, rate[inside]
        length_s = float(t_s[-1] - t_s[0])
        w.append(turn / length_s)
        y.append(np.trapezoid(part, t_s, axis=0) / length_s)
        # Samples that hardly leave one count do not average: their mean is good to the count, however many.
        stuck = np.where(np.isfinite(quantum) & (part.std(axis=0) < quantum / 2), quantum / np.sqrt(12), 0.0)
        # Noise of one sample relative to the noise of this mean.
        weight.append(white / np.sqrt(white**2 / n + (sd / length_s) ** 2 + float(stuck.max()) ** 2))
    if not w:
        return Observations(np.empty((0, 3)), np.empty((0, len(data.array))), np.empty(0))
    return Observations(np.array(w), np.array(y), np.array(weight))


def _clustered(recording: Recording, source: str, solution: Solution, prior: Prior) -> tuple[Floats, list[str]]:
    """Return covariances (m, 4, 4) that hold for residuals correlated within clusters of 5 s, and notes.

    Another instrument's errors (its filter, its delay, lost markers) are no white noise. The scores of a
    cluster are summed before they are squared (Liang, Zeger 1986), so what hangs together within it counts as
    one. No direction gets less than the white-noise covariance.
    """
    data = recording.sources[source]
    m = len(data.array)
    maps = regressor_maps(data.array)
    attitude = isinstance(recording.reference, AttitudeReadings)
    row_s = MEAN_S if attitude else BLOCK_S / block_rows(data)
    rows = max(round(CLUSTER_S / row_s), 1)
    scores = []
    for part in observations(recording, source):
        regressors = np.column_stack([np.ones(len(part.w_rps)), part.w_rps])
        rest = part.y_rps - part.w_rps @ data.array.p.T
        rest -= np.einsum("rj,mij,mi->rm", regressors, maps, solution.x)
        products = regressors[:, :, None] * rest[:, None, :]
        scores.append(np.add.reduceat(products, np.arange(0, len(products), rows), axis=0))
    by_gyro = np.einsum("mij,cjm->mci", maps, np.vstack(scores)) / solution.noise_rps[:, None, None] ** 2
    count = by_gyro.shape[1]
    if count < _FEWEST_CLUSTERS:
        return solution.covariance, [f"{source}: too short to tell whether the residual is white; sigmas assume it"]
    out, notes = np.empty((m, 4, 4)), []
    for i, name in enumerate(data.array.names):
        white = solution.covariance[i]
        meat = by_gyro[i].T @ by_gyro[i] * count / (count - 1) + np.diag(1 / prior.variances())
        root = np.linalg.cholesky(white)
        ratio, directions = np.linalg.eigh(root.T @ meat @ root)
        basis = root @ directions
        out[i] = basis @ np.diag(np.maximum(ratio, 1.0)) @ basis.T
        worst = float(np.sqrt(np.max(np.diag(out[i]) / np.diag(white))))
        if worst > _COLOURED:
            notes.append(
                f"{name}: the residual is no white noise; sigmas are up to {worst:.1f} times those of white noise"
            )
    return out, notes


def _unseen(name: str, covariance: Floats, prior: Prior) -> list[str]:
    ratio = np.sqrt(np.diag(covariance) / prior.variances())
    labels = ("scale factor error k", "bias b", "misalignment sigma_j", "misalignment sigma_k")
    return [
        f"{name}: {label} is not seen by this run (its sigma is {r:.0%} of what the data sheet says)"
        for label, r in zip(labels, ratio, strict=True)
        if r > _UNSEEN
    ]


def array_of(recording: Recording) -> SensorArray:
    """Return all channels of a recording as one array, in the order of its sources."""
    parts = [data.array for data in recording.sources.values()]
    return SensorArray(
        tuple(name for part in parts for name in part.names),
        np.vstack([part.p for part in parts]),
        np.vstack([part.j for part in parts]),
        np.vstack([part.k for part in parts]),
    )
