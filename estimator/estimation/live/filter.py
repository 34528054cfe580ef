"""The live Kalman filter: filterpy, fed one orthogonally compressed block at a time."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from estimator.geometry.array import SensorArray
from estimator.geometry.model import Prior, regressor_maps
from estimator.types import Floats

_TINY = 1e-9  # in units of the columns, rad/s for most: above their rounding, far below any information on a state


@dataclass(frozen=True, slots=True, eq=False)
class Innovation:
    """The result of one update: normalised innovation squared, its degrees of freedom, and the normalised innovation
    (m,).
    """

    nis: float
    dof: int
    normalised: Floats


class LiveFilter:
    """Kalman filter over the constant states of the gyros of one source.

    A block of rows is turned by an orthogonal transform (QR of [1, w]) before the update: its first row is the block
    mean times sqrt(rows), the others hold what the body rate did within the block. Nothing is lost, the noise stays
    white, and a 4 kHz source costs what a 100 Hz one does. The states are deviations from nominal under a data-sheet
    prior, which keeps the covariance form exact.

    Each gyro may have further columns of its own, the effects of an error model, scaled so that their prior is one. The
    last state is the time offset of the samples against the table; with an expected sigma of 0 it stays 0.
    """

    def __init__(
        self, array: SensorArray, noise_rps: Floats, prior: Prior, further: int = 0, offset_sd_s: float = 0.0
    ) -> None:
        """Start all states at zero with the prior; ``noise_rps`` (m,) is the white noise of one sample.

        ``further`` is the number of columns that each gyro has beyond its four states. ``offset_sd_s`` is the expected
        sigma of the time offset, 0 for none.
        """
        from filterpy.kalman import KalmanFilter  # 0.8 s of import: only where a filter runs

        m = len(array)
        self._array = array
        self._maps = regressor_maps(array)
        self._noise = np.asarray(noise_rps, dtype=np.float64)
        self._width = 4 + further
        self._size = self._width * m + 1
        self._filter = KalmanFilter(dim_x=self._size, dim_z=self._size)
        self._filter.x = np.zeros((self._size, 1))
        own = np.tile(np.concatenate([prior.variances(), np.ones(further)]), m)
        self._filter.P = np.diag(np.append(own, offset_sd_s**2))
        self.nis_sum = 0.0
        self.nis_dof = 0

    def update(
        self,
        w_rps: Floats,
        y_rps: Floats,
        further: Floats | None = None,
        wdot_rps2: Floats | None = None,
        taken_off_s: float = 0.0,
    ) -> Innovation:
        """Update the states with finite body rates (rows, 3) and outputs (rows, m) of a block; return its innovation.

        ``further`` (rows, m, columns) are the columns of each gyro beyond its four states; None leaves these out.
        ``wdot_rps2`` (rows, 3) is the derivative of the body rate, by which the time offset shows; None leaves the
        offset out. ``taken_off_s`` is the offset that the body rates already allow for. The NIS is added to the sums.
        """
        z = y_rps - w_rps @ self._array.p.T
        regressors = np.column_stack([np.ones(len(z)), w_rps])
        if wdot_rps2 is not None:
            z = z - taken_off_s * (wdot_rps2 @ self._array.p.T)
        m, width = len(self._array), self._width
        shared = regressors if wdot_rps2 is None else np.hstack([regressors, wdot_rps2])
        apart = further is not None and width > 4
        kept = min(len(z), shared.shape[1] + (width - 4 if apart else 0))
        h, compressed = np.zeros((m * kept, self._size)), np.empty((m, kept))
        if not apart:  # all gyros have the same columns: compressed together
            turned, r = compressed_rows(shared, z)
            compressed[:] = turned.T
        for i in range(m):
            if apart:
                assert further is not None
                compressed[i], r = compressed_rows(np.hstack([shared, further[:, i]]), z[:, i])
            rows = slice(i * kept, (i + 1) * kept)
            h[rows, width * i : width * i + 4] = r[:, :4] @ self._maps[i].T
            if apart:
                h[rows, width * i + 4 : width * (i + 1)] = r[:, shared.shape[1] :]
            if wdot_rps2 is not None:
                h[rows, -1] = -r[:, 4:7] @ self._array.p[i]
        return self._take(compressed.reshape(-1, 1), h, kept)

    def tried(self, *block: Any) -> float:
        """Return the time offset in s that a block would give (arguments as for ``update``), without keeping the
        update.
        """
        before = self._filter.x, self._filter.P, self.nis_sum, self.nis_dof
        self.update(*block)
        found = self.offset_s
        self._filter.x, self._filter.P, self.nis_sum, self.nis_dof = before
        return found

    @property
    def offset_s(self) -> float:
        """Offset of the samples against the table, above zero for samples that are stamped late."""
        return float(self._filter.x[-1, 0])

    @property
    def offset_sd_s(self) -> float:
        """Standard deviation of the offset by now."""
        return float(np.sqrt(self._filter.P[-1, -1]))

    def _take(self, z: Floats, h: Floats, rows: int) -> Innovation:
        """Update the filter with ``rows`` compressed rows of each gyro, sorted by gyro; add the NIS to the sums.

        ``z`` (m rows, 1) are outputs, ``h`` (m rows, size) their columns. The result has the normalised innovation of
        the first row of each gyro.
        """
        m = len(self._array)
        variances = np.repeat(self._noise**2, rows)
        self._filter.update(z, R=np.diag(variances), H=h)
        innovation = self._filter.y[:, 0]
        nis = float(innovation @ self._filter.SI @ innovation)
        self.nis_sum += nis
        self.nis_dof += m * rows
        spread = np.sqrt(np.diag(self._filter.S))
        return Innovation(nis, m * rows, (innovation / spread).reshape(m, rows)[:, 0])

    @property
    def nis_mean(self) -> float:
        """Mean normalised innovation squared per degree of freedom so far; 1 for a filter that is right."""
        return self.nis_sum / self.nis_dof if self.nis_dof else float("nan")

    def state(self) -> tuple[Floats, Floats]:
        """Return the states x (m, 4) and their covariance (m, 4, 4)."""
        m, width = len(self._array), self._width
        x = np.array(self._filter.x[:-1, 0]).reshape(m, width)[:, :4]
        p = self._filter.P
        return x, np.array([p[width * i : width * i + 4, width * i : width * i + 4] for i in range(m)])


@lru_cache(maxsize=64)
def _slopes(rows: int, columns: int) -> Floats:
    """Return Legendre polynomials over a block (rows, columns), very small, and zero in place of the constant one."""
    slopes = np.polynomial.legendre.legvander(np.linspace(-1.0, 1.0, rows), columns - 1) * _TINY
    slopes[:, 0] = 0.0
    return np.asarray(slopes)


def compressed_rows(regressors: Floats, z: Floats) -> tuple[Floats, Floats]:
    """Apply one orthogonal transform to outputs (rows, m) or (rows,) and regressors (rows, c), leaving c rows or fewer.

    Return outputs, then regressors. The first column of the latter is 1: the first row is then the mean of a block
    times the root of its rows.

    At rest the columns of the body rate are constant, so that rounding would choose the directions that complete the
    transform, and the NIS of a recording would differ between processors. Therefore slope and bends of the block are
    added to the regressors for the choice of the transform, which is applied to the regressors themselves.
    """
    q, r = np.linalg.qr(regressors + _slopes(*regressors.shape))
    if r[0, 0] < 0:  # so that the first row is the mean itself, not its negative
        q = -q
    return q.T @ z, q.T @ regressors
