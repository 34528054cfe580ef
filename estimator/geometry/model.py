"""The error model of a sensor: four constant states, and the data-sheet prior on them.

It is written for a gyro, whose input w is the body rate. That of an accelerometer has the same form with the specific
force at its place as input, in m/s2.

The filter and the batch estimate work in ``x = [k, b, s_j, s_k]`` with ``s = (1 - k) sigma``. In these the
output error is linear without any approximation, with the paper's own regressors (eq. 13):

    z = y - p.w = [-p.w, -1, k.w, -j.w] x - eta

because ``(1 - k) pbar = p - k p - s_k j + s_j k`` exactly. Decoding ``sigma = s / (1 - k)`` at the end keeps
the product of scale factor error and misalignment that the paper drops (0.5 % of sigma at 5000 ppm).
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from estimator.geometry.array import SensorArray
from estimator.sensors.gyros import GYRO
from estimator.types import Floats

STATES = GYRO.keys
"""Names of the decoded states of a gyro, in the order of every vector and matrix of states."""


class StatePrior(Protocol):
    """What a data sheet expects of the states of a sensor."""

    def variances(self) -> Floats:
        """Return the variances of [k, b, s_j, s_k]."""


@dataclass(frozen=True, slots=True)
class Prior:
    """Standard deviations of the states about zero, from a data sheet."""

    k: float = 0.05
    b_rps: float = float(np.radians(1.0))
    sigma_rad: float = 0.02

    def variances(self) -> Floats:
        """Return the prior variances of [k, b, s_j, s_k]."""
        return np.array([self.k, self.b_rps, self.sigma_rad, self.sigma_rad]) ** 2


@dataclass(frozen=True, slots=True, kw_only=True)
class ForcePrior:
    """Standard deviations about zero of the states of an accelerometer, and of where it sits.

    ``arm_m`` is that of each component of the lever arm from the point in which the axes of the table meet, ``apart_m``
    that of the places of the single accelerometers about it.
    """

    k: float = 0.05
    b_mps2: float = 1.0
    sigma_rad: float = 0.05
    arm_m: float = 0.3
    apart_m: float = 0.005

    def variances(self) -> Floats:
        """Return the prior variances of [k, b, s_j, s_k]."""
        return np.array([self.k, self.b_mps2, self.sigma_rad, self.sigma_rad]) ** 2


def regressor_maps(array: SensorArray) -> Floats:
    """Return A (n, 4, 4) such that the regressors of gyro i on its states are ``A[i] @ [1, wx, wy, wz]``.

    The states are the encoded x = [k, b, s_j, s_k].
    """
    maps = np.zeros((len(array), 4, 4))
    maps[:, 0, 1:] = -array.p
    maps[:, 1, 0] = -1.0
    maps[:, 2, 1:] = array.k
    maps[:, 3, 1:] = -array.j
    return maps


def decode(x: Floats, covariance: Floats) -> tuple[Floats, Floats]:
    """Return the states [k, b, sigma_j, sigma_k] and their covariance (4, 4) from the estimated x (4,) of one gyro."""
    gain = 1.0 - x[0]
    states = np.array([x[0], x[1], x[2] / gain, x[3] / gain])
    jacobian = decoding(x)
    return states, jacobian @ covariance @ jacobian.T


def decoding(x: Floats) -> Floats:
    """Return the derivatives (4, 4) of the states that ``decode`` returns, by x (4,)."""
    gain = 1.0 - x[0]
    jacobian = np.diag([1.0, 1.0, 1 / gain, 1 / gain])
    jacobian[2:, 0] = x[2:] / gain**2
    return jacobian


def predicted_output(array: SensorArray, states: Floats, w_rps: Floats) -> Floats:
    """Return the output (rows, n) of an array with ``states`` (n, 4) at body rates (rows, 3), in rad/s."""
    pbar = array.p - states[:, 3:4] * array.j + states[:, 2:3] * array.k
    return np.asarray((1 - states[:, 0]) * (w_rps @ pbar.T) - states[:, 1])
