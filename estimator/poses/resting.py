"""Rests of a body that is moved by hand, found from the scatter of its accelerometers."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from estimator.errors import RecordingError
from estimator.types import Flags, Floats, runs_of

WINDOW_S = 0.25
"""Length of a window: above the period of a hand's tremor (5 to 12 Hz), below that of any motion between poses."""
_CELLS = 5  # steps of a window along the samples; one window at each end of a rest may hold the beginning of a motion
_SURE = 1e-4  # probability that the means of windows of one rest differ as much by chance
_CLASSES = 128  # of the histogram of scatters
_TURN = 0.01  # rad; a mean over poses that are less apart is shorter by less than 2e-5
_APART = 3.0  # least ratio of scatters in motion and at rest: less is one class


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class StillSpan:
    """Rows ``first`` to before ``stop`` at rest, of ``duration_s``, which begin at ``start_s``."""

    first: int
    stop: int
    start_s: float
    duration_s: float


def find_rests(t_s: Floats, outputs: Floats, least_s: float) -> list[StillSpan]:
    """Return the rests of at least ``least_s`` in outputs (n, c) at instants (n,), in order of time.

    Scatters of windows form two classes, at rest and in motion, divided in the histogram of their logarithms. A rest
    whose mean steps by more than a hundredth of its length is cut there. A window at each end is left out, as a motion
    may begin in it, except at the ends of the file. RecordingError if there are too few rows, or nothing rests.
    """
    period_s = float(np.median(np.diff(t_s))) if len(t_s) > 1 else 1.0
    rows = max(round(WINDOW_S / _CELLS / period_s), 2)
    count = len(outputs) // rows
    if count < 2 * _CELLS:
        raise RecordingError(f"it has {len(outputs)} rows, too few to find where it rests")
    cells = outputs[: count * rows].reshape(count, rows, -1)
    means = cells.mean(axis=1)
    scatter, whole = _scatters(t_s[: count * rows], cells, means, period_s)
    quiet = whole & (scatter <= _still_scatter(scatter, means, whole))
    still = np.zeros(count, dtype=bool)
    for shift in range(_CELLS):
        still[shift : shift + len(quiet)] |= quiet
    spans = []
    for start, stop in runs_of(still):
        first = start + _CELLS * (start > 0)
        last = stop - _CELLS * (stop < count)
        for a, b in _steady(means, first, last):
            first_row, stop_row = a * rows, b * rows
            duration_s = float(t_s[stop_row - 1] - t_s[first_row]) + period_s
            if duration_s >= least_s:
                spans.append(
                    StillSpan(first=first_row, stop=stop_row, start_s=float(t_s[first_row]), duration_s=duration_s)
                )
    if not spans:
        raise RecordingError(
            f"it has no rest of {least_s:g} s: the body must rest in each pose; rest_s in [reference] is the least time"
        )
    return spans


def _scatters(t_s: Floats, cells: Floats, means: Floats, period_s: float) -> tuple[Floats, Flags]:
    """Return the scatter (k,) of windows of five cells, all columns together, and which are without gap or blank.

    A window begins at each of the ``cells`` (n, rows, c) but the last four; ``means`` (n, c) are those of the cells.
    """
    rows = cells.shape[1]
    moments = np.stack([means, (cells**2).mean(axis=1)])
    padded = np.concatenate([np.zeros((2, 1, cells.shape[2])), np.cumsum(np.nan_to_num(moments), axis=1)], axis=1)
    mean, square = (padded[:, _CELLS:] - padded[:, :-_CELLS]) / _CELLS
    scatter = np.sqrt(np.maximum(square - mean**2, 0.0).sum(axis=1) * rows * _CELLS / (rows * _CELLS - 1))
    good = np.isfinite(cells).all(axis=(1, 2))
    gaps = np.append(np.diff(t_s) > 3 * period_s, False).reshape(len(cells), rows).any(axis=1)
    bad = np.concatenate([[0], np.cumsum(~good | gaps)])
    return scatter, np.asarray(bad[_CELLS:] == bad[:-_CELLS])


