"""Outputs that end at a limit of the device, whatever the body does beyond it.

A device corrects offsets and axes after its converter, so that what it puts out at the limit varies by some deg/s, and
a body that turns steadily has as flat an output as one that is at a limit. Both are told apart by the rate of the
reference: it goes on where the output does not.
"""

from dataclasses import dataclass

import numpy as np

from estimator.geometry.noise import SD_OF_MEDIAN
from estimator.types import Flags, Floats

_BEYOND = 6.0  # standard deviations by which outputs should be beyond the largest that there is
_FEWEST = 20  # samples beyond a limit: a few a reading may be wrong by
_WITHOUT_SPIKES = 9  # samples: so long a wrong reading makes a rate wrong that is a slope over some
_LIKELIER = 0.1  # share of the squares that a limit leaves of those that a line leaves
_NEARLY_ALL = 0.9  # of the samples beyond a limit, how many must be at it: a filter takes some time to get there
_FLAT = 0.25  # scatter at a limit over that of the expected outputs
_FAR = 0.05  # share of the limit by which a steady rate must be beyond it: no law of the scale factor makes as much
_LEAST = 0.02  # share of the limit by which outputs must exceed it: possible error of a reading
_BELOW = 0.3  # of a limit: between that and the limit outputs follow the rate
_TOP = 0.05  # share of the range within which a limit lies of the largest output


@dataclass(frozen=True, slots=True)
class Limit:
    """A level in rad/s that outputs do not exceed on one side (+1, -1), and their variation there."""

    level_rps: float
    side: float
    width_rps: float

    def reached(self, output: Floats, expected: Floats) -> Flags:
        """Return which outputs (n,) are at the limit, or should be beyond it."""
        least = self.side * self.level_rps - self.width_rps
        expects = np.where(np.isfinite(expected), self.side * expected, -np.inf)
        return np.asarray((self.side * output > least) | (expects > least))


def limits_of(output: Floats, expected: Floats, scatter_rps: float) -> list[Limit]:
    """Return the upper and lower limits of outputs (n,) whose expected values (n,) are known to ``scatter_rps``, one
    sigma.

    The upper one is first; one that is not seen is left out. Empty for too few outputs that are known. Spikes of the
    expected values are ignored.
    """
    known = np.isfinite(output) & np.isfinite(expected)
    output, expected = output[known], expected[known]
    if len(output) < _WITHOUT_SPIKES:
        return []
    expected = _without_spikes(expected)
    middle = float(np.median(output))
    found = [_upper(side * (output - middle), side * (expected - middle), scatter_rps) for side in (1.0, -1.0)]
    return [
        Limit(middle + side * level, side, width)
        for side, limit in zip((1.0, -1.0), found, strict=True)
        if limit is not None
        for level, width in [limit]
    ]


def _without_spikes(values: Floats) -> Floats:
    """Return running medians (n,): a reading that is wrong for a moment says nothing about a limit."""
    from scipy.ndimage import median_filter

    return np.asarray(median_filter(values, _WITHOUT_SPIKES, mode="nearest"))


def _upper(output: Floats, expected: Floats, scatter: float) -> tuple[float, float] | None:
    """Return the upper limit of outputs (n,) and its width, both relative to their median; None if there is none.

    None, too, if too few outputs ought to be beyond it, or the output does not follow the rate below it.
    """
    top = float(output.max())
    beyond = expected > top + _BEYOND * scatter
    if beyond.sum() < _FEWEST:
        return None
    at, ought = output[beyond], expected[beyond]
    level = float(np.median(at))
    # A channel that is stuck has no output that follows the rate on its way to a limit.
    below = (expected > _BELOW * level) & (expected < level)
    if below.sum() < _FEWEST or float(np.median(np.abs(output[below] - expected[below]))) > _FLAT * level:
        return None
    if top - level > max(_BEYOND * scatter, _TOP * top):
        return None
    count = max(int(_NEARLY_ALL * len(at)), 1)
    left = [float(np.sum(np.sort((at - other) ** 2)[:count])) for other in (level, ought)]
    width = SD_OF_MEDIAN * float(np.median(np.abs(at - level)))
    steady = SD_OF_MEDIAN * float(np.median(np.abs(ought - np.median(ought))))
    excess = float(np.median(ought)) / max(level, 1e-12) - 1
    flat = width < _FLAT * steady or excess > _FAR
    if excess < _LEAST or not flat or left[0] > _LIKELIER * left[1]:
        return None
    return level, max(3 * scatter, top - level)
