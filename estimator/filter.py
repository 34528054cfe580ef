"""The live Kalman filter: filterpy, fed one orthogonally compressed block at a time."""

from dataclasses import dataclass

import numpy as np

from estimator.array import SensorArray
from estimator.arrays import Floats
from estimator.model import Prior, regressor_maps


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

    Each gyro may have further columns of its own, the effects of an error model, scaled so that their prior is one.
    """

    def __init__(self, array: SensorArray, noise_rps: Floats, prior: Prior, further: int = 0) -> None:
        """Start at zero with the prior; ``noise_rps`` (m,) is the white noise of one sample.

        ``further``: how many columns beyond the four states each gyro has.
        """
        from filterpy.kalman import KalmanFilter  # 0.8 s of import: only where a filter runs

        m = len(array)
        self._array = array
        self._maps = regressor_maps(array)
        self._noise = np.asarray(noise_rps, dtype=np.float64)
        self._width = 4 + further
        self._filter = KalmanFilter(dim_x=self._width * m, dim_z=self._width * m)
        self._filter.x = np.zeros((self._width * m, 1))
        self._filter.P = np.diag(np.tile(np.concatenate([prior.variances(), np.ones(further)]), m))
        self.nis_sum = 0.0
        self.nis_dof = 0

    def update(self, w_rps: Floats, y_rps: Floats, further: Floats | None = None) -> Innovation:
        """Take in body rates (rows, 3) and outputs (rows, m) of one block; return its innovation.

        ``further`` (rows, m, columns): the columns that each gyro has beyond the four states.
        """
        rows, m = y_rps.shape
        z = y_rps - w_rps @ self._array.p.T
        regressors = np.empty((rows, 4))
        regressors[:, 0] = 1.0
        regressors[:, 1:] = w_rps
        if further is not None and self._width > 4:
            return self._update_each(regressors, z, further)
        compressed, r = _compressed(regressors, z)
        kept = len(r)  # r is (min(rows, 4), 4)
        h = np.zeros((m * kept, 4 * m))
        for i in range(m):
            h[i * kept : (i + 1) * kept, 4 * i : 4 * i + 4] = r @ self._maps[i].T
        return self._take(compressed.T.reshape(-1, 1), h, kept)

    def _update_each(self, regressors: Floats, z: Floats, further: Floats) -> Innovation:
        """Update with columns that differ by gyro: each is compressed by itself."""
        m, width = len(self._array), self._width
        kept = min(len(z), width)
        h, compressed = np.zeros((m * kept, width * m)), np.empty((m, kept))
        for i in range(m):
            compressed[i], r = _compressed(np.hstack([regressors, further[:, i]]), z[:, i])
            rows = slice(i * kept, (i + 1) * kept)
            h[rows, width * i : width * i + 4] = r[:, :4] @ self._maps[i].T
            h[rows, width * i + 4 : width * (i + 1)] = r[:, 4:]
        return self._take(compressed.reshape(-1, 1), h, kept)

    def _take(self, z: Floats, h: Floats, kept: int) -> Innovation:
        """Update with ``kept`` compressed rows of each gyro, one gyro after the other."""
        m = len(self._array)
        variances = np.repeat(self._noise**2, kept)
        self._filter.update(z, R=np.diag(variances), H=h)
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
        m, width = len(self._array), self._width
        x = np.array(self._filter.x[:, 0]).reshape(m, width)[:, :4]
        p = self._filter.P
        return x, np.array([p[width * i : width * i + 4, width * i : width * i + 4] for i in range(m)])


def _compressed(regressors: Floats, z: Floats) -> tuple[Floats, Floats]:
    """Return outputs turned by an orthogonal transform, and what it makes of the regressors: a triangle of few rows."""
    q, r = np.linalg.qr(regressors)
    if r[0, 0] < 0:  # so that the first row is the mean itself, not its negative
        q, r = -q, -r
    return q.T @ z, r
