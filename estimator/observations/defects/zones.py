"""Outputs that are exactly zero below some rate: devices that hide their bias, or cannot measure slow rates."""

import numpy as np

from estimator.types import Floats

_FEWEST, _SHARE = 20, 0.01  # zeros without which there is no zone, and their share of all samples
_WITHIN = 0.7  # of the width of a zone: there next to all outputs are zero
_NEARLY_ALL = 0.8
_EDGE = 0.99  # of the zeros, those that lie within the zone


def dead_zone_rps(output: Floats, expected: Floats) -> float | None:
    """Return the rate below which outputs (n,) are zero although ``expected`` (n,) is not; None if there is no such
    zone.

    None as well for few zeros, or if all outputs are zero. Values that are not finite do not count.
    """
    known = np.isfinite(output) & np.isfinite(expected)
    zero, size = output[known] == 0.0, np.abs(expected[known])
    if zero.sum() < max(_FEWEST, _SHARE * len(zero)) or zero.all():
        return None
    width = float(np.quantile(size[zero], _EDGE))
    inside = size < _WITHIN * width
    outside = size > width
    if not inside.any() or not outside.any() or np.mean(zero[inside]) < _NEARLY_ALL:
        return None
    return width
