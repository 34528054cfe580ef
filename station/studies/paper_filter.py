"""The paper's own filter, for comparison on the same data, and the Cramer-Rao bound.

``w`` is the body rate (rows, 3), ``y`` the outputs (rows, n), both in rad/s. Operations are counted from the
dimensions, one multiplication, addition or division each.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.types import Floats
from estimator.geometry.array import SensorArray
from estimator.geometry.model import Prior, decode, regressor_maps


@dataclass(frozen=True, slots=True, eq=False)
class FilterRun:
    """States x (kept, n, 4) and covariance (kept, n, 4, 4) of a filter after each of the ``rows`` (kept,)."""

    rows: NDArray[np.int64]
    x: Floats
    covariance: Floats
    operations: int


def covariance_filter(
    w_rps: Floats, y_rps: Floats, array: SensorArray, prior_sd: Floats, noise_rps: float, *, every: int = 100
) -> FilterRun:
    """Run the paper's Kalman filter (eq. 8-13) on every sample: 4n states, n outputs, Joseph form.

    ``w_rps`` (N, 3) are body rates, ``y_rps`` (N, n) the outputs. ``prior_sd`` (4,) are the roots of P0 for [k, b, s_j,
    s_k], ``noise_rps`` the root of R. The result has each ``every``-th row and the last: states (k, b, (1 - k) s_j,
    (1 - k) s_k), their covariance by gyro, and the operations of all.
    """
    from filterpy.kalman import KalmanFilter  # 0.8 s of import: only where a filter runs

    rows, n = y_rps.shape
    kalman = KalmanFilter(dim_x=4 * n, dim_z=n)
    kalman.x = np.zeros((4 * n, 1))
    kalman.P = np.diag(np.tile(prior_sd**2, n))
    kalman.R = noise_rps**2 * np.eye(n)
    z = (y_rps - w_rps @ array.p.T)[:, :, None]
    by_gyro = np.einsum("rj,nij->rni", regressors(w_rps), regressor_maps(array))
    h = np.zeros((n, 4 * n))
    flat, own = h.reshape(-1), 4 * n * np.arange(n)[:, None] + np.arange(4 * n).reshape(n, 4)
    kept = sorted({*range(every - 1, rows, every), rows - 1})
    keep = set(kept)
    x, covariance = [], []
    for row in range(rows):
        flat[own] = by_gyro[row]
        kalman.update(z[row], H=h)
        if row in keep:
            x.append(kalman.x[:, 0].reshape(n, 4).copy())
            covariance.append([kalman.P[4 * i : 4 * i + 4, 4 * i : 4 * i + 4].copy() for i in range(n)])
    return FilterRun(np.array(kept), np.array(x), np.array(covariance), rows * _filter_operations(4 * n, n))


def bound(
    w_rps: Floats,
    array: SensorArray,
    states: Floats,
    prior: Prior,
    row_s: float,
    arw_rps_rthz: float,
    wander: Sequence[tuple[float, float]] = (),
) -> Floats:
    """Return the Cramer-Rao bound of the states (n, 4) as sigmas, for a noise that is known.

    ``w_rps`` (N, 3) are means over rows of ``row_s``, ``states`` (n, 4) the true ones. The noise is white plus
    Gauss-Markov processes, each given in ``wander`` by its standard deviation in rad/s and its correlation time in s.
    """
    from scipy.linalg import cho_factor, cho_solve, toeplitz  # slow to import

    lags_s = row_s * np.arange(len(w_rps))
    correlation = np.zeros(len(w_rps))
    for sd, time_s in wander:
        correlation += sd**2 * np.exp(-lags_s / time_s)
    correlation[0] += arw_rps_rthz**2 / row_s
    columns = regressors(w_rps)
    shared = columns.T @ cho_solve(cho_factor(toeplitz(correlation)), columns)
    maps = regressor_maps(array)
    covariance = np.linalg.inv(maps @ shared @ maps.transpose(0, 2, 1) + np.diag(1 / prior.variances()))
    x = np.array(states)
    x[:, 2:] *= 1 - x[:, :1]
    return decoded(x, covariance)[1]


def _filter_operations(states: int, outputs: int) -> int:
    """Return the operations of one dense update in Joseph form, as the equations stand, by states and outputs."""
    x = states
    z = outputs
    innovation = 2 * z * x + 2 * z * x * x + 2 * z * z * x  # y = z - H x, H P, (H P) H' + R
    gain = 2 * z**3 + 2 * x * x * z + 2 * x * z * z + 2 * x * z  # S^-1, P H', K, x + K y
    joseph = 2 * x * x * z + 4 * x**3 + 2 * x * z * z + 2 * x * x * z  # I - K H, (I - K H) P (I - K H)', K R K'
    return innovation + gain + joseph


def regressors(w_rps: Floats) -> Floats:
    """Return [1, w] (rows, 4)."""
    return np.column_stack([np.ones(len(w_rps)), w_rps])


def decoded(x: Floats, covariance: Floats) -> tuple[Floats, Floats]:
    """Return states and sigmas (n, 4) from x (n, 4) and its covariance (n, 4, 4)."""
    decoded = [decode(x_i, c_i) for x_i, c_i in zip(x, covariance, strict=True)]
    return np.array([states for states, _ in decoded]), np.array([np.sqrt(np.diag(c)) for _, c in decoded])
