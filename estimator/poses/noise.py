"""Noise of the mean over one rest: from the rests' own samples, with the part that does not average out."""

from dataclasses import dataclass

import numpy as np

from estimator.poses.resting import WINDOW_S, StillSpan
from estimator.types import Floats

_FLOOR = 2 * np.log(2) / np.pi  # Allan variance of a unit bias instability (IEEE 952)


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class NoiseShape:
    """Noise of samples with unit variance: parts of its Allan variance over tau.

    They are ``swing_s2`` / tau^2 of a hand's tremor, which swings about its mean, ``white_s`` / tau, and ``floor``.
    """

    swing_s2: float
    white_s: float
    floor: float

    def white(self, duration_s: Floats) -> Floats:
        """Return the variance (n,) of means over ``duration_s`` (n,) by the parts that average out."""
        # Of white noise of an integral, the Allan variance is 3 and that of the mean 2 of its variance over tau^2.
        return np.asarray(self.white_s / duration_s + 2 / 3 * self.swing_s2 / duration_s**2)

    def wander(self, duration_s: Floats, session_s: float) -> Floats:
        """Return the variance (n,) of means about that of a session by the floor.

        It grows with the number of rests that fit into the session: B1 of flicker noise (Barnes 1969).
        """
        count = np.maximum(session_s / duration_s, 2.0)
        return np.asarray(self.floor * count * np.log(count) / (2 * (count - 1) * np.log(2)))


def noise_shape(series: list[Floats], period_s: float) -> NoiseShape:
    """Return the shape of the noise common to series of one rest each, (n,) of zero mean and unit variance.

    Samples are ``period_s`` apart. Allan variances are pooled over all rests, from the length of a window on, and
    divided into their parts by weighted least squares with none below zero. The noise is taken to be white if the rests
    are too short for any of them.
    """
    from scipy.optimize import nnls

    longest = max(len(own) for own in series)
    widths = [max(round(WINDOW_S / period_s), 1)]
    while 4 * widths[-1] <= longest:
        widths.append(2 * widths[-1])
    rows, values = [], []
    for width in widths:
        squares, count = 0.0, 0
        for own in series:
            whole = len(own) // width
            if whole < 2:
                continue
            steps = np.diff(own[: whole * width].reshape(whole, width).mean(axis=1))
            squares += float(steps @ steps)
            count += len(steps)
        if count < 2 or squares == 0.0:
            continue
        variance = squares / (2 * count)
        weight = np.sqrt(count) / variance
        tau_s = width * period_s
        rows.append([weight / tau_s**2, weight / tau_s, weight * _FLOOR])
        values.append(weight * variance)
    if not rows:
        return NoiseShape(swing_s2=0.0, white_s=period_s, floor=0.0)
    (swing_s2, white_s, floor), _ = nnls(np.array(rows), np.array(values))
    return NoiseShape(swing_s2=float(swing_s2), white_s=float(white_s), floor=float(floor) * _FLOOR)


def variance_of_means(
    radial: list[Floats], spans: list[StillSpan], period_s: float, session_s: float
) -> tuple[Floats, Floats]:
    """Return the variances (n,) of the mean over each of n rests of the force along gravity: white, and by the floor.

    ``radial`` are the samples of that component in each rest, in m/s2, ``period_s`` apart; ``spans`` are the rests,
    ``session_s`` is the length of the file, over which the floor wanders. Each rest has its own size of noise, as a
    hand trembles more than a table.
    """
    centred = [own - own.mean() for own in radial]
    size = np.array([own.std(ddof=1) for own in centred])
    usual = float(np.median(size))
    size = np.maximum(size, 1e-3 * usual + 1e-12)
    shape = noise_shape([own / sd for own, sd in zip(centred, size, strict=True)], period_s)
    duration_s = np.array([span.duration_s for span in spans])
    return size**2 * shape.white(duration_s), size**2 * shape.wander(duration_s, session_s)
