"""Sums of rows over short blocks of time: all that estimates, noise and residuals need of a long recording."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimator.geometry.array import SensorArray
from estimator.geometry.model import regressor_maps
from estimator.recordings.motion.growing_rows import GrowingRows
from estimator.types import Floats


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class Blocks:
    """Means over blocks of ``length_s``, and the variation within them.

    ``index`` (B,) numbers the blocks from an origin common to all sources, ``rows`` (B,) counts the samples in each;
    ``w_rps`` (B, 3) and ``z_rps`` (B, m) are means of body rate and output error. ``within`` (3 + m, 3 + m) sums the
    products of [w, z] minus their block means over all rows; ``period_s`` is the sampling period.
    """

    index: NDArray[np.int64]
    rows: NDArray[np.int64]
    w_rps: Floats
    z_rps: Floats
    within: Floats
    length_s: float
    period_s: float

    @property
    def t_s(self) -> Floats:
        """Middle of each block in seconds from the common origin (B,)."""
        return np.asarray((self.index + 0.5) * self.length_s, dtype=np.float64)

    @property
    def held_s(self) -> Floats:
        """Time that the samples of each block cover (B,), in whole twentieths of the block, never none."""
        share = np.round(20 * self.rows * self.period_s / self.length_s)
        return np.asarray(np.clip(share, 1, 20) / 20 * self.length_s)

    def merged(self, factor: int) -> "Blocks":
        """Return blocks ``factor`` times as long; differences between the short ones become part of ``within``.

        Each is weighed by its rows. The same object for a factor of 1.
        """
        if factor == 1:
            return self
        long = self.index // factor
        first = np.flatnonzero(np.diff(long, prepend=long[:1] - 1))
        rows = np.add.reduceat(self.rows, first)
        columns = np.hstack([self.w_rps, self.z_rps])
        means = np.add.reduceat(columns * self.rows[:, None], first) / rows[:, None]
        spread = columns - np.repeat(means, np.diff(np.append(first, len(long))), axis=0)
        within = self.within + (spread * self.rows[:, None]).T @ spread
        return Blocks(
            index=long[first],
            rows=rows,
            w_rps=means[:, :3],
            z_rps=means[:, 3:],
            within=within,
            length_s=self.length_s * factor,
            period_s=self.period_s,
        )

    def select(self, keep: NDArray[np.bool_]) -> "Blocks":
        """Return the means of some blocks; the scatter within blocks stays that of all."""
        return replace(
            self, index=self.index[keep], rows=self.rows[keep], w_rps=self.w_rps[keep], z_rps=self.z_rps[keep]
        )


class BlockSums:
    """Sums rows by block, in order of time."""

    def __init__(self, channels: int, origin_ns: int, length_s: float, period_s: float) -> None:
        """Start empty; blocks are counted from ``origin_ns``."""
        self._origin_ns, self._length_s, self._period_s = origin_ns, length_s, period_s
        width = 3 + channels
        self._parts = GrowingRows(index=np.int64, rows=np.int64, sums=(width,))
        self._products, self._shift = np.zeros((width, width)), np.zeros(width)

    def add(self, t_ns: NDArray[np.int64], w_rps: Floats, z_rps: Floats) -> None:
        """Add instants (rows,), body rates (rows, 3) and output errors (rows, m), all finite and later than all before.

        No rows change nothing.
        """
        if not len(t_ns):
            return
        columns = np.empty((len(t_ns), self._products.shape[0]))
        columns[:, :3], columns[:, 3:] = w_rps, z_rps
        if not len(self._parts):
            self._shift[3:] = columns[0, 3:]
        columns -= self._shift  # constant errors dwarf the noise: without them the products keep its digits
        number = (t_ns - self._origin_ns) // round(self._length_s * 1e9)
        first = np.flatnonzero(np.diff(number, prepend=number[:1] - 1))
        rows = np.diff(np.append(first, len(number)))
        self._parts.append(number[first], rows, np.add.reduceat(columns, first, axis=0))
        self._products += columns.T @ columns

    def blocks(self) -> Blocks:
        """Return the means of the blocks so far, the last of which may be incomplete, and the products within
        blocks.
        """
        index, rows, sums = (self._parts[name] for name in ("index", "rows", "sums"))
        first = np.flatnonzero(np.diff(index, prepend=index[:1] - 1))  # a block may come in two parts
        index, rows, sums = index[first], np.add.reduceat(rows, first), np.add.reduceat(sums, first, axis=0)
        means = sums / rows[:, None]
        within = self._products - sums.T @ means
        means = means + self._shift
        return Blocks(
            index=index,
            rows=rows,
            w_rps=means[:, :3],
            z_rps=means[:, 3:],
            within=within,
            length_s=self._length_s,
            period_s=self._period_s,
        )


def block_squares(
    blocks: Blocks, array: SensorArray, x: Floats, noise_rps: Floats, file: NDArray[np.intp]
) -> tuple[float, int]:
    """Return the squares of block residuals relative to white noise, summed, and their degrees of freedom.

    The residual is that of the encoded states ``x`` (m, 4), ``noise_rps`` (m,) the noise of one sample. If ``file``
    (B,), the number of the file, has several values, each file has its own bias, which does not count as scatter.
    """
    regressors = np.column_stack([np.ones(len(blocks.index)), blocks.w_rps])
    rest = blocks.z_rps - np.einsum("rj,mij,mi->rm", regressors, regressor_maps(array), x)
    files = np.unique(file)
    for number in files.tolist() if len(files) > 1 else ():
        own = file == number
        rest[own] -= np.average(rest[own], axis=0, weights=blocks.rows[own])
    squares = float(np.sum(blocks.rows[:, None] * (rest / noise_rps) ** 2))
    return squares, max(rest.size - (3 + len(files)) * len(array), 0)
