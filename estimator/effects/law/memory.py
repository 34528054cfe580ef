"""The functions of laws that have a memory: a lag, a play, and the last sign."""

import numpy as np

from estimator.effects.conditions import follow
from estimator.types import Floats

LAST_SHARE = 0.05
"""Share of the largest size beyond which a sign counts."""
_EVEN = 1e-6  # share by which steps of time may differ and still be the same


def lagged(values: Floats, t_s: Floats, lag_s: float) -> Floats:
    """Return values (N,) at instants (N,) through a first-order lag that begins settled."""
    return follow(values, np.exp(-steps_of(t_s) / lag_s))


def steps_of(t_s: Floats) -> Floats:
    """Return the time (N,) since the instant before, or (1,) if it is always the same."""
    steps_s = np.diff(t_s)
    if len(steps_s) and np.ptp(steps_s) < _EVEN * steps_s[0]:
        return steps_s[:1]
    return np.maximum(np.diff(t_s, prepend=t_s[:1]), 0.0)


def played(values: Floats, width: float) -> Floats:
    """Return values (N,) after a play of total ``width``, starting in its middle at the first finite value.

    Values that are not finite are skipped, and returned unchanged.
    """
    out = np.array(values, dtype=np.float64)
    finite = np.flatnonzero(np.isfinite(out))
    x = out[finite]
    # From one instant to the next the play is limited to half a width about the value. Limits one after the other are
    # limits again, so those over 1, 2, 4, ... instants follow from each other, until all agree for any start.
    low, high = x - 0.5 * width, x + 0.5 * width
    low[:1] = high[:1] = x[:1]
    reach = 1
    while reach < len(x) and np.any(low < high):
        ends = low[reach:], high[reach:]
        low[reach:], high[reach:] = np.clip(low[:-reach], *ends), np.clip(high[:-reach], *ends)
        reach *= 2
    out[finite] = low
    return out


def last_sign(values: Floats, limit: Floats | None = None) -> Floats:
    """Return the sign (N,) of the last value of a size beyond ``limit``; 0 before the first.

    The limit is (N,) or (), by default a twentieth of the largest size of all. Values that are not finite do not count.
    """
    size = _finite_sizes(values)
    beyond = size > (LAST_SHARE * size.max(initial=0.0) if limit is None else limit)
    sign = np.where(beyond, np.sign(values), 0.0)
    last = np.maximum.accumulate(np.where(sign != 0, np.arange(len(sign)), -1))
    return np.asarray(np.where(last >= 0, sign[np.maximum(last, 0)], 0.0))


def last_of_all(values: Floats, *, causal: bool) -> Floats:
    """Return the last sign (N,) of values; ``causal``: the largest value is that of those so far."""
    so_far = LAST_SHARE * np.maximum.accumulate(_finite_sizes(values)) if causal else None
    return last_sign(values, so_far)


def _finite_sizes(values: Floats) -> Floats:
    return np.where(np.isfinite(values), np.abs(values), 0.0)
