"""Two files whose clocks run apart: found by comparing the turn of the one with the integrated output of the other."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Floats
from estimator.turned import REST_RPS, Turned

_BLOCK_S, _WINDOWS, _WINDOW_S = 0.1, 60, 5.0  # at most so many windows, none shorter
_FEWEST = 8
_STEP_S, _REACH_S = 0.02, 0.5  # of the delays that are tried
_ALIKE = 0.05  # share of what a fit takes away
_FASTEST = 3e-4  # no two crystals are further apart
_NEAR_S = (0.02, 0.02, 0.01, 0.01, 0.005, 0.005, 0.002, 0.002, 0.002)  # to each side of a delay, compared in turn
_TOLD, _TOLD_S = 5.0, 1e-3  # sigmas, and seconds over the whole, from which on clocks run apart
_RIDGE = 1e-9
_COARSE_S = 0.05


@dataclass(frozen=True, slots=True)
class Clocks:
    """By how much the stamps of a reference are ahead of the gyros' at ``middle_s``, and what a second adds to that."""

    ahead_s: float
    drift: float
    ahead_sd_s: float
    drift_sd: float
    middle_s: float

    def ahead_at(self, t_s: float) -> tuple[float, float]:
        """Return by how much the stamps are ahead at an instant, and its standard uncertainty."""
        since_s = t_s - self.middle_s
        return self.ahead_s + self.drift * since_s, float(np.hypot(self.ahead_sd_s, self.drift_sd * since_s))

    def put_right(self, stamps_s: Floats) -> Floats:
        """Return stamps (k,) of the reference on the gyros' clock."""
        since_s = stamps_s - self.middle_s
        return np.asarray(self.middle_s + (since_s - self.ahead_s) / (1 + self.drift))


def clocks_apart(gyros: Turned, body: Turned, p: Floats | None = None) -> Clocks | None:
    """Return how the clock of a reference runs against the gyros'; None if they run alike, or nothing tells.

    ``p`` (m, 3) are the gyros' axes, if their signs are known. In windows the mean outputs of 0.1 s are fitted by bias
    and body rate at every delay; the line of delays that leaves least of all windows is refined by Newton, and its
    covariance is that of the windows' scores (sandwich).
    """
    first_s, last_s = max(gyros.t_s[0], body.t_s[0]), min(gyros.t_s[-1], body.t_s[-1])
    step_s = max(_BLOCK_S, *(2 * float(np.median(np.diff(one.t_s))) for one in (gyros, body)))
    edges = np.arange(first_s, last_s, step_s)
    windows = min(_WINDOWS, int((last_s - first_s) / _WINDOW_S))
    if windows < _FEWEST or np.abs(np.diff(body.integral, axis=0)).sum() < REST_RPS * (last_s - first_s):
        return None
    number = (np.arange(len(edges) - 1) * windows) // (len(edges) - 1)
    begin, end = edges[:-1], edges[1:]
    y = gyros.means(begin, end)
    at_s = 0.5 * (begin + end) - (middle_s := 0.5 * (first_s + last_s))
    centre_s = np.bincount(number, at_s) / np.bincount(number)

    def left(delay_s: Floats | float) -> Floats:
        """Return what is left (windows,) of the outputs, the reference read so much later."""
        return _left(y, body.means(begin + delay_s, end + delay_s), number, p)

    tried_s = np.arange(-_REACH_S, _REACH_S + _STEP_S / 2, _STEP_S) * (1 + 2 * _FASTEST * (last_s - first_s))
    every = np.column_stack([left(delay) for delay in tried_s.tolist()])
    slopes = np.linspace(-_FASTEST, _FASTEST, 2 * int(_FASTEST * (last_s - first_s) / _STEP_S) + 3)
    sums = np.array(
        [
            np.sum([np.interp(tried_s + d * c, tried_s, row) for c, row in zip(centre_s, every, strict=True)], axis=0)
            for d in slopes
        ]
    )
    # A motion that comes again fits as well a period later: of lines that are alike, the one of less delay.
    sums += _ALIKE * (np.median(sums) - sums.min()) * (tried_s / _REACH_S) ** 2
    best = np.unravel_index(np.argmin(sums), sums.shape)
    line = np.array([tried_s[best[1]], slopes[best[0]]])
    rows = np.column_stack([np.ones(windows), centre_s])
    for near_s in _NEAR_S:
        before, here, after = (left(line[0] + line[1] * at_s + by) for by in (-near_s, 0.0, near_s))
        slope, bend = (after - before) / (2 * near_s), np.maximum(after - 2 * here + before, 0.0) / near_s**2
        hessian = (rows * bend[:, None]).T @ rows
        step = np.linalg.lstsq(hessian, rows.T @ slope)[0]
        line = line - step / max(float(np.abs(rows @ step).max()) / near_s, 1.0)
    inverse = np.linalg.pinv(hessian)
    scores = rows * slope[:, None]
    sd = np.sqrt(np.diag(inverse @ (scores.T @ scores) @ inverse) * windows / (windows - 2))
    if abs(line[1]) < max(_TOLD * sd[1], _TOLD_S / (last_s - first_s)):
        return None
    return Clocks(*line.tolist(), *sd.tolist(), middle_s)


def ahead_by_motion(gyros: Turned, body: Turned, p: Floats | None) -> float:
    """Return by how much (s) stamps of a reference are ahead where its turns fit those of the gyros best, to 50 ms.

    ``p`` (m, 3) are the gyros' axes as in ``clocks_apart``. Largest correlation of the rates, over all of both files.
    """
    from scipy.signal import correlate

    def even(one: Turned) -> Floats:
        edges = np.arange(one.t_s[0], one.t_s[-1], _COARSE_S)
        means = one.means(edges[:-1], edges[1:])
        return np.nan_to_num(means - np.nanmean(means, axis=0))

    y, w = even(gyros), even(body)
    pairs = zip((w @ p.T).T, y.T, strict=True) if p is not None else ((a, b) for a in w.T for b in y.T)
    alike = sum(
        correlate(a, b, method="fft") if p is not None else np.abs(correlate(a, b, method="fft")) for a, b in pairs
    )
    return float(body.t_s[0] - gyros.t_s[0] + _COARSE_S * (int(np.argmax(alike)) - len(y) + 1))


def _left(y: Floats, w: Floats, number: NDArray[np.intp], p: Floats | None) -> Floats:
    """Return the squares (windows,) that bias and rates (n, 3) leave of outputs (n, m)."""
    known = np.isfinite(y).all(axis=1) & np.isfinite(w).all(axis=1)
    h = np.where(known[:, None], np.column_stack([np.ones(len(w)), w]), 0.0)
    z = np.where(known[:, None], y, 0.0)
    starts = np.flatnonzero(np.diff(number, prepend=-1))

    def by_window(a: Floats, b: Floats) -> Floats:
        return np.asarray(np.add.reduceat(a[:, :, None] * b[:, None, :], starts, axis=0))

    square, product, whole = by_window(h, h), by_window(h, z), by_window(z, z)
    scale = np.trace(square, axis1=1, axis2=2)[:, None, None] + 1e-30
    fit = np.linalg.solve(square + _RIDGE * scale * np.eye(4), product)
    taken = np.einsum("kij,kij->kj", product, fit)
    if p is not None:
        taken = np.where(np.einsum("kij,ji->kj", fit[:, 1:], p) > 0, taken, 0.0)
    left = np.trace(whole, axis1=1, axis2=2) - taken.sum(axis=1)
    count = np.maximum(np.bincount(number, known), 1)
    return np.asarray(left / count * np.bincount(number))
