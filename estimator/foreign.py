"""Calibration against another instrument: an attitude, a rate, or stated turns."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from estimator.budget import Contribution
from estimator.calibration import Calibration, GyroCalibration, unseen_notes
from estimator.filter import LiveFilter
from estimator.gram import Solution, solve
from estimator.model import Prior, decode, regressor_maps
from estimator.recording import ImuData, Recording
from estimator.reference import AttitudeReadings, RateReadings, Turns
from estimator.rows import BLOCK_S, MEAN_S, block_rows, gram_of, rows_of, sample_noise

Floats = NDArray[np.float64]

CLUSTER_S = 5.0
"""Length over which residuals against a foreign reference may hang together without the sigma being wrong."""
_FEWEST_CLUSTERS = 8
_COLOURED = 2.0  # sigmas that grow by more than this are told


def against_foreign(recording: Recording, sources: list[tuple[str, ImuData]], innovations: bool) -> Calibration:
    gyros: list[GyroCalibration] = []
    notes: list[str] = []
    nis_sum, nis_dof, samples = 0.0, 0, 0
    for source, data in sources:
        gram, prior = gram_of(recording, source, data), data.prior
        noise = None
        if isinstance(recording.reference, Turns):  # a few rows: their doubt is stated, not found
            # The rows are weighted by the noise of the worst channel, so that is what the noise is relative to.
            noise = np.maximum(sample_noise(data).max(), solve(gram, data.array, prior).noise_rps)
        solution = solve(gram, data.array, prior, noise)
        # The innovations need the noise that the batch estimate finds, so the rows are walked twice.
        live = LiveFilter(data.array, solution.noise_rps, prior)
        rows = 1 if isinstance(recording.reference, AttitudeReadings) else block_rows(data)
        for part in rows_of(recording, data) if innovations else ():
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
            notes.extend(unseen_notes(name, covariances[i], prior))
    nis_mean = nis_sum / nis_dof if nis_dof else float("nan")
    return Calibration(tuple(gyros), nis_mean, samples, 0, tuple(notes))


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
    for part in rows_of(recording, data):
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
