"""Overlapping Allan deviation, its equivalent degrees of freedom and its intervals."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from estimator.observations.allan.spectrum import sampled_densities
from estimator.types import Floats

FEWEST_SAMPLES = 9
"""Fewer samples in the longest stretch give no Allan deviation."""
LEVEL = 0.95
"""Probability of all intervals."""
_PER_DECADE = 5
_COARSE = 32  # differences over more samples than this scale: the sum is that of this many
_REACH = 64  # length of the sampled spectrum, over the width of a mean


@dataclass(frozen=True, slots=True, eq=False)
class AllanCurve:
    """Overlapping Allan deviation (t,) of one sensor at averaging times (t,), with its 95 % interval.

    ``edf`` (t,) are the equivalent degrees of freedom: ``edf * variance / truth`` is chi-square distributed.
    """

    tau_s: Floats
    deviation: Floats
    edf: Floats
    low: Floats
    high: Floats


def overlapping_deviation(
    stretches: Sequence[Floats], period_s: float, per_decade: int = _PER_DECADE
) -> tuple[Floats, Floats]:
    """Return averaging times (t,) and the overlapping Allan deviation (t, m) of evenly sampled stretches (n, m).

    Stretches are separate; each is weighted by its number of second differences. Averaging times go up to a third of
    the longest one. Both are empty if that has fewer than nine samples.
    """
    longest = max((len(part) for part in stretches), default=0)
    channels = stretches[0].shape[1] if stretches else 0
    if longest < FEWEST_SAMPLES:
        return np.empty(0), np.empty((0, channels))
    last = longest // 3
    steps = max(int(np.log10(last) * per_decade), 1) + 1
    widths = np.unique(np.round(np.geomspace(1, last, steps)).astype(int))
    squares = np.zeros((len(widths), channels))
    counts = np.zeros((len(widths), 1))
    for part in stretches:
        usable = np.flatnonzero(3 * widths <= len(part))
        counts[usable, 0] += len(part) + 1 - 2 * widths[usable]
        for channel, values in enumerate(part.T):
            phase = np.concatenate([[0.0], np.cumsum(values - values.mean())])
            for row in usable.tolist():
                squares[row, channel] += _sum_of_squares(phase, int(widths[row]))
    variance = squares / (2 * widths[:, None] ** 2 * counts)
    return widths * period_s, np.sqrt(variance)


def _sum_of_squares(phase: Floats, width: int) -> float:
    """Return the sum of the squared second differences, over a width, of the integral of a series."""
    second = phase[2 * width :] - phase[width:-width]
    second -= phase[width:-width]
    second += phase[: -2 * width]
    return float(second @ second)


def degrees_of_freedom(lengths: Sequence[int], width: int, period_s: float, sizes: Floats) -> Floats:
    """Return the equivalent degrees of freedom (m,) of the Allan variance at ``width`` samples.

    ``lengths`` are the samples of each stretch, of which one must be at least three widths: shorter ones do not count.
    ``sizes`` (m, 3) are N, B and K of each sensor, whose mixture decides. The sum is that of Greenhall and Riley (2004)
    for unfiltered phase, over the squared autocovariance of the second differences. That is the one of sampled noise,
    by its spectrum; at widths below 8 it differs from theirs, of continuous noise.
    """
    scale = max(width / _COARSE, 1.0)
    coarse = max(round(width / scale), 1)
    theta = 2 * np.pi * np.arange(1, _REACH * coarse // 2 + 1) / (_REACH * coarse)
    power = sampled_densities(theta, period_s * scale) @ (sizes.T**2)
    power *= ((2 * np.sin(coarse * theta / 2)) ** 4 / (2 * np.sin(theta / 2)) ** 2)[:, None]
    at_zero = period_s * scale * float(coarse) ** 4 * sizes[:, 2] ** 2  # only the walk has power there
    covariance = np.fft.irfft(np.vstack([at_zero, power]), axis=0)[: _REACH * coarse // 2]
    squares = (covariance / covariance[0]) ** 2
    counts = [(length + 1) / scale - 2 * coarse for length in lengths if length >= 3 * width]
    total = sum(_weighted_sum(squares, count) for count in counts)
    return np.asarray(sum(counts) ** 2 / total)


def _weighted_sum(squares: Floats, count: float) -> Floats:
    """Return the sum over all pairs of ``count`` differences of their squared correlations (lags, m)."""
    lags = np.arange(1, min(len(squares), max(int(np.ceil(count)), 1)))
    weights = count - lags
    return np.asarray(count * squares[0] + 2 * weights @ squares[lags])


def curves(
    tau_s: Floats, deviation: Floats, lengths: Sequence[int], period_s: float, sizes: Floats
) -> list[AllanCurve]:
    """Return the curve of each sensor with its intervals at ``LEVEL``.

    ``deviation`` (t, m) holds the deviations at averaging times ``tau_s`` (t,), from stretches of so many samples,
    ``lengths``, ``period_s`` apart. Degrees of freedom follow from the noise ``sizes`` (m, 3): N, B, K.
    """
    from scipy.special import gammaincinv  # chi-square by scipy.stats would take a second to import

    widths = np.round(tau_s / period_s).astype(int).tolist()
    edf = np.array([degrees_of_freedom(lengths, width, period_s, sizes) for width in widths])
    outside = (1 - LEVEL) / 2
    low = deviation * np.sqrt(edf / (2 * gammaincinv(edf / 2, 1 - outside)))
    high = deviation * np.sqrt(edf / (2 * gammaincinv(edf / 2, outside)))
    return [
        AllanCurve(tau_s=tau_s, deviation=own, edf=own_edf, low=own_low, high=own_high)
        for own, own_edf, own_low, own_high in zip(deviation.T, edf.T, low.T, high.T, strict=True)
    ]
