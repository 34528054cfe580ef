"""Control charts of single values, one a run: Shewhart's with moving ranges, and the moving average (EWMA).

D. C. Montgomery, Introduction to Statistical Quality Control, 6.4 and 9.2; ISO 7870-2 and ISO 7870-6.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.types import Floats

_SIGMAS = 3.0  # half the width of the limits; L of the moving average
_WEIGHT = 0.2  # lambda, of the newest value in the moving average
_D2 = 1.128  # mean range of two normal values of sigma 1
_ROUNDING = 1e-9  # of the mean: copies of one run are not outside


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class ControlChart:
    """Control chart of ``values`` (runs, ...): ``mean`` (...), the two ``limits`` (...) and which values are
    ``outside`` (runs, ...).

    ``ewma`` is the moving average of the values, ``ewma_limits`` the distance from the mean that it may have,
    ``ewma_outside`` where it exceeds that, each (runs, ...).
    """

    values: Floats
    mean: Floats
    limits: tuple[Floats, Floats]
    outside: NDArray[np.bool_]
    ewma: Floats
    ewma_limits: Floats
    ewma_outside: NDArray[np.bool_]


def control_chart(values: ArrayLike, counted: Sequence[bool]) -> ControlChart:
    """Return the control chart of values (runs, ...) in the order of time.

    Mean and limits come from the ``counted`` values only, of which there must be two or more (unchecked; NaN
    otherwise): the limits are three sigmas, from the mean step between neighbouring counted values. The moving average
    (EWMA) starts from the mean and runs over all values, and so do the marks of values outside the limits.
    ``ewma_limits`` are half widths. A difference within rounding is not outside.
    """
    x = np.asarray(values, float)
    mean = x[counted,].mean(axis=0)
    half = _SIGMAS / _D2 * np.abs(np.diff(x[counted,], axis=0)).mean(axis=0)
    ewma = np.array(list(accumulate(x, lambda last, new: last + _WEIGHT * (new - last), initial=mean))[1:])
    share = np.sqrt(_WEIGHT / (2 - _WEIGHT) * (1 - (1 - _WEIGHT) ** (2 * np.arange(1, len(x) + 1))))
    ewma_half = np.multiply.outer(share, half)
    least = _ROUNDING * np.abs(mean)
    outside, ewma_outside = np.abs(x - mean) > half + least, np.abs(ewma - mean) > ewma_half + least
    return ControlChart(
        values=x,
        mean=mean,
        limits=(mean - half, mean + half),
        outside=outside,
        ewma=ewma,
        ewma_limits=ewma_half,
        ewma_outside=ewma_outside,
    )
