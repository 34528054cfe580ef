"""The rates of the axes over time, drawn with characters."""

import math

import numpy as np
from numpy.typing import NDArray

from drivers.types import Floats
from station.scripts.planned import PlannedMotion

_UP = " ▁▂▃▄▅▆▇█"
_DOWN = " ▔▀█"
_STANDS, _MAY_LAST = "_", "~"
_LABEL = "{:>2} {:>12} "
_STEPS_S = (1, 2, 5, 10, 15, 20, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 14400, 36000)
_LEAST_TICK = 9


def profile_lines(motion: PlannedMotion, width: int) -> list[str]:
    """Return a drawing of the rates, ``width`` characters wide: bars up for positive rates, down for negative ones.

    Each axis has a row, and a second one below it if it ever turns backwards, scaled to its largest rate; a column
    shows the largest rate of its time. A row begins with the largest rate that way, the first of an axis with its name.
    Axes are sorted by name. Standstill of open duration is marked with ~. The last two lines are the time axis. There
    are ten columns of bars or more, even if ``width`` is less.
    """
    columns = max(width - len(_LABEL.format("", "")), 10)
    edges = np.linspace(0, len(motion.t_s), columns + 1).astype(int)[:-1]
    may_last = _columns_within(motion, edges)
    lines = []
    for column, axis in sorted(enumerate(motion.gimbals), key=lambda pair: pair[1]):
        rate = motion.rate_rps[:, column]
        largest = float(np.abs(rate).max())
        up, down = np.maximum.reduceat(rate, edges), -np.minimum.reduceat(rate, edges)
        lines.append(_LABEL.format(axis, _rate(up.max())) + _bars(up, largest, _UP, at_rest=may_last))
        if down.max() > 0:
            lines.append(_LABEL.format("", _rate(-down.max())) + _bars(down, largest, _DOWN))
    return lines + _time_axis(float(motion.t_s[-1] + motion.t_s[0]), columns)


def _rate(rate_rps: float) -> str:
    return f"{math.degrees(rate_rps):+.4g} deg/s" if rate_rps else "0 deg/s"


def _columns_within(motion: PlannedMotion, edges: NDArray[np.int64]) -> str:
    """Return one character for each column, to be drawn if the axis stands: ~ in a step of open duration, else _.

    ``edges`` (columns,) are the rows of the motion at which the columns begin. The rates are not looked at.
    """
    ends = np.append(edges[1:], len(motion.t_s)) - 1
    characters = []
    for begin_s, end_s in zip(motion.t_s[edges], motion.t_s[ends], strict=True):
        may_last = any(begin_s < open_end_s and end_s > open_begin_s for open_begin_s, open_end_s in motion.open_s)
        characters.append(_MAY_LAST if may_last else _STANDS)
    return "".join(characters)


def _bars(size: Floats, largest: float, blocks: str, at_rest: str = "") -> str:
    """Return a bar for each size (columns,), as a character of ``blocks``, relative to ``largest``.

    ``blocks`` begins with that of an empty bar, which is never drawn: the least positive size gets the next one.
    Columns with a size of 0 or less get the characters of ``at_rest``, one each, or blanks if it is "".
    """
    steps = len(blocks) - 1
    share = np.clip(size / largest, 0, 1) if largest else np.zeros_like(size)
    still = at_rest or " " * len(share)
    characters = []
    for size_share, stands in zip(share, still, strict=True):
        # The least that turns at all is drawn as something.
        height = math.ceil(round(float(size_share) * steps, 6))
        characters.append(blocks[height] if size_share > 0 else stands)
    return "".join(characters)


def _time_axis(duration_s: float, columns: int) -> list[str]:
    """Return the two lines of the time axis: the ruler, ``columns`` wide, and the labels up to ``duration_s``.

    Both have the indent of the bars.
    """
    most = max(columns // _LEAST_TICK, 1)
    step = next((s for s in _STEPS_S if duration_s / s <= most), duration_s)
    ruler, labels = ["─"] * columns, [" "] * columns
    for number in range(int(duration_s / step + 1e-9) + 1):
        at = min(round(number * step / duration_s * columns), columns - 1)
        ruler[at] = "┬"
        text = f"{number * step:g}" + (" s" if number == 0 else "")
        start = min(at, columns - len(text))
        labels[start : start + len(text)] = text
    indent = _LABEL.format("", "")
    return [indent + "".join(ruler), indent + "".join(labels).rstrip()]
