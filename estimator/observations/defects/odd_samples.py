"""Samples that are none: single values far off, as of a line without check sums, and values that come twice."""

import numpy as np
from numpy.typing import NDArray

from estimator.types import Flags, Floats

_FAR = 60.0  # times the usual difference of neighbours: measured knocks reach 50, damaged bytes any size
_APART = 0.5  # of the spikes, how many values may lie half as far: the tail of a distribution has more
_AGREE = 0.25  # of a spike's size, the largest difference between its neighbours
_ALONE = 0.6  # of its size, by how much it is off each neighbour, and off the line through the two of each side
_WITHIN, _BESIDE = 25, 3  # values to each side that show the usual difference, less those next to a spike
_FEWEST = 100
_CANDIDATES = 0.01
_ENOUGH = 10000
_MORE_OFTEN, _SHARE = 10, 0.2  # than with the one before the last, and of all rows: else values are coarse, or held


def without_odd(
    quantity: str, t_s: Floats, values: Floats, names: tuple[str, ...] = ()
) -> tuple[NDArray[np.intp], list[str]]:
    """Return the rows (k,) of values (n, c) at ``t_s`` (n,) that are neither spikes nor repetitions, and notes on the
    others.

    A row with a spike in any column is one. ``quantity`` and ``names`` of the columns are for the notes.
    """
    far = np.column_stack([spikes(column) for column in values.T]) if values.size else np.zeros(values.shape, bool)
    spiked, again = np.asarray(far.any(axis=1)), repeats(values)
    own = ", ".join(name for name, column in zip(names, far.T, strict=False) if column.any())
    told = ((spiked, f"{quantity} {own}".strip(), "are spikes"), (again, quantity, "are those before them again"))
    notes = [
        f"{who}: {flags.sum()} of {len(flags)} samples ({100 * flags.mean():.3g} %) {kind}, the first at "
        f"{t_s[np.argmax(flags)]:.6g} s; they were excluded"
        for flags, who, kind in told
        if flags.any()
    ]
    return np.flatnonzero(~spiked & ~again), notes


def spikes(column: Floats) -> Flags:
    """Return as flags (n,) which values are far from neighbours that agree with each other.

    Values that stand for several rows count once. The usual distance is the median on the side where it is larger, so
    that the beginning of a motion is not a spike. If many values are half as far, as in a tail of noise or shaking,
    none is; nor of fewer than 100 values. NaN is none.
    """
    flags = np.zeros(len(column), dtype=np.bool_)
    steps = np.abs(np.diff(column))
    if steps.max(initial=0.0) < 0.2 * _FAR * np.median(steps[:: max(len(steps) // _ENOUGH, 1)] if len(steps) else 0.0):
        return flags  # long recordings without a step that is out of the common are seen through at once
    known = np.flatnonzero(np.isfinite(column))
    first = np.flatnonzero(np.diff(column[known], prepend=np.nan) != 0)
    v, length = column[known[first]], np.diff(np.append(first, len(known)))
    if len(v) < _FEWEST:
        return flags
    beside = np.pad(v, 2, mode="reflect")
    before, after = (beside[1:-3], beside[:-4]), (beside[3:-1], beside[4:])
    low = np.maximum(np.minimum(*before), np.minimum(*after))  # the middle two of the four
    high = np.minimum(np.maximum(*before), np.maximum(*after))
    away = np.abs(v - 0.5 * (low + high))
    usual = max(float(np.median(away)), float(np.abs(np.diff(v)).min()))
    level = max(0.5 * _FAR * usual, float(np.quantile(away, 1 - _CANDIDATES)))
    at = np.flatnonzero((away > level) & (np.abs(high - low) < _AGREE * away) & (length <= 2 * np.median(length)))
    for near, next_one in (before, after):  # no spike where the motion continues or reverses
        for said in (near, 2 * near - next_one):
            at = at[np.abs(v - said)[at] > _ALONE * away[at]]
    if not len(at):
        return flags
    window = np.arange(_BESIDE, _WITHIN)
    sides = [np.median(away[np.abs(at[:, None] + way * window) % len(v)], axis=1) for way in (-1, 1)]
    size = 0.6745 * away[at] / np.maximum(np.maximum(*sides), usual)
    far = size > _FAR
    if np.count_nonzero(~far & (size > 0.5 * _FAR)) > _APART * np.count_nonzero(far):
        return flags
    for start, count in zip(first[at[far]].tolist(), length[at[far]].tolist(), strict=True):
        flags[known[start : start + count]] = True
    return flags


def repeats(values: Floats) -> Flags:
    """Return which rows (n, c) are the row before once more; none where values are rounded, at rest, or held."""
    same = np.asarray((values[1:] == values[:-1]).all(axis=1))
    by_chance = int((values[2:] == values[:-2]).all(axis=1).sum())
    if same.sum() < _MORE_OFTEN * (by_chance + 1) or same.mean() > _SHARE:
        same = np.zeros_like(same)
    return np.concatenate([np.zeros(min(len(values), 1), dtype=np.bool_), same])
