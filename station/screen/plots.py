"""Plots drawn with characters: an estimate with its band over time, a state over a device's calibrations."""

import math
from bisect import bisect_right
from collections.abc import Callable, Sequence
from functools import partial
from itertools import groupby
from operator import itemgetter

from rich.text import Text

from station.screen.sessions.live_run import Trend
from station.views.figures import STATE_FIGURES, number

_DOTS = ((0x01, 0x08), (0x02, 0x10), (0x04, 0x20), (0x40, 0x80))
_BRAILLE = 0x2800
_DOTS_HIGH, _DOTS_WIDE = 4, 2
_LINE, _EDGE, _LIMIT = "bold bright_white", "cyan", "red"
_RANKS = {_LINE: 3, _EDGE: 2, _LIMIT: 1, "": 0}
_MARGIN = 1.15
_RECENT = 0.2  # of the time: it sets the range of values
_LEAST_SIGMAS = 3.0
_STATE_ROWS = 6


class Canvas:
    """Dots in a field of braille characters; a character has the style of the most important dot in it."""

    def __init__(self, width: int, height: int, low: float, high: float, label: Callable[[float], str]) -> None:
        """``width`` and ``height`` in characters; ``low`` and ``high`` are the values at the lower and upper edge.

        The edges and the middle are labelled at the left.
        """
        self._labels = [label(high), label((low + high) / 2), label(low)]
        self._indent = max(map(len, self._labels)) + 1
        self._width, self._height = max(width - self._indent, 1), max(height, 1)
        self._low, self._high = low, high
        self._cells: dict[tuple[int, int], tuple[int, str]] = {}

    @property
    def dots_wide(self) -> int:
        """Columns of dots."""
        return self._width * _DOTS_WIDE

    def row(self, value: float) -> float:
        """Return the row of dots of a value, 0 at the top."""
        span = self._high - self._low or 1.0
        return (self._high - value) / span * (self._height * _DOTS_HIGH - 1)

    def dot(self, column: int, row: int, style: str) -> None:
        """Set a dot; what lies outside is left out."""
        if not (0 <= column < self.dots_wide and 0 <= row < self._height * _DOTS_HIGH):
            return
        cell = (row // _DOTS_HIGH, column // _DOTS_WIDE)
        dots, before = self._cells.get(cell, (0, ""))
        dots |= _DOTS[row % _DOTS_HIGH][column % _DOTS_WIDE]
        self._cells[cell] = dots, max(before, style, key=_RANKS.__getitem__)

    def curve(self, values: Sequence[float], style: str) -> None:
        """Draw one value a column of dots, joined; what is not known leaves a gap. What lies outside is cut off."""
        before: int | None = None
        for column, value in enumerate(values):
            if not math.isfinite(value):
                before = None
                continue
            # Far outside is just outside: nobody needs a line of a million dots.
            row = round(min(max(self.row(value), -1.0), self._height * _DOTS_HIGH))
            start = row if before is None or before == row else before + (1 if before < row else -1)
            for between in range(min(start, row), max(start, row) + 1):
                self.dot(column, between, style)
            before = row

    def lines(self) -> list[Text]:
        """Return the characters beside the labels, a text a line."""
        labels = dict(zip((0, self._height // 2, self._height - 1), self._labels, strict=True))
        found = []
        for y in range(self._height):
            cells = [self._cells.get((y, x), (0, "")) for x in range(self._width)]
            # Stretches of one style: each costs the terminal and its painter about the same, however long it is.
            stretches = groupby(cells, itemgetter(1))
            line = Text.assemble(
                *(("".join(chr(_BRAILLE + dots) if dots else " " for dots, _ in s), style) for style, s in stretches)
            )
            found.append(Text.assemble((labels.get(y, "").rjust(self._indent - 1) + "│", "dim"), line))
        return found


def band_plot(
    title: str,
    times: Sequence[float],
    values: Sequence[float],
    sds: Sequence[float],
    width: int,
    height: int,
    label: Callable[[float], str],
) -> list[Text]:
    """Return a plot of an estimate (bright) between one standard deviation below and above it.

    ``times`` rise; the range of values is that of the last fifth, so that a band which narrows is seen to. The first
    line is the title; ``label`` makes a text of a value.
    """
    rows = max(height - 1, 2)
    if len(times) < 2:
        return [Text(title, "bold"), Text("  waits for the estimate", "dim"), *(Text("") for _ in range(rows - 1))]
    late = times[-1] - _RECENT * (times[-1] - times[0])
    centre = values[-1]
    recent = [abs(v - centre) + sd for t, v, sd in zip(times, values, sds, strict=True) if t >= late]
    reach = max(*recent, _LEAST_SIGMAS * sds[-1]) * _MARGIN or 1.0
    canvas = Canvas(width, rows, centre - reach, centre + reach, label)
    at = _columns(times, canvas.dots_wide)
    canvas.curve([values[i] + sds[i] for i in at], _EDGE)
    canvas.curve([values[i] - sds[i] for i in at], _EDGE)
    canvas.curve([values[i] for i in at], _LINE)
    return [Text(title, "bold"), *canvas.lines()]


def gyro_plots(name: str, trend: Trend, width: int) -> list[Text]:
    """Return the four states of a gyro over time, two beside two, so many characters wide."""
    each = max((width - 2) // 2, 30)
    blocks = []
    for index, state in enumerate(STATE_FIGURES):
        values = [row[index] * state.factor for row in trend.values]
        sds = [row[index] * state.factor for row in trend.sds]
        label = partial(number, digits=state.digits)
        blocks.append(band_plot(f"{state.name} ({state.unit})", trend.times_s, values, sds, each, _STATE_ROWS, label))
    rows = [Text(f"{name}: estimate and one sigma   (left, right: other gyros)", "bold")]
    for left, right in (blocks[:2], blocks[2:]):
        for one, other in zip(left, right, strict=True):
            one.pad_right(max(each + 2 - one.cell_len, 0))
            rows.append(Text.assemble(one, other))
    return rows


def trend_plot(
    title: str,
    values: Sequence[float],
    sds: Sequence[float],
    limit: float,
    width: int,
    height: int,
    label: Callable[[float], str],
) -> list[Text]:
    """Return a plot of a state over calibrations, oldest first, each with its sigma as a bar.

    The limits, plus and minus ``limit``, are dotted lines where they are near; else the title says where they are.
    """
    rows = max(height - 1, 3)
    low = min(v - sd for v, sd in zip(values, sds, strict=True))
    high = max(v + sd for v, sd in zip(values, sds, strict=True))
    reach = max(high - low, abs(high) * 1e-9, 1e-12)
    drawn = [at for at in (limit, -limit) if math.isfinite(limit) and low - 2 * reach < at < high + 2 * reach]
    low, high = min([low, *drawn]), max([high, *drawn])
    low, high = low - 0.08 * (high - low or reach), high + 0.08 * (high - low or reach)
    said = "" if not math.isfinite(limit) else f"   limits ±{label(limit)}{'' if drawn else ', off the plot'}"
    canvas = Canvas(width, rows, low, high, label)
    for at in drawn:
        for column in range(0, canvas.dots_wide, 2):
            canvas.dot(column, round(canvas.row(at)), _LIMIT)
    for index, (value, sd) in enumerate(zip(values, sds, strict=True)):
        column = round((index + 0.5) / len(values) * canvas.dots_wide)
        for row in range(round(canvas.row(value + sd)), round(canvas.row(value - sd)) + 1):
            canvas.dot(column, row, _EDGE)
        for beside in (-1, 0, 1):
            canvas.dot(column + beside, round(canvas.row(value)), _LINE)
    return [Text(title + said, "bold"), *canvas.lines()]


def bar(share: float, width: int) -> str:
    """Return a progress bar, an eighth of a character fine."""
    eighths = round(min(max(share if math.isfinite(share) else 0.0, 0.0), 1.0) * width * 8)
    whole, part = divmod(eighths, 8)
    return ("█" * whole + (" ▏▎▍▌▋▊▉"[part] if part else "")).ljust(width, "·")


def _columns(times: Sequence[float], count: int) -> list[int]:
    """Return for each of ``count`` columns the index of the last time in or before it."""
    span = times[-1] - times[0] or 1.0
    return [bisect_right(times, times[0] + span * (column + 1) / count) - 1 for column in range(count)]
