"""Calibration against another instrument: an attitude, a rate, or stated turns."""

from __future__ import annotations

from typing import TypeGuard

import numpy as np
from numpy.typing import NDArray

from estimator.budget import Contribution
from estimator.calibration import Calibration, GyroCalibration, unseen_notes
from estimator.filter import LiveFilter
from estimator.gram import Solution, solve
from estimator.model import Prior, decode, regressor_maps
from estimator.recording import ImuData, Recording
from estimator.reference import AttitudeReadings, RateReadings, Reference, Turns, rates_from_attitude
from estimator.rests import REST_RPS
from estimator.rows import BLOCK_S, gram_of, row_length_s, rows_of, sample_noise

Floats = NDArray[np.float64]

CLUSTER_S = 5.0
"""Length over which residuals against a foreign reference may hang together without the sigma being wrong."""
FEWEST_CLUSTERS = 8
COLOURED = 2.0  # sigmas that grow by more than this are told
_TURNED = 1e-3  # share of the largest mean square rate from which on a direction counts as turned about
_FAR_OFF = 0.2  # a factor of the output this far from 1 is a wrong sign, unit or count


def against_foreign(recording: Recording, sources: list[tuple[str, ImuData]], innovations: bool) -> Calibration:
    gyros: list[GyroCalibration] = []
    notes = foreign_motion_notes(recording)
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
        rows = max(round(BLOCK_S / row_length_s(recording, data)), 1)
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
            notes.extend(factor_notes(name, float(states[0]), float(np.sqrt(covariance[0, 0]))))
    nis_mean = nis_sum / nis_dof if nis_dof else float("nan")
    return Calibration(tuple(gyros), nis_mean, samples, 0, tuple(notes))


def at_rest(reference: Reference) -> TypeGuard[RateReadings]:
    """Return whether a reference says of no instant that the body turned (faster than the Earth)."""
    if not isinstance(reference, RateReadings):
        return False
    rate = reference.rate_rps[np.isfinite(reference.rate_rps).all(axis=1)]
    return bool(len(rate) and (np.abs(rate) < REST_RPS).all())


def foreign_motion_notes(recording: Recording) -> list[str]:
    """Return what the motion that a rate or an attitude shows leaves unseen, in words."""
    reference = recording.reference
    if at_rest(reference):
        return [
            "the body rests wherever the reference knows of it: only the bias can be estimated; scale factor error and "
            "misalignments need turns about three axes"
        ]
    if not isinstance(reference, (RateReadings, AttitudeReadings)):
        return []
    rates = rates_from_attitude(reference) if isinstance(reference, AttitudeReadings) else reference
    rate = rates.rate_rps[np.isfinite(rates.rate_rps).all(axis=1)]
    if not len(rate):
        return []
    square, directions = np.linalg.eigh(rate.T @ rate)
    turned = directions[:, square > _TURNED * square[-1]].T
    if len(turned) > 2:
        return []
    what = " and ".join(_axis_words(direction) for direction in turned)
    return [
        f"the body turns about {what} only: of each gyro the bias and its sensitivity to such turns can be estimated "
        "(k of a gyro along that axis), not k, sigma_j and sigma_k each by itself; turn about all three axes"
    ]


def _axis_words(direction: Floats) -> str:
    largest = int(np.argmax(np.abs(direction)))
    if abs(direction[largest]) > 0.99:
        return "xyz"[largest]
    sign = np.sign(direction[largest])
    return "(" + ", ".join(f"{v:.2f}" for v in sign * direction) + ")"


def factor_notes(name: str, k: float, sd: float) -> list[str]:
    """Return, in words, that k is no scale factor error but a wrong sign or unit, if it is."""
    if abs(k) < _FAR_OFF + 3 * sd:
        return []
    if abs(k - 2) < _FAR_OFF:
        return [f"{name}: its output is opposite to the reference, so k is near 2: turn the sign of its axis"]
    return [
        f"{name}: its output is {1 - k:.3g} times what the reference says, which is no scale factor error of a gyro: "
        "check its unit, its count and its axis"
    ]


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
    rows = max(round(CLUSTER_S / row_length_s(recording, data)), 1)
    scores = []
    for part in rows_of(recording, data):
        regressors = np.column_stack([np.ones(len(part.w_rps)), part.w_rps])
        rest = part.y_rps - part.w_rps @ data.array.p.T
        rest -= np.einsum("rj,mij,mi->rm", regressors, maps, solution.x)
        products = regressors[:, :, None] * rest[:, None, :]
        scores.append(np.add.reduceat(products, np.arange(0, len(products), rows), axis=0))
    by_gyro = np.einsum("mij,cjm->mci", maps, np.vstack(scores)) / solution.noise_rps[:, None, None] ** 2
    count = by_gyro.shape[1]
    if count < FEWEST_CLUSTERS:
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
        if worst > COLOURED:
            notes.append(
                f"{name}: the residual is no white noise; sigmas are up to {worst:.1f} times those of white noise"
            )
    return out, notes
