"""From a recording to the calibration of its gyros."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.array import SensorArray
from estimator.errors import RecordingError
from estimator.filter import LiveFilter
from estimator.gram import Gram, solve
from estimator.model import Prior, decode
from estimator.recording import ImuData, Recording
from estimator.reference import AttitudeReadings, BodyRates, RateReadings, TableReadings, Turns, rates_from_attitude

Floats = NDArray[np.float64]

BLOCK_S = 0.1
"""Length of a block of the live filter, and of the means that an attitude reference is compared over."""
_CHUNK_ROWS = 65536
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


def calibrate(recording: Recording, prior: Prior | None = None) -> Calibration:
    """Return the batch estimate of every gyro, the noise taken from the residual.

    Raises RecordingError if a source has no samples that the reference covers.
    """
    prior = prior or Prior()
    gyros: list[GyroCalibration] = []
    notes: list[str] = []
    nis_sum, nis_dof, samples = 0.0, 0, 0
    for source, data in recording.sources.items():
        gram = source_gram(recording, source)
        noise = None
        if isinstance(recording.reference, Turns):  # a few rows: their doubt is stated, not found
            noise = np.maximum(sample_noise(data), solve(gram, data.array, prior).noise_rps)
        solution = solve(gram, data.array, prior, noise)
        # The innovations need the noise that the batch estimate finds, so the rows are walked twice.
        live = LiveFilter(data.array, solution.noise_rps, prior)
        rows = 1 if isinstance(recording.reference, AttitudeReadings) else block_rows(data)
        for part in observations(recording, source):
            for start in range(0, len(part.w_rps) if part.weight is None else 0, rows):
                live.update(part.w_rps[start : start + rows], part.y_rps[start : start + rows])
        samples += gram.rows * len(data.array)
        nis_sum += live.nis_sum
        nis_dof += live.nis_dof
        for i, name in enumerate(data.array.names):
            states, covariance = decode(solution.x[i], solution.covariance[i])
            gyros.append(GyroCalibration(name, source, states, covariance, float(solution.noise_rps[i])))
            notes.extend(_unseen(name, solution.covariance[i], prior))
    lost = sum(data.lost * len(data.array) for data in recording.sources.values())
    nis_mean = nis_sum / nis_dof if nis_dof else float("nan")
    return Calibration(tuple(gyros), nis_mean, samples, lost, tuple(notes))


def source_gram(recording: Recording, source: str) -> Gram:
    """Return the Gram matrix of one source over all rows that the reference covers."""
    data = recording.sources[source]
    gram = Gram.empty(len(data.array))
    for part in observations(recording, source):
        gram += Gram.of(part.w_rps, part.y_rps, part.weight)
    if gram.rows < 8:
        raise RecordingError(
            f"{recording.name}: source {source} has {len(data.t_ns)} samples, of which {gram.rows} lie within the "
            "reference: too few to estimate four states a gyro"
        )
    return gram


def block_rows(data: ImuData) -> int:
    """Return how many samples of this source make a block of the live filter."""
    if len(data.t_ns) < 2:
        return 1
    return max(round(BLOCK_S / (float(np.median(np.diff(data.t_ns))) * 1e-9)), 1)


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
        yield Observations(w, rate[start : start + chunk])


def sample_noise(data: ImuData) -> Floats:
    """Return the white noise of one sample of each channel (m,), from differences of neighbours."""
    # Median of |N(0, 2 s^2)| is 0.954 s; the quantum is the floor for data rounded so that most do not differ.
    steps = np.abs(np.diff(_usable(data)[1], axis=0))
    quantum = [float(column[column > 0].min(initial=np.inf)) for column in steps.T]
    floor = np.where(np.isfinite(quantum), quantum, 1e-9) / np.sqrt(12)
    return np.asarray(np.maximum(np.median(steps, axis=0) / 0.954, floor))


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
    rows = block_rows(data)
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
    """Return one row a segment: mean rate from the angle turned, mean output, weight from the doubt of both."""
    t_ns, rate = _usable(data)
    step_s = float(np.median(np.diff(t_ns))) * 1e-9
    w, y, weight = [], [], []
    white = float(np.median(sample_noise(data)))
    for start, end, turn, sd in zip(turns.t_start_ns, turns.t_end_ns, turns.turn_rad, turns.sd_rad, strict=True):
        inside = (t_ns >= start) & (t_ns <= end)
        n = int(inside.sum())
        if n < 2:
            continue
        length_s = n * step_s
        w.append(turn / length_s)
        y.append(rate[inside].mean(axis=0))
        # Noise of one sample relative to the noise of this mean.
        weight.append(white / np.hypot(white / np.sqrt(n), sd / length_s))
    if not w:
        return Observations(np.empty((0, 3)), np.empty((0, len(data.array))), np.empty(0))
    return Observations(np.array(w), np.array(y), np.array(weight))


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
