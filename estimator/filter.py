"""The live Kalman filter: filterpy, fed one orthogonally compressed block at a time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.array import SensorArray
from estimator.model import Prior, regressor_maps

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Innovation:
    """What one update said: normalised innovation squared, its degrees of freedom, and it by channel (m,)."""

    nis: float
    dof: int
    normalised: Floats


class LiveFilter:
    """Kalman filter over the constant states of the gyros of one source.

    A block of rows is turned by an orthogonal transform (QR of [1, w]) before the update: its first row is the
    block mean times sqrt(rows), the others hold what the body rate did within the block. Nothing is lost, the
    noise stays white, and a 4 kHz source costs what a 100 Hz one does. The states are deviations from nominal
    under a data-sheet prior, which is what keeps the covariance form exact.
    """

    def __init__(self, array: SensorArray, noise_rps: Floats, prior: Prior) -> None:
        """Start at zero with the prior; ``noise_rps`` (m,) is the white noise of one sample."""
        from filterpy.kalman import KalmanFilter  # 0.8 s of import: only where a filter runs

        m = len(array)
        self._array = array
        self._maps = regressor_maps(array)
        self._noise = np.asarray(noise_rps, dtype=np.float64)
        self._filter = KalmanFilter(dim_x=4 * m, dim_z=4 * m)
        self._filter.x = np.zeros((4 * m, 1))
        self._filter.P = np.diag(np.tile(prior.variances(), m))
        self.nis_sum = 0.0
        self.nis_dof = 0

    def update(self, w_rps: Floats, y_rps: Floats) -> Innovation:
        """Take in body rates (rows, 3) and outputs (rows, m) of one block; return its innovation."""
        rows, m = y_rps.shape
        z = y_rps - w_rps @ self._array.p.T
        regressors = np.empty((rows, 4))
        regressors[:, 0] = 1.0
        regressors[:, 1:] = w_rps
        q, r = np.linalg.qr(regressors)  # r is (min(rows, 4), 4)
        if r[0, 0] < 0:  # so that the first row is the mean itself, not its negative
            q, r = -q, -r
        compressed = q.T @ z
        kept = len(r)
        h = np.zeros((m * kept, 4 * m))
        for i in range(m):
            h[i * kept : (i + 1) * kept, 4 * i : 4 * i + 4] = r @ self._maps[i].T
        variances = np.repeat(self._noise**2, kept)
        self._filter.update(compressed.T.reshape(-1, 1), R=np.diag(variances), H=h)
        innovation = self._filter.y[:, 0]
        nis = float(innovation @ self._filter.SI @ innovation)
        self.nis_sum += nis
        self.nis_dof += m * kept
        spread = np.sqrt(np.diag(self._filter.S))
        return Innovation(nis, m * kept, (innovation / spread).reshape(m, kept)[:, 0])

    @property
    def nis_mean(self) -> float:
        """Mean normalised innovation squared per degree of freedom so far; 1 for a filter that is right."""
        return self.nis_sum / self.nis_dof if self.nis_dof else float("nan")

    def state(self) -> tuple[Floats, Floats]:
        """Return the states x (m, 4) and their covariance (m, 4, 4)."""
        m = len(self._array)
        x = np.array(self._filter.x[:, 0]).reshape(m, 4)
        p = self._filter.P
        return x, np.array([p[4 * i : 4 * i + 4, 4 * i : 4 * i + 4] for i in range(m)])
