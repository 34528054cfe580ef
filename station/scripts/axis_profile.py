"""The rates of the axes over time, drawn with characters."""

import math

import numpy as np

from drivers.types import Floats
from station.scripts.planned import PlannedMotion

_UP = " ▁▂▃▄▅▆▇█"
_DOWN = " ▔▀█"
_LABEL = "{:>2} {:>12} "
_STEPS_S = (1, 2, 5, 10, 15, 20, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 14400, 36000)
_LEAST_TICK = 9


def profile_lines(motion: PlannedMotion, width: int) -> list[str]:
    """Return the drawing, ``width`` characters wide: bars up for positive rates, hanging from the line for negative.

    Each axis has a row, a second one below it if it ever turns backwards, scaled to its own largest rate; a
    column shows the largest rate of its time. Below is the time.
    """
    columns = max(width - len(_LABEL.format("", "")), 10)
    edges = np.linspace(0, len(motion.t_s), columns + 1).astype(int)[:-1]
    lines = []
    for column, axis in sorted(enumerate(motion.gimbals), key=lambda pair: pair[1]):
        rate = motion.rate_rps[:, column]
        largest = float(np.abs(rate).max())
        up, down = np.maximum.reduceat(rate, edges), -np.minimum.reduceat(rate, edges)
        lines.append(_LABEL.format(axis, _rate(up.max())) + _bars(up, largest, _UP, rest="_"))
        if down.max() > 0:
            lines.append(_LABEL.format("", _rate(-down.max())) + _bars(down, largest, _DOWN))
    return lines + _time_axis(float(motion.t_s[-1] + motion.t_s[0]), columns)


def _rate(rate_rps: float) -> str:
    return f"{math.degrees(rate_rps):+.4g} deg/s" if rate_rps else "0 deg/s"


def _bars(size: Floats, largest: float, blocks: str, rest: str = " ") -> str:
    steps = len(blocks) - 1
    share = np.clip(size / largest, 0, 1) if largest else np.zeros_like(size)
    # The least that turns at all is drawn as something.
    return "".join(blocks[math.ceil(round(float(s) * steps, 6))] if s > 0 else rest for s in share)


def _time_axis(duration_s: float, columns: int) -> list[str]:
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
