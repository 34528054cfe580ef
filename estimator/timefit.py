"""Instants of foreign samples from the stamps they came with, which may jump, repeat or be out of order."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.errors import RecordingError

Floats = NDArray[np.float64]

REGULAR_WITHIN = 0.3
"""Median distance, in sample periods, of stamps from an even grid below which the sampling is called regular."""
_JUMP_PERIODS = 10.0  # a stamp this far behind the one before is no jitter
_LONGEST_REPLAY_S = 2.0
_SAME_SHARE = 0.5  # of the rows of a replay, how many must be there already, to the last digit


@dataclass(frozen=True, slots=True, eq=False)
class TimeFit:
    """Instants (kept rows,) in seconds from the first, the rows that are kept, and in words what was done."""

    t_s: Floats
    rows: NDArray[np.intp]
    replayed: int
    text: str


def regular_times(rows: int, rate_hz: float) -> TimeFit:
    """Return the instants of samples without stamps, at a stated rate."""
    return TimeFit(np.arange(rows, dtype=np.float64) / rate_hz, np.arange(rows), 0, f"{rate_hz:.6g} Hz as stated")


def fit_times(stamps_s: Floats, values: Floats) -> TimeFit:
    """Return instants from stamps (rows,); ``values`` (rows, m) tell a replay from a clock that was set back.

    Rows that are delivered a second time (their stamps lie in the past, their values are there already) are
    left out. If the rest lies near an even grid, the order of the rows is right and the grid replaces the
    stamps, whose scatter is that of their delivery. If not, the sampling was uneven and the stamps stand.

    Raises RecordingError for stamps that are not finite, do not advance, or go back as two runs in a file do.
    """
    if len(stamps_s) < 8:
        raise RecordingError(f"has {len(stamps_s)} rows, too few for a fit of their times: record more")
    if not np.isfinite(stamps_s).all():
        raise RecordingError("has time stamps that are no numbers: repair the time column")
    forward = np.diff(stamps_s)
    if not (forward > 0).any():
        raise RecordingError("has time stamps that do not advance: is this the time column?")
    rows = _without_replays(stamps_s, values, float(np.median(forward[forward > 0])))
    t = stamps_s[rows]
    replayed = len(stamps_s) - len(rows)
    half = len(t) // 2
    period = float(np.median((t[half:] - t[: len(t) - half]) / half))  # no single stamp weighs
    if period <= 0:
        raise RecordingError("has time stamps that do not advance: is this the time column?")
    away = t - period * np.arange(len(t))
    away -= np.median(away)
    tenth = max(len(t) // 10, 1)
    drift = abs(float(np.median(away[-tenth:]) - np.median(away[:tenth]))) / period  # samples lost or doubled
    dropped = f", {replayed} replayed rows left out" if replayed else ""
    scatter = float(np.median(np.abs(away))) / period
    if scatter <= REGULAR_WITHIN and drift <= 1:
        text = f"even grid of {1 / period:.6g} Hz fitted to the stamps (they scatter by {scatter:.2f} periods)"
        return TimeFit(period * np.arange(len(t), dtype=np.float64), rows, replayed, text + dropped)
    late = t <= np.concatenate([[-np.inf], np.maximum.accumulate(t)[:-1]])
    t, rows = t[~late], rows[~late]
    text = f"as stamped (uneven: off an even grid of {1 / period:.4g} Hz by {max(scatter, drift):.1f} periods)"
    if late.any():
        text += f", {int(late.sum())} rows left out whose stamp is no later than the one before"
    return TimeFit(t - t[0], rows, replayed, text + dropped)


def _without_replays(stamps_s: Floats, values: Floats, period_s: float) -> NDArray[np.intp]:
    """Return the rows that are not a second delivery of rows before them."""
    keep = np.ones(len(stamps_s), dtype=bool)
    start = 0
    for jump in np.flatnonzero(np.diff(stamps_s) < -_JUMP_PERIODS * period_s):
        first = int(jump) + 1
        if first < start:
            continue
        newest = stamps_s[:first].max()
        ahead = np.flatnonzero(stamps_s[first:] > newest)
        stop = first + int(ahead[0]) if len(ahead) else len(stamps_s)
        back_s = newest - stamps_s[first]
        before = values[:first][stamps_s[:first] >= stamps_s[first] - 0.1]
        same = np.mean([bool((before == row).all(axis=1).any()) for row in values[first:stop]])
        if back_s > _LONGEST_REPLAY_S or same < _SAME_SHARE:
            raise RecordingError(
                f"has a time column that goes back by {back_s:.3g} s at data row {first + 1}, where it does not "
                "repeat what was there: split the file if it holds two runs"
            )
        keep[first:stop] = False
        start = stop
    return np.flatnonzero(keep)
