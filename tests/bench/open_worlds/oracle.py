"""An oracle that knows the law and the noise: generalised least squares of the states and the true column."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, solve_triangular

from estimator.recordings.recording import Recording
from open_worlds.cases import ARRAY, INSTABILITY_DPH, RATE_HZ, Case, Made
from open_worlds.motion import DEG, Motion, motion_of

Floats = NDArray[np.float64]

_BLOCK = 20  # samples
_TIMES_S = np.array([1.0, 10.0, 100.0, 1000.0])
_SHARE = 0.664 / 0.775  # IEEE Std 952: a floor of 0.664 B, and that of a decade-spaced sum of processes of equal size


@dataclass(frozen=True, slots=True)
class Oracle:
    """True rms errors on the verification run (rad/s) of fits that know the noise.

    ``error_rps`` is that of the states and the law, ``states_rps`` that of the states alone, ``chance_rps`` what the
    noise of these recordings makes of the states if nothing else is there.
    """

    error_rps: float
    states_rps: float
    chance_rps: float

    @property
    def gain(self) -> float:
        """By how much knowing the law lowers the error: a case in which it hardly does shows nothing."""
        return self.states_rps / self.error_rps


def oracle_of(case: Case, made: Made) -> Oracle:
    """Return the oracle's errors; that with the law is NaN for a kind that is no function of what was measured."""
    motions = [motion_of(name) for name in case.scripts]
    squares, alone, chances = [], [], []
    for gyro in range(len(ARRAY)):
        largest = max(float(np.abs(c[:, gyro]).max()) for c in made.columns)
        designs = [
            np.column_stack([_states(motion, gyro), column[:, gyro] / (largest or 1.0)])
            for motion, column in zip(motions, made.columns, strict=True)
        ]
        designs = designs if largest else [d[:, :4] for d in designs]
        white, truth = [], []
        for design, motion, recording in zip(designs[:2], motions[:2], made.fitted, strict=True):
            z = _output_error(recording, motion, gyro)
            root = _noise_root(len(z) // _BLOCK, case.law.arw_dps)
            white.append(solve_triangular(root, _means(design), lower=True))
            truth.append(solve_triangular(root, _means(z[:, None]), lower=True))
        fitted, wanted = np.vstack(white), np.vstack(truth)[:, 0]
        held_out = _output_error(made.clean, motions[2], gyro)
        squares.append(_held_out_square(fitted, wanted, designs[2], held_out))
        alone.append(_held_out_square(fitted[:, :4], wanted, designs[2][:, :4], held_out))
        covariance = np.linalg.inv(fitted[:, :4].T @ fitted[:, :4])
        chances.append(np.mean(np.einsum("ni,ij,nj->n", designs[2][:, :4], covariance, designs[2][:, :4])))
    error = float(np.sqrt(np.mean(squares))) if case.law.measured else float("nan")
    return Oracle(error, float(np.sqrt(np.mean(alone))), float(np.sqrt(np.mean(chances))))


def _held_out_square(fitted: Floats, wanted: Floats, design: Floats, held_out: Floats) -> float:
    """Return the mean square of what a least-squares fit leaves of a run that it has not seen."""
    coefficients = np.linalg.lstsq(fitted, wanted, rcond=None)[0]
    return float(np.mean((held_out - design @ coefficients) ** 2))


def _states(motion: Motion, gyro: int) -> Floats:
    """Return the regressors (n, 4) of k, b and the tilts: y - p.w = -k p.w - b + s_j k.w - s_k j.w."""
    w = motion.inertial_rps
    p, j, k = (axes[gyro] for axes in (ARRAY.p, ARRAY.j, ARRAY.k))
    return np.column_stack([-w @ p, np.full(len(w), -1.0), w @ k, -w @ j])


def _output_error(recording: Recording, motion: Motion, gyro: int) -> Floats:
    return np.asarray(recording.sources["array"].rate_rps[:, gyro] - motion.inertial_rps @ ARRAY.p[gyro])


def _means(rows: Floats) -> Floats:
    count = len(rows) // _BLOCK
    return np.asarray(rows[: count * _BLOCK].reshape(count, _BLOCK, -1).mean(axis=1))


@lru_cache(maxsize=8)
def _noise_root(blocks: int, arw_dps: float) -> Floats:
    """Return the Cholesky factor (blocks, blocks) of the covariance of block means: white noise, bias instability."""
    block_s = _BLOCK / RATE_HZ
    apart_s = np.abs(np.subtract.outer(np.arange(blocks), np.arange(blocks))) * block_s
    wander = (_SHARE * INSTABILITY_DPH * DEG / 3600) ** 2 * sum(np.exp(-apart_s / tau) for tau in _TIMES_S.tolist())
    return np.asarray(cholesky(wander + (arw_dps * DEG) ** 2 / block_s * np.eye(blocks), lower=True))