def _still_scatter(scatter: Floats, means: Floats, complete: Flags) -> float:
    """Return the largest scatter that a window at rest has; infinity if nothing moves.

    ``scatter`` (k,) is that of windows, of which the ``complete`` (k,) count; ``means`` (n, c) are those of cells.
    Rests in a hand are a class of their own, above those on a table: the windows of the next class are at rest, too, if
    from one to the next their mean changes less than they scatter. In a turn it changes by three times as much.
    """
    of_windows = np.array([means[at : at + len(scatter)] for at in range(_CELLS)]).mean(axis=0)
    change = np.linalg.norm(of_windows[_CELLS:] - of_windows[:-_CELLS], axis=1)
    limit = _dividing_scatter(scatter[complete])
    while np.isfinite(limit):
        above = complete & (scatter > limit)
        higher = _dividing_scatter(scatter[above]) if above.sum() > _CELLS else np.inf
        between = above[: len(change)] & (scatter[: len(change)] <= higher)
        if not np.isfinite(higher) or np.median(change[between] / scatter[: len(change)][between]) > 1:
            break
        limit = higher
    return limit


def _dividing_scatter(scatter: Floats) -> float:
    """Return the scatter that divides windows at rest from those in motion; infinity if all are of one class.

    The logarithms are two normal classes of different width, divided where the classification errs least (Kittler and
    Illingworth 1986).
    """
    levels = np.log(np.maximum(scatter, np.max(scatter, initial=0.0) * 1e-9 + 1e-300))
    counts, edges = np.histogram(levels, bins=_CLASSES)
    centres = 0.5 * (edges[1:] + edges[:-1])
    lower = _Classes.of(counts, centres)
    upper = _Classes.of(counts[::-1], centres[::-1]).reversed()
    step = edges[1] - edges[0]
    cost = lower.cost(step)[:-1] + upper.cost(step)[1:]
    at = int(np.argmin(cost))
    if not np.isfinite(cost[at]) or upper.mean[at + 1] - lower.mean[at] < np.log(_APART):
        return np.inf
    return float(np.exp(edges[at + 1]))


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class _Classes:
    """Share, mean and variance (k,) of the classes of the first 1, 2, ... k cells of a histogram."""

    share: Floats
    mean: Floats
    variance: Floats

    @classmethod
    def of(cls, counts: NDArray[np.int64], centres: Floats) -> Self:
        total = np.cumsum(counts)
        with np.errstate(invalid="ignore", divide="ignore"):
            mean = np.cumsum(counts * centres) / total
            variance = np.cumsum(counts * centres**2) / total - mean**2
        return cls(share=total / total[-1], mean=mean, variance=variance)

    def reversed(self) -> Self:
        return type(self)(share=self.share[::-1], mean=self.mean[::-1], variance=self.variance[::-1])

    def cost(self, step: float) -> Floats:
        """Return each class's part (k,) of the criterion; infinity for one without windows."""
        with np.errstate(invalid="ignore", divide="ignore"):
            cost = self.share * (0.5 * np.log(np.maximum(self.variance, step**2)) - np.log(self.share))
        return np.where(self.share > 0, cost, np.inf)


def _steady(means: Floats, first: int, stop: int) -> list[tuple[int, int]]:
    """Return the parts (first, stop) of a run of cells over which their means (n, c) do not step.

    A step is the division whose sides differ most beyond the scatter of neighbouring cells; it must be larger than
    chance and than a hundredth of the mean. Empty for an empty run.
    """
    from scipy.stats import norm

    length = stop - first
    if length < 2:
        return [(first, stop)] if length > 0 else []
    own = means[first:stop]
    neighbours = np.median(np.abs(np.diff(own, axis=0)), axis=0) / 0.9539  # of a difference of two normal values
    before = np.arange(1, length)
    cumulative = np.cumsum(own, axis=0)[:-1]
    left = cumulative / before[:, None]
    right = (own.sum(axis=0) - cumulative) / (length - before)[:, None]
    sd = neighbours * np.sqrt(1 / before + 1 / (length - before))[:, None]
    score = (np.abs(right - left) / np.maximum(sd, 1e-300)).max(axis=1)
    size = np.linalg.norm(own.mean(axis=0))
    limit = float(norm.isf(_SURE / (2 * length * own.shape[1])))
    steps = (score > limit) & (np.linalg.norm(right - left, axis=1) > _TURN * size)
    if not steps.any():
        return [(first, stop)]
    at = first + int(np.argmax(np.where(steps, score, 0.0))) + 1
    return [*_steady(means, first, at), *_steady(means, at, stop)]
