"""Two files whose clocks run apart: found by comparing the turn of the one with the integrated output of the other."""

from dataclasses import dataclass

import numpy as np

from estimator.observations.turned import REST_RPS, Turned
from estimator.types import Floats

_BLOCK_S, _WINDOWS, _WINDOW_S = 0.1, 60, 5.0  # the largest number of windows, and the shortest
_FEWEST = 8
_STEP_S, _REACH_S = 0.02, 0.5  # of the delays that are tried
_ALIKE = 0.05  # share that a fit explains
_FASTEST = 3e-4  # no two crystals are further apart
_NEAR_S = (0.02, 0.02, 0.01, 0.01, 0.005, 0.005, 0.002, 0.002, 0.002)  # to each side of a delay, compared in turn
_TOLD, _TOLD_S = 5.0, 1e-3  # sigmas, and seconds over the whole, from which on clocks run apart
_COARSE_S = 0.05


@dataclass(frozen=True, slots=True)
class Clocks:
    """How far the stamps of a reference are ahead of the gyros' at ``middle_s``, and by how much that grows per
    second.
    """

    ahead_s: float
    drift: float
    ahead_sd_s: float
    drift_sd: float
    middle_s: float

    def put_right(self, stamps_s: Floats) -> Floats:
        """Return stamps (k,) of the reference on the gyros' clock."""
        return np.asarray(self.middle_s + (stamps_s - self.middle_s - self.ahead_s) / (1 + self.drift))

    def told(self, name: str, at_s: float) -> str:
        """Return in words how fast the clock of the file ``name`` runs, and how far it is ahead at ``at_s``.

        The text calls that instant the beginning, and says that this was corrected.
        """
        ahead_s = self.ahead_s + self.drift * (at_s - self.middle_s)
        sd_s = np.hypot(self.ahead_sd_s, self.drift_sd * (at_s - self.middle_s))
        return (
            f"the clock of {name} is {1e6 * abs(self.drift):.3g} +- {1e6 * self.drift_sd:.2g} ppm "
            f"{'fast' if self.drift > 0 else 'slow'}, and is {1e3 * abs(ahead_s):.4g} +- {1e3 * sd_s:.2g} ms "
            f"{'ahead' if ahead_s > 0 else 'behind'} at the beginning, including "
            "any delay of the "
            "gyros. This was corrected"
        )


def clocks_apart(gyros: Turned, body: Turned, p: Floats, *, signed: bool) -> Clocks | None:
    """Return how the clock of a reference runs relative to the gyros'.

    None if they run alike, the body hardly turns, or the files overlap for less than 40 s. ``p`` (m, 3) are the gyros'
    axes; ``signed``: their signs are known. In windows, mean outputs over 0.1 s are fitted with bias and factor at
    every delay; the line of delays with the least residual in all windows is refined by Newton's method, and its
    covariance is that of the windows' scores (sandwich).
    """
    first_s, last_s = max(gyros.t_s[0], body.t_s[0]), min(gyros.t_s[-1], body.t_s[-1])
    step_s = max(_BLOCK_S, *(2 * float(np.median(np.diff(one.t_s))) for one in (gyros, body)))
    edges = np.arange(first_s, last_s, step_s)
    windows = min(_WINDOWS, int((last_s - first_s) / _WINDOW_S))
    if windows < _FEWEST or np.abs(np.diff(body.integral, axis=0)).sum() < REST_RPS * (last_s - first_s):
        return None
    number = (np.arange(len(edges) - 1) * windows) // (len(edges) - 1)
    outputs, middle_s = gyros.means(edges[:-1], edges[1:]), 0.5 * (first_s + last_s)
    at_s = edges[:-1] + 0.5 * step_s - middle_s
    centre_s = np.bincount(number, at_s) / np.bincount(number)

    def left(delay_s: Floats | float) -> Floats:
        """Return the mean squared residuals (windows,) of the outputs if the reference is read later by ``delay_s``.

        If signs are known, an output of opposite sign has no part explained.
        """
        rates = body.means(edges[:-1] + delay_s, edges[1:] + delay_s) @ p.T
        total = np.zeros(windows)
        for u, y in zip(rates.T, outputs.T, strict=True):
            known = np.isfinite(u + y)
            u, y = np.where(known, u, 0.0), np.where(known, y, 0.0)
            n, su, sy, suu, suy, syy = (np.bincount(number, v) for v in (known, u, y, u * u, u * y, y * y))
            n = np.maximum(n, 1.0)
            along = suy - su * sy / n
            along = np.maximum(along, 0.0) if signed else along  # an output of opposite sign does not follow
            total += (syy - sy**2 / n - along**2 / (suu - su**2 / n + 1e-30)) / n
        return total

    tried_s = np.arange(-_REACH_S, _REACH_S + _STEP_S / 2, _STEP_S) * (1 + 2 * _FASTEST * (last_s - first_s))
    every = np.array([left(delay) for delay in tried_s.tolist()])
    slopes = np.linspace(-_FASTEST, _FASTEST, 2 * int(_FASTEST * (last_s - first_s) / _STEP_S) + 3)
    sums = np.zeros((len(slopes), len(tried_s)))
    for of_slope, slope in zip(sums, slopes, strict=True):
        for row, since_s in zip(every.T, centre_s, strict=True):
            of_slope += np.interp(tried_s + slope * since_s, tried_s, row)
    # A motion that comes again fits as well a period later: of lines that are alike, the one of less delay.
    sums += _ALIKE * (np.median(sums) - sums.min()) * (tried_s / _REACH_S) ** 2
    best = np.unravel_index(np.argmin(sums), sums.shape)
    line, rows = np.array([tried_s[best[1]], slopes[best[0]]]), np.column_stack([np.ones(windows), centre_s])
    for near_s in _NEAR_S:
        before, here, after = (left(line[0] + line[1] * at_s + by) for by in (-near_s, 0.0, near_s))
        slope, bend = (after - before) / (2 * near_s), np.maximum(after - 2 * here + before, 0.0) / near_s**2
        inverse = np.linalg.pinv((rows * bend[:, None]).T @ rows)
        step = inverse @ rows.T @ slope
        line = line - step / max(float(np.abs(rows @ step).max()) / near_s, 1.0)
    sd = np.sqrt(np.sum((inverse @ (rows * slope[:, None]).T) ** 2, axis=1) * windows / (windows - 2))
    if abs(line[1]) < max(_TOLD * sd[1], _TOLD_S / (last_s - first_s)):
        return None
    return Clocks(float(line[0]), float(line[1]), float(sd[0]), float(sd[1]), middle_s)


def ahead_by_motion(gyros: Turned, body: Turned, p: Floats, *, signed: bool) -> float:
    """Return by how much (s) the stamps of a reference are ahead of the gyros', to 50 ms.

    That is where its rates correlate best with the outputs, over the whole files. ``p`` (m, 3) are the gyros' axes;
    ``signed``: their signs are known.
    """
    from scipy.signal import correlate

    means = []
    for one in (gyros, body):
        edges = np.arange(one.t_s[0], one.t_s[-1], _COARSE_S)
        mean = one.means(edges[:-1], edges[1:])
        means.append(np.nan_to_num(mean - np.nanmean(mean, axis=0)))
    alike = sum(correlate(u, y, method="fft") for u, y in zip((means[1] @ p.T).T, means[0].T, strict=True))
    at = int(np.argmax(alike if signed else np.abs(alike)))
    return float(body.t_s[0] - gyros.t_s[0] + _COARSE_S * (at - len(means[0]) + 1))
