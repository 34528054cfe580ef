"""Instants of external samples from their stamps, which may jump, repeat or be out of order."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.errors import RecordingError
from estimator.packaged import sentence
from estimator.types import Floats

REGULAR_WITHIN = 0.3
"""Median distance, in sample periods, of stamps from an even grid below which the sampling is called regular."""
_COARSE_SHARE = 0.2
"""Share of stamps equal to the one before from which on they are called coarse, as of a clock or of packets."""
_WITHIN_STAMP = 0.35  # median distance from an even grid of coarse stamps, in their own steps; 0.25 if nothing is off
_JUMP_PERIODS = 10.0  # a stamp this far behind the one before is no jitter
_LONGEST_REPLAY_S = 2.0
_EVEN_ROWS, _NEARLY_ALL = 101, 0.99  # rows over which a wandering clock is even, and how many must be near
_BEHIND_SHARE = 0.2  # of uneven stamps, those before an earlier one; a column with more is no time
_EXACT = 0.05  # periods: stamps that scatter by less are those of a grid, written with few digits
_MOST_LATE = 3.0  # periods by which stamps of even samples may scatter, by their median
_CHECK = "check column in [time], or state rate_hz instead; in a binary file check record"
_SAME_SHARE = 0.5  # of the rows of a replay, how many must be there already, to the last digit


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class TimeFit:
    """Instants (kept rows,) in seconds from the first, the rows that are kept, and a description.

    ``replayed`` counts rows that were delivered again, ``doubled`` rows written twice in succession. ``zero_s`` is the
    stamp of the instant 0; None without stamps. Stamps that scatter about an even grid may be of samples or of
    arrivals: ``on_grid`` says which of the two ``t_s`` is, ``other_s`` (kept rows,) are the instants in the other case,
    None if that is impossible. ``scatter_s`` is their scatter.
    """

    t_s: Floats
    rows: NDArray[np.intp]
    replayed: int
    text: str
    doubled: int = 0
    zero_s: float | None = None
    other_s: Floats | None = None
    scatter_s: float = 0.0
    on_grid: bool = False

    @property
    def step_s(self) -> float:
        """Time from one row to the next, usually."""
        return float(np.median(np.diff(self.t_s)))


def regular_times(position: NDArray[np.int64], rate_hz: float) -> TimeFit:
    """Return the instants of samples without stamps, at a stated rate; a broken line keeps its place in time."""
    t_s = np.asarray((position - position[0]) / rate_hz, dtype=np.float64)
    return TimeFit(t_s=t_s, rows=np.arange(len(position)), replayed=0, text=f"{rate_hz:.6g} Hz as stated")


def fit_times(stamps_s: Floats, values: Floats, position: NDArray[np.int64] | None = None) -> TimeFit:
    """Return instants from stamps (rows,), with the rows kept; ``values`` (rows, m) tell a replay from a clock set
    back.

    ``position`` (rows,) numbers the rows, lost ones included. Rows delivered again (stamps in the past, values known)
    and rows written twice (equal stamps and values) are left out. If the rest is near an even grid, the grid replaces
    the stamps, whose scatter is that of delivery; several samples per stamp are spread over it. The same holds if
    stamps are even over stretches of 101 rows. Otherwise the sampling was uneven and the stamps are kept, without rows
    whose stamp does not increase.

    RecordingError for fewer than eight stamps, and for stamps that are not finite, do not advance, or go back as for
    two runs in a file. Its message begins with a verb: the caller puts the name of the file before it.
    """
    if len(stamps_s) < 8:
        raise RecordingError(sentence("importing.few_stamps", rows=len(stamps_s)))
    if not np.isfinite(stamps_s).all():
        raise RecordingError("has time stamps that are not numbers. Repair the time column")
    forward = np.diff(stamps_s)
    if not (forward > 0).any():
        how = "run backwards: reverse the order of the rows, or" if (forward < 0).all() else "do not advance:"
        raise RecordingError(f"has time stamps that {how} {_CHECK}")
    values = np.nan_to_num(values, nan=-1e300)  # blank is equal to blank
    rows = _without_replays(stamps_s, values, float(np.median(forward[forward > 0])))
    replayed = len(stamps_s) - len(rows)
    tried = [
        (rows[~twice], int(twice.sum()))
        for twice in (_written_twice(stamps_s[rows], values[rows], usual) for usual in _usual_rows(stamps_s[rows]))
    ]
    fits = [(fit, kept, doubled) for kept, doubled in tried for fit in _grids(stamps_s[kept], kept, position)]
    if not fits:
        raise RecordingError(f"has time stamps that do not advance: {_CHECK}")
    best, rows, doubled = min(fits, key=lambda tried: (not tried[0].even, tried[0].away))
    t = stamps_s[rows]
    done = f", {replayed} replayed rows skipped" if replayed else ""
    done += f", {doubled} duplicate rows skipped" if doubled else ""
    if best.even:
        text = sentence("importing.even_grid", rate_hz=1 / best.period_s, periods=best.scatter)
        t_s = best.number * np.float64(best.period_s)
        zero_s = float(np.median(t - t_s))
        scatters = best.scatter > _EXACT and bool((np.diff(t) > 0).all())
        other_s = t - zero_s if scatters else None
        scatter_s = best.scatter * best.period_s
        return TimeFit(
            t_s=t_s,
            rows=rows,
            replayed=replayed,
            text=text + done,
            doubled=doubled,
            zero_s=zero_s,
            other_s=other_s,
            scatter_s=scatter_s,
            on_grid=True,
        )
    other_s = None
    if (wandering := _even_over_seconds(t)) is not None:
        t, text = wandering, f"even over seconds at {1 / np.median(np.diff(wandering)):.6g} Hz"
        text += "; the clock of the stamps wanders"
    else:
        newest = np.concatenate([[-np.inf], np.maximum.accumulate(t)[:-1]])
        late, behind = t <= newest, float(np.mean(t < newest))
        if behind > _BEHIND_SHARE:
            raise RecordingError(f"has stamps earlier than previous ones in {behind:.0%} of its rows: {_CHECK}")
        t, rows = t[~late], rows[~late]
        other_s = _before_delivery(best, t, ~late)
        text = f"as stamped (uneven: off an even grid of {1 / best.period_s:.4g} Hz by {best.away:.1f} periods)"
        text += f", {late.sum()} rows skipped whose stamp does not increase" if late.any() else ""
    scatter_s = best.scatter * best.period_s if other_s is not None else 0.0
    return TimeFit(
        t_s=t - t[0],
        rows=rows,
        replayed=replayed,
        text=text + done,
        doubled=doubled,
        zero_s=float(t[0]),
        other_s=other_s,
        scatter_s=scatter_s,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Grid:
    """An even grid through stamps: their distance from it, in periods, and whether that is near enough."""

    number: NDArray[np.int64]
    period_s: float
    scatter: float
    away: float
    even: bool


def _before_delivery(grid: _Grid, t: Floats, used: NDArray[np.bool_]) -> Floats | None:
    """Return the instants of evenly spaced samples if the stamps may be of their arrivals, else None.

    Arrivals scatter about a grid without leaving it; stamps of uneven sampling leave it. ``t`` are the stamps of the
    rows marked in ``used``; the instants are of these rows, in s since the first stamp.
    """
    if grid.away > max(grid.scatter, 1.0) or grid.scatter > _MOST_LATE:
        return None
    even = grid.period_s * grid.number[used]
    return np.asarray(even + float(np.median(t - even)) - t[0])


def _grids(t: Floats, rows: NDArray[np.intp], position: NDArray[np.int64] | None) -> list[_Grid]:
    """Return grids by the order of the rows, and by their numbers among those that were lost or left out."""
    numbered = rows if position is None else position[rows]
    fits = [_grid(t, number) for number in (np.arange(len(rows)), numbered - numbered[0])]
    return [fit for fit in fits if fit is not None]


def _grid(t: Floats, number: NDArray[np.int64]) -> _Grid | None:
    """Return the even grid through stamps ``t`` (rows,) of rows numbered ``number`` (rows,).

    It says whether the stamps are even to within their resolution. None if they do not advance, or are fewer than two.
    """
    if len(t) < 2:
        return None
    half = len(t) // 2
    steps = np.diff(t)
    coarse_s = float(np.median(steps[steps > 0])) if (steps == 0).mean() >= _COARSE_SHARE else 0.0
    if coarse_s:  # their rounding is averaged
        centred = number - number.mean()
        period = float(centred @ t / (centred @ centred))
    else:  # no single stamp weighs
        period = float(np.median((t[half:] - t[: len(t) - half]) / (number[half:] - number[: len(t) - half])))
    if period <= 0:
        return None
    away = t - period * number
    away -= np.median(away)
    tenth = max(len(t) // 10, 1)
    drift = abs(float(np.median(away[-tenth:]) - np.median(away[:tenth]))) / period  # samples lost or doubled
    scatter = float(np.median(np.abs(away))) / period
    coarse = coarse_s / period
    even = scatter <= max(REGULAR_WITHIN, _WITHIN_STAMP * coarse) and drift <= max(1.0, coarse)
    return _Grid(number, period, scatter, max(scatter, drift), even)


def _even_over_seconds(t: Floats) -> Floats | None:
    """Return the instants (rows,) of samples that are even for seconds, by a clock that wanders in the long run.

    They are the stamps ``t`` (rows,) in s, smoothed over 101 rows against an even grid. None for fewer than 202 stamps,
    if more than 1 % of them are far from that, if two are less than half a step apart or more than a tenth of the steps
    are longer ones.
    """
    if len(t) < 2 * _EVEN_ROWS:
        return None
    steps = np.round(np.diff(t) / max(float(np.median(np.diff(t))), 1e-12))
    if steps.min() < 1 or np.quantile(steps, 0.9) > 1:
        return None
    grid = np.concatenate([[0.0], np.cumsum(steps)])
    period_s = float(np.median((t[_EVEN_ROWS:] - t[:-_EVEN_ROWS]) / (grid[_EVEN_ROWS:] - grid[:-_EVEN_ROWS])))
    grid *= period_s
    around = np.pad(t - grid, _EVEN_ROWS // 2, "reflect", reflect_type="odd")  # which keeps a slope at the ends
    fit = grid + np.convolve(around, np.full(_EVEN_ROWS, 1 / _EVEN_ROWS), "valid")
    return fit if np.quantile(np.abs(t - fit), _NEARLY_ALL) <= REGULAR_WITHIN * period_s else None


def _usual_rows(t: Floats) -> list[int]:
    """Return how many rows a stamp may have, to be tried in order: only 1, or for coarse stamps from all rows down."""
    counts = np.diff(np.append(np.flatnonzero(np.diff(t, prepend=t[0] - 1)), len(t)))
    if np.quantile(counts, 0.9) <= 1:
        return [1]
    many = int(np.quantile(counts, 0.99))
    return [len(t), many + 1, many]


def _written_twice(t: Floats, values: Floats, usual: int) -> NDArray[np.bool_]:
    """Return as flags (rows,) which rows repeat the row before, stamp and values.

    Only stamps with more than ``usual`` rows are looked at, and of each no more rows are flagged than it has above
    that.
    """
    twice = np.zeros(len(t), dtype=bool)
    first = np.flatnonzero(np.diff(t, prepend=t[0] - 1))
    counts = np.diff(np.append(first, len(t)))
    for start, count in zip(first[counts > usual].tolist(), counts[counts > usual].tolist(), strict=True):
        same = (values[start + 1 : start + count] == values[start : start + count - 1]).all(axis=1)
        again = start + 1 + np.flatnonzero(same)
        twice[again[: count - usual]] = True
    return twice


def _without_replays(stamps_s: Floats, values: Floats, period_s: float) -> NDArray[np.intp]:
    """Return the numbers of the rows that are not a second delivery of earlier rows.

    ``period_s`` is the usual step of stamps. Stamps that go back by more than ten steps begin a replay, which lasts
    until one is later than all before it. RecordingError if they go back by more than 2 s, or if fewer than half of the
    replayed rows are known already, by ``values`` (rows, m).
    """
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
            raise RecordingError(sentence("importing.stamps_back", back_s=back_s, row=first + 1))
        keep[first:stop] = False
        start = stop
    return np.flatnonzero(keep)
