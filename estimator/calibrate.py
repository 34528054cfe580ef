"""From a recording to the calibration of its gyros."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.array import SensorArray
from estimator.blocks import Blocks, BlockSums
from estimator.budget import Contribution, table_budget
from estimator.coloured import (
    FEWEST_BLOCKS,
    GridFit,
    NoiseFound,
    NoiseGrid,
    Part,
    coarse,
    combine,
    fit_grids,
    weights,
)
from estimator.errors import RecordingError
from estimator.filter import LiveFilter
from estimator.gram import Gram, Solution, solve
from estimator.health import Excluded, usable
from estimator.model import Prior, decode, regressor_maps
from estimator.parity import GyroParity, parity
from estimator.recording import ImuData, Recording
from estimator.reference import AttitudeReadings, BodyRates, RateReadings, TableReadings, Turns, rates_from_attitude

Floats = NDArray[np.float64]
Stamps = NDArray[np.int64]

BLOCK_S = 0.2
"""Length of a block of the live filter."""
MEAN_S = 0.1
"""Length of the means over which an attitude reference is compared: a low pass of 10 Hz on both sides."""
_CHUNK_ROWS = 65536
CLUSTER_S = 5.0
"""Length over which residuals against a foreign reference may hang together without the sigma being wrong."""
_FEWEST_CLUSTERS = 8
_COLOURED = 2.0  # sigmas that grow by more than this are told
REST_RPS = float(np.radians(0.05))
REST_S = 5.0
_UNSEEN = 0.5  # a posterior sigma above this share of the prior's: the run did not show the state


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """Rows of body rate (rows, 3) and output (rows, m), with their instants where they are samples.

    ``weight`` is 1 / noise relative to other rows.
    """

    w_rps: Floats
    y_rps: Floats
    weight: Floats | None = None
    t_ns: Stamps | None = None


@dataclass(frozen=True, slots=True, eq=False)
class GyroCalibration:
    """States of one gyro [k, b_rps, sigma_j_rad, sigma_k_rad], their covariance, the noise of one sample.

    ``covariance`` holds everything; ``budget`` is what it is the sum of: type A, from the scatter of the data, and
    type B, from the table's stated uncertainty. ``noise`` is what the data say of the noise, where they do.
    """

    name: str
    source: str
    states: Floats
    covariance: Floats
    noise_rps: float
    p: Floats
    device: str
    budget: tuple[Contribution, ...] = ()
    noise: NoiseFound | None = None

    @property
    def sd(self) -> Floats:
        """Standard deviations of the states (4,)."""
        return np.sqrt(np.diag(self.covariance))


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """What one recording says of its gyros. ``samples`` counts gyro samples used, ``lost`` those missing.

    ``excluded`` are gyros that could not be estimated; ``parity`` is what the gyros of redundant devices say of
    each other.
    """

    gyros: tuple[GyroCalibration, ...]
    nis_mean: float
    samples: int
    lost: int
    notes: tuple[str, ...]
    excluded: tuple[Excluded, ...] = ()
    parity: tuple[GyroParity, ...] = ()


def calibrate(recording: Recording, *, innovations: bool = True) -> Calibration:
    """Return the batch estimate of every gyro under its data sheet's prior, the noise taken from the data.

    Against a table the noise may be coloured (``estimator.coloured``); against foreign references sigmas come from
    clusters of residuals. ``innovations`` also gives the mean NIS, else that is NaN.

    Raises RecordingError if a source has no samples that the reference covers, or no gyro can be estimated.
    """
    notes: list[str] = []
    excluded: list[Excluded] = []
    sources: list[tuple[str, ImuData]] = []
    for source, data in recording.sources.items():
        found = usable(data, fine=isinstance(recording.reference, TableReadings))
        notes.extend(found.notes)
        excluded.extend(found.excluded)
        sources.extend((source, part) for part in found.parts)
    if not sources:
        reasons = "; ".join(f"{e.name}: {e.reason}" for e in excluded)
        raise RecordingError(f"{recording.name}: no gyro of it can be estimated: {reasons}")
    notes.extend(f"{e.name} is not estimated: {e.reason}; the others are" for e in excluded)
    if isinstance(recording.reference, TableReadings):
        result = _against_table(recording, sources, innovations)
    else:
        result = _against_foreign(recording, sources, innovations)
    order = [name for data in recording.sources.values() for name in data.array.names]
    return Calibration(
        tuple(sorted(result.gyros, key=lambda gyro: order.index(gyro.name))),
        result.nis_mean,
        result.samples,
        sum(data.lost * len(data.array) for data in recording.sources.values()),
        (*notes, *result.notes),
        tuple(excluded),
        result.parity,
    )


def _against_table(recording: Recording, sources: list[tuple[str, ImuData]], innovations: bool) -> Calibration:
    blocks = [source_blocks(recording, data) for _, data in sources]
    for (source, data), own in zip(sources, blocks, strict=True):
        _enough(recording, source, data, int(own.rows.sum()))
    notes = motion_notes(recording)
    span_s = max(float(b.t_s[-1] - b.t_s[0]) + b.length_s for b in blocks)
    gyros: list[GyroCalibration] = []
    checks: list[GyroParity] = []
    squares, dof = 0.0, 0
    for device in dict.fromkeys(data.device for _, data in sources):
        members = [n for n, (_, data) in enumerate(sources) if data.device == device]
        merged = [coarse(blocks[n]) for n in members]
        fits = _device_fits(merged, [sources[n][1] for n in members], span_s)
        for n, fit, weight in zip(members, fits, weights(fits), strict=True):
            source, data = sources[n]
            x, covariances, noise = combine(fit, weight)
            sample = _sample_noise_of(blocks[n], data.array, x)
            arw = np.array([found.mean.arw for found in noise])
            table = table_budget(recording.reference, recording.site, data.array, data.prior, arw)  # type: ignore[arg-type]
            for i, name in enumerate(data.array.names):
                kinds = (Contribution("noise", covariances[i]), *table[i])
                states, covariance = decode(x[i], np.sum([c.covariance for c in kinds], axis=0))
                budget = tuple(Contribution(c.name, decode(x[i], c.covariance)[1]) for c in kinds)
                gyros.append(
                    GyroCalibration(
                        name, source, states, covariance, sample[i], data.array.p[i], device, budget, noise[i]
                    )
                )
                notes.extend(_unseen(name, covariances[i], data.prior))
            if innovations:
                chi, count = _block_squares(blocks[n], data.array, x, sample)
                squares, dof = squares + chi, dof + count
        own_gyros = gyros[len(gyros) - sum(len(sources[n][1].array) for n in members) :]
        checks += parity(
            [sources[n][1].array for n in members],
            merged,
            np.array([g.states for g in own_gyros]),
            [g.noise.mean for g in own_gyros if g.noise],
        )
    samples = sum(int(b.rows.sum()) * b.z_rps.shape[1] for b in blocks)
    nis = squares / dof if dof else float("nan")
    return Calibration(tuple(gyros), nis, samples, 0, (*notes, *_parity_notes(checks)), (), tuple(checks))


def _device_fits(merged: list[Blocks], data: list[ImuData], span_s: float) -> list[GridFit]:
    parts = [Part(b, d.array, d.prior) for b, d in zip(merged, data, strict=True)]
    long_enough = min(len(b.index) for b in merged) >= FEWEST_BLOCKS
    grid = NoiseGrid.over(span_s, data[0].noise) if long_enough else NoiseGrid.white()
    return fit_grids(parts, grid)


def source_blocks(recording: Recording, data: ImuData, length_s: float = BLOCK_S) -> Blocks:
    """Return the rows of one source against the table, summed by block from the first reading of the table."""
    reference = recording.reference
    if not isinstance(reference, TableReadings):
        raise TypeError("blocks are of recordings against a table")
    t_ns = data.t_ns
    period_s = float(np.median(np.diff(t_ns))) * 1e-9 if len(t_ns) > 1 else length_s
    sums = BlockSums(len(data.array), int(reference.t_ns[0]), length_s, period_s)
    for part in _table_rows(recording, data):
        sums.add(part.t_ns, part.w_rps, part.y_rps - part.w_rps @ data.array.p.T)  # type: ignore[arg-type]
    return sums.blocks()


def _enough(recording: Recording, source: str, data: ImuData, rows: int) -> None:
    if rows < 8:
        raise RecordingError(
            f"{recording.name}: source {source} has {len(data.t_ns)} samples, of which {rows} lie within the "
            "reference: too few to estimate four states a gyro"
        )


def _sample_noise_of(blocks: Blocks, array: SensorArray, x: Floats) -> Floats:
    """Return the scatter of single samples within blocks (m,), in rad/s, about the states x (m, 4)."""
    maps = regressor_maps(array)[:, :, 1:]
    rows = max(int(blocks.rows.sum()) - len(blocks.rows), 1)
    slopes = np.einsum("mi,mij->mj", x, maps)
    squares = np.empty(len(array))
    for i, slope in enumerate(slopes):
        weights_of = np.concatenate([-slope, np.eye(len(array))[i]])
        squares[i] = weights_of @ blocks.within @ weights_of
    return np.sqrt(np.maximum(squares / rows, 1e-30))


def _block_squares(blocks: Blocks, array: SensorArray, x: Floats, noise_rps: Floats) -> tuple[float, int]:
    """Return the squares of block means about the estimate, over those of white noise, and their number."""
    regressors = np.column_stack([np.ones(len(blocks.index)), blocks.w_rps])
    rest = blocks.z_rps - np.einsum("rj,mij,mi->rm", regressors, regressor_maps(array), x)
    squares = float(np.sum(blocks.rows[:, None] * (rest / noise_rps) ** 2))
    return squares, max(rest.size - 4 * len(array), 0)


def _against_foreign(recording: Recording, sources: list[tuple[str, ImuData]], innovations: bool) -> Calibration:
    gyros: list[GyroCalibration] = []
    notes: list[str] = []
    nis_sum, nis_dof, samples = 0.0, 0, 0
    for source, data in sources:
        gram, prior = _gram(recording, source, data), data.prior
        noise = None
        if isinstance(recording.reference, Turns):  # a few rows: their doubt is stated, not found
            # The rows are weighted by the noise of the worst channel, so that is what the noise is relative to.
            noise = np.maximum(sample_noise(data).max(), solve(gram, data.array, prior).noise_rps)
        solution = solve(gram, data.array, prior, noise)
        # The innovations need the noise that the batch estimate finds, so the rows are walked twice.
        live = LiveFilter(data.array, solution.noise_rps, prior)
        rows = 1 if isinstance(recording.reference, AttitudeReadings) else block_rows(data)
        for part in _rows(recording, data) if innovations else ():
            for start in range(0, len(part.w_rps) if part.weight is None else 0, rows):
                live.update(part.w_rps[start : start + rows], part.y_rps[start : start + rows])
        samples += gram.rows * len(data.array)
        nis_sum += live.nis_sum
        nis_dof += live.nis_dof
        covariances = solution.covariance
        if isinstance(recording.reference, (AttitudeReadings, RateReadings)):
            covariances, coloured = _clustered(recording, source, data, solution, prior)
            notes.extend(coloured)
        for i, name in enumerate(data.array.names):
            states, covariance = decode(solution.x[i], covariances[i])
            budget = (Contribution("noise", covariance),)
            one = float(solution.noise_rps[i])
            gyros.append(GyroCalibration(name, source, states, covariance, one, data.array.p[i], data.device, budget))
            notes.extend(_unseen(name, covariances[i], prior))
    nis_mean = nis_sum / nis_dof if nis_dof else float("nan")
    return Calibration(tuple(gyros), nis_mean, samples, 0, tuple(notes))


def source_gram(recording: Recording, source: str) -> Gram:
    """Return the Gram matrix of one source over all rows that the reference covers."""
    return _gram(recording, source, recording.sources[source])


def _gram(recording: Recording, source: str, data: ImuData) -> Gram:
    gram = Gram.empty(len(data.array))
    for part in _rows(recording, data):
        gram += Gram.of(part.w_rps, part.y_rps, part.weight)
    if isinstance(recording.reference, Turns) and gram.rows < 4:
        raise RecordingError(
            f"{recording.name}: {gram.rows} of {len(recording.reference.sd_rad)} turns hold samples of {source}: "
            "four states a gyro need four turns or rests at the least"
        )
    if not isinstance(recording.reference, Turns):
        _enough(recording, source, data, gram.rows)
    return gram


def block_rows(data: ImuData, length_s: float = BLOCK_S) -> int:
    """Return how many samples of this source make a block, by default of the live filter."""
    if len(data.t_ns) < 2:
        return 1
    return max(round(length_s / (float(np.median(np.diff(data.t_ns))) * 1e-9)), 1)


def observations(recording: Recording, source: str) -> Iterator[Observations]:
    """Yield rows of body rate and output of one source, in parts of bounded size, in order of time."""
    yield from _rows(recording, recording.sources[source])


def _rows(recording: Recording, data: ImuData) -> Iterator[Observations]:
    reference = recording.reference
    if isinstance(reference, TableReadings):
        yield from _table_rows(recording, data)
    elif isinstance(reference, RateReadings):
        yield from _rate_rows(reference, data)
    elif isinstance(reference, AttitudeReadings):
        yield from _means(data, rates_from_attitude(reference))
    else:
        yield _segments(data, reference)


def _table_rows(recording: Recording, data: ImuData) -> Iterator[Observations]:
    reference = recording.reference
    if not isinstance(reference, TableReadings):
        raise TypeError("rows against a table need one")
    rates = BodyRates(reference.gimbals, recording.site)
    rates.add(reference.t_ns, reference.angle_rad, reference.rate_rps)
    rates.finish()
    t_ns, rate = _inside(data, rates.starts_ns, rates.final_until_ns)
    for start, stop in _chunks(data, len(t_ns)):
        t = t_ns[start:stop]
        w = rates.at(t)
        known = np.isfinite(w).all(axis=1)
        if known.all():
            yield Observations(w, rate[start:stop], None, t)
        else:
            yield Observations(w[known], rate[start:stop][known], None, t[known])


def _rate_rows(reference: RateReadings, data: ImuData) -> Iterator[Observations]:
    known = np.isfinite(reference.rate_rps).all(axis=1)
    if not known.any():
        return
    at, rates = reference.t_ns[known], reference.rate_rps[known]
    t_ns, rate = _inside(data, int(at[0]), int(at[-1]))
    for start, stop in _chunks(data, len(t_ns)):
        t = t_ns[start:stop]
        w = np.column_stack([np.interp(t, at, rates[:, c]) for c in range(3)])
        yield Observations(w, rate[start:stop], None, t)


def _inside(data: ImuData, first_ns: int, last_ns: int) -> tuple[Stamps, Floats]:
    t_ns, rate = _usable(data)
    start, stop = np.searchsorted(t_ns, first_ns, side="left"), np.searchsorted(t_ns, last_ns, side="right")
    return t_ns[start:stop], rate[start:stop]


def _chunks(data: ImuData, rows: int) -> Iterator[tuple[int, int]]:
    """Yield bounds of parts of whole blocks, so that a replay is cut as the live run was."""
    block = block_rows(data)
    chunk = max(_CHUNK_ROWS // block, 1) * block
    for start in range(0, rows, chunk):
        yield start, min(start + chunk, rows)


def rest_spans(reference: TableReadings) -> list[tuple[int, int]]:
    """Return the spans (first, last) in ns of five seconds and more in which no axis of the table moves."""
    still = (np.abs(reference.rate_rps) < REST_RPS).all(axis=1)
    edges = np.flatnonzero(np.diff(still.astype(np.int8), prepend=0, append=0))
    spans = zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)
    found = [(int(reference.t_ns[a]), int(reference.t_ns[b - 1])) for a, b in spans]
    return [(a, b) for a, b in found if b - a >= REST_S * 1e9]


def motion_notes(recording: Recording) -> list[str]:
    """Return what the motion of a recording leaves unseen, in words."""
    reference = recording.reference
    if not isinstance(reference, TableReadings):
        return []
    moving = [
        axis
        for axis, rate in zip(reference.gimbals, reference.rate_rps.T, strict=True)
        if np.abs(rate).max(initial=0.0) > 10 * REST_RPS
    ]
    notes = []
    if not moving:
        notes.append(
            "the table does not move in this recording: only the bias can be estimated (Earth rate taken off if the "
            "site is known); scale factor error and misalignments need turns about three axes"
        )
    elif len(moving) < 3:
        notes.append(
            f"the table turns about {' and '.join(sorted(moving))} only: of each gyro the bias and its sensitivity to "
            "such turns can be estimated, not k, sigma_j and sigma_k each by itself; turn about all three axes"
        )
    if moving and not rest_spans(reference):
        notes.append(
            f"there is no rest of {REST_S:g} s in this recording: the noise is taken from the residual in motion "
            "alone; begin or end the script with a rest"
        )
    return notes


def _parity_notes(checks: list[GyroParity]) -> list[str]:
    suspects = [check for check in checks if check.suspect]
    if not suspects:
        return []
    worst = max(suspects, key=lambda check: check.worst_sigma)
    where = f"{worst.worst_sigma:.0f} sigma at {worst.worst_t_s:.0f} s"
    if worst.told_apart:
        return [f"{worst.name} disagrees with the other gyros of its device (parity {where}): check it"]
    return [f"the gyros {', '.join(c.name for c in suspects)} disagree (parity {where}): one of them is wrong"]


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
    t_ns, rate = data.t_ns, data.rate_rps
    finite = np.isfinite(rate).all(axis=1)
    if not finite.all():
        t_ns, rate = t_ns[finite], rate[finite]
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


def _clustered(
    recording: Recording, source: str, data: ImuData, solution: Solution, prior: Prior
) -> tuple[Floats, list[str]]:
    """Return covariances (m, 4, 4) that hold for residuals correlated within clusters of 5 s, and notes.

    Another instrument's errors (its filter, its delay, lost markers) are no white noise. The scores of a
    cluster are summed before they are squared (Liang, Zeger 1986), so what hangs together within it counts as
    one. No direction gets less than the white-noise covariance.
    """
    m = len(data.array)
    maps = regressor_maps(data.array)
    attitude = isinstance(recording.reference, AttitudeReadings)
    row_s = MEAN_S if attitude else BLOCK_S / block_rows(data)
    rows = max(round(CLUSTER_S / row_s), 1)
    scores = []
    for part in _rows(recording, data):
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
