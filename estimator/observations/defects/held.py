"""Held samples: a source that updates more slowly than the rows are written repeats its last values."""

import numpy as np
from numpy.typing import NDArray

from estimator.types import Floats, least_steps

_FEWEST_UPDATES = 20
_SHORT_SHARE = 0.05  # of the runs of equal rows, how many may be one row long all the same
_AT_PERIOD = 0.5  # of the runs, how many must last one period of the updates
_ON_PERIOD = 0.9  # of the runs, how many must last whole periods
_FINE_STEPS = 0.2  # of the updates, how many must change by more than one step of the quantisation


def updates(values: Floats) -> NDArray[np.intp] | None:
    """Return the rows (k,) at which held values (rows, m) are new; None if they are not held.

    Values that are equal because they are rounded are not held: their changes come at any row, or by single steps.
    """
    same = (values[1:] == values[:-1]) | (np.isnan(values[1:]) & np.isnan(values[:-1]))
    changes = np.flatnonzero(~same.all(axis=1)) + 1
    if len(changes) < _FEWEST_UPDATES:
        return None
    runs = np.diff(changes)
    least = float(np.quantile(runs, _SHORT_SHARE))
    if least < 2:
        return None
    period = float(runs[runs <= 1.5 * least].mean())
    periods = np.maximum(np.round(runs / period), 1)
    if np.mean(periods == 1) < _AT_PERIOD or np.mean(np.abs(runs - periods * period) <= 1) < _ON_PERIOD:
        return None
    steps = np.nan_to_num(np.abs(np.diff(values, axis=0))[changes - 1])
    largest = np.max(steps / least_steps(steps, 1e-12), axis=1)
    if np.mean(largest > 1.5) < _FINE_STEPS:
        return None
    # A value that happens to come twice is an update too: long runs are cut into periods.
    first = changes[0] - period * np.arange(int(changes[0] / period), 0, -1)
    parts = [start + period * np.arange(n) for start, n in zip(changes[:-1], periods, strict=True)]
    last = np.arange(changes[-1], len(values), period)
    rows = np.round(np.concatenate([first, *parts, last])).astype(np.intp)
    return rows[rows < len(values)]
