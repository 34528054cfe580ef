"""One chart, drawn by textual-plot. It loads numpy: import it where nobody waits for a picture."""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from typing import ClassVar

from textual.binding import Binding
from textual.content import Content
from textual_plot import HiResMode, PlotWidget
from textual_plot.axis_formatter import NumericAxisFormatter

from station.screen.drawings import Curve, Drawing

_DOTS = HiResMode.BRAILLE
_DOTS_WIDE = 2
_LABEL_WIDTH, _TICK_WIDTH, _FRAME_HEIGHT = 9, 5, 3
_BACK = ("0 shows all", "limit")


class Chart(PlotWidget, inherit_bindings=False):
    """A chart with a title; focused, it goes back and forth in time, and takes a shorter or a longer time."""

    COMPONENT_CLASSES: ClassVar[set[str]] = {
        f"chart--{style}" for style in ("line", "band", "limit", "mark", "first", "second", "third")
    }
    BINDINGS: ClassVar = [
        Binding("left", "pan_left", "Earlier"),
        Binding("right", "pan_right", "Later"),
        Binding("plus", "zoom_x_in", "Shorter"),
        Binding("minus", "zoom_x_out", "Longer"),
    ]
    KEYBOARD_PAN_FACTOR = 8.0
    KEYBOARD_ZOOM_FACTOR = 1.0

    def __init__(self) -> None:
        super().__init__()
        for margin, size in ((PlotWidget.margin_top, 0), (PlotWidget.margin_bottom, 1)):
            self.set_reactive(margin, size)
        self.set_reactive(PlotWidget.margin_left, _LABEL_WIDTH)

    def show(self, drawing: Drawing, window: tuple[float, float] | None) -> None:
        """Show a drawing, all of its time or a window of it."""
        low_s, high_s = window or drawing.span
        self.clear()
        low, high = self._range(drawing)
        high_s = high_s if high_s > low_s else low_s + 1.0
        self.set_xlimits(low_s, high_s)
        room = self.size - (_LABEL_WIDTH, _FRAME_HEIGHT)
        whole = [float(n) for n in range(1, round(high_s + 0.5))] if drawing.whole else None
        self.set_xticks(_ticks(low_s, high_s, room.width // _TICK_WIDTH, whole))
        self.set_yticks(_ticks(low, high, room.height))
        self.set_ylimits(low, high)
        for mark in drawing.marks:
            if low_s < mark < high_s:
                self.add_v_line(mark, self._style("mark"))
        for level, style in drawing.levels:
            self.plot([low_s, high_s], [level, level], self._style(style), _DOTS)
        for curve in drawing.curves:
            self._draw(curve, low_s, high_s, low, high)
        self.border_title = self._title([*([_BACK] if window else ()), *drawing.words])

    def _draw(self, curve: Curve, low_s: float, high_s: float, low: float, high: float) -> None:
        if curve.sds:
            self.errorbar(curve.times_s, curve.values, None, curve.sds, "●", self._style(curve.style))
            return
        at = _columns(curve.times_s, low_s, high_s, max(self.size.width - _LABEL_WIDTH, 10) * _DOTS_WIDE)
        values = [min(max(curve.values[i], low), high) for i in at]  # what lies outside runs along the edge
        self.plot([curve.times_s[i] for i in at], values, self._style(curve.style), _DOTS)

    def _style(self, name: str) -> str:
        return str(self.get_component_rich_style(f"chart--{name}"))

    def _range(self, drawing: Drawing) -> tuple[float, float]:
        if math.isfinite(drawing.low) and drawing.high > drawing.low:
            return drawing.low, drawing.high
        known = [value for curve in drawing.curves for value in curve.values if math.isfinite(value)] or [0.0]
        margin = 0.08 * (max(known) - min(known)) or 1.0
        return min(known) - margin, max(known) + margin

    def _title(self, words: Sequence[tuple[str, str]]) -> Content:
        """Return as many of the words as there is room for: none is cut."""
        parts: list[tuple[str, str]] = []
        room = self.size.width - 4
        for word, style in words:
            room -= len(word) + 2
            if room < 0:
                break
            parts.append((f" {word} ", self._style(style) if style else ""))
        return Content.assemble(*parts)


def _ticks(low: float, high: float, room: int, ticks: list[float] | None = None) -> list[float]:
    """Return as many ticks as there is room for."""
    ticks = ticks or NumericAxisFormatter().get_ticks(low, high)
    return ticks[:: max(-(-len(ticks) // max(room, 1)), 1)]


def _columns(times: Sequence[float], low_s: float, high_s: float, count: int) -> list[int]:
    """Return the indices of at most ``count`` times, evenly over the range, and one beyond either edge."""
    first, last = max(bisect_left(times, low_s) - 1, 0), min(bisect_right(times, high_s) + 1, len(times))
    if last - first <= count:
        return list(range(first, last))
    step = (high_s - low_s) / count
    found = (bisect_right(times, low_s + step * (column + 1)) - 1 for column in range(count))
    return list(dict.fromkeys(at for at in found if at >= first))
