"""The error model of a gyro: four constant states, and the data-sheet prior on them.

The filter and the batch estimate work in ``x = [k, b, s_j, s_k]`` with ``s = (1 - k) sigma``. In these the
output error is linear without any approximation, with the paper's own regressors (eq. 13):

    z = y - p.w = [-p.w, -1, k.w, -j.w] x - eta

because ``(1 - k) pbar = p - k p - s_k j + s_j k`` exactly. Decoding ``sigma = s / (1 - k)`` at the end keeps
the product of scale factor error and misalignment that the paper drops (0.5 % of sigma at 5000 ppm).
"""

from dataclasses import dataclass

import numpy as np

from estimator.geometry.array import SensorArray
from estimator.sensors.gyros import GYRO
from estimator.types import Floats

STATES = GYRO.keys
"""Names of the decoded states of a gyro, in the order of every vector and matrix of states."""


@dataclass(frozen=True, slots=True)
class Prior:
    """Standard deviations of the states about zero, from a data sheet."""

    k: float = 0.05
    b_rps: float = float(np.radians(1.0))
    sigma_rad: float = 0.02

    def variances(self) -> Floats:
        """Return the prior variances of [k, b, s_j, s_k]."""
        return np.array([self.k, self.b_rps, self.sigma_rad, self.sigma_rad]) ** 2


def regressor_maps(array: SensorArray) -> Floats:
    """Return A (n, 4, 4) such that the regressors of gyro i on its states are ``A[i] @ [1, wx, wy, wz]``."""
    maps = np.zeros((len(array), 4, 4))
    maps[:, 0, 1:] = -array.p
    maps[:, 1, 0] = -1.0
    maps[:, 2, 1:] = array.k
    maps[:, 3, 1:] = -array.j
    return maps


def decode(x: Floats, covariance: Floats) -> tuple[Floats, Floats]:
    """Return the states [k, b, sigma_j, sigma_k] and their covariance (4, 4) from the estimated x (4,) of one gyro."""
    k = x[0]
    gain = 1.0 - k
    jacobian = np.diag([1.0, 1.0, 1 / gain, 1 / gain])
    jacobian[2:, 0] = x[2:] / gain**2
    states = np.array([k, x[1], x[2] / gain, x[3] / gain])
    return states, jacobian @ covariance @ jacobian.T


def predicted_output(array: SensorArray, states: Floats, w_rps: Floats) -> Floats:
    """Return the output (rows, n) of an array with ``states`` (n, 4) at body rates (rows, 3), in rad/s."""
    pbar = array.p - states[:, 3:4] * array.j + states[:, 2:3] * array.k
    return np.asarray((1 - states[:, 0]) * (w_rps @ pbar.T) - states[:, 1])
