"""One chart, drawn by textual-plot. It loads numpy: import it where nobody waits for a picture."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Callable, Sequence
from typing import ClassVar

from textual.app import ComposeResult
from textual.binding import Binding
from textual.containers import Grid
from textual.content import Content
from textual.strip import Strip
from textual_hires_canvas import Canvas
from textual_plot import HiResMode, PlotWidget
from textual_plot.axis_formatter import NumericAxisFormatter
from textual_plot.plot_widget import Legend

from station.screen.drawings import Drawing

_DOTS, _DOTS_WIDE = HiResMode.BRAILLE, 2
_LABEL_WIDTH, _TICK_WIDTH = 9, 5


class _Canvas(Canvas):
    """A canvas whose lines always have a style: those without one end the app where colours are taken away."""

    def render_line(self, y: int) -> Strip:
        strip = super().render_line(y)
        return strip if strip.cell_length else Strip.blank(0, self.rich_style)


class _TimeFormatter(NumericAxisFormatter):
    """Names the unit of time once, at the last tick."""

    unit = "s"

    def get_labels_for_ticks(self, ticks: Sequence[float]) -> list[str]:
        *others, last = super().get_labels_for_ticks(ticks) or [""]
        return [*others, f"{last} {self.unit}"]


class Chart(PlotWidget, inherit_bindings=False):
    """A chart with a title; focused, it goes back and forth in time, and takes a shorter or a longer time."""

    COMPONENT_CLASSES: ClassVar[set[str]] = {
        f"chart--{style}" for style in ("line", "band", "limit", "mark", "first", "second", "third")
    }
    BINDINGS: ClassVar = [
        Binding("left", "pan_left", "Earlier", show=False),
        Binding("right", "pan_right", "Later", show=False),
        Binding("plus", "zoom_x_in", "Shorter", key_display="+", show=False),
        Binding("minus", "zoom_x_out", "Longer", key_display="-", show=False),
        Binding("z", "enlarge", "Enlarge"),
    ]
    KEYBOARD_PAN_FACTOR = 8.0
    KEYBOARD_ZOOM_FACTOR = 1.0

    def __init__(self, draw: Callable[[], None]) -> None:
        """``draw`` has this chart drawn: it gets its size late, in a part that is scrolled to."""
        super().__init__()
        self._draw_again = draw
        self._x_formatter: _TimeFormatter = _TimeFormatter()
        self.set_reactive(PlotWidget.margin_top, 0)
        self.set_reactive(PlotWidget.margin_bottom, 1)
        self.set_reactive(PlotWidget.margin_left, _LABEL_WIDTH)

    def on_resize(self) -> None:
        """Draw anew once the size is there."""
        self.call_after_refresh(self._draw_again)

    def action_enlarge(self) -> None:
        """Take all the room, or go back."""
        if self.is_maximized:
            self.screen.minimize()
        else:
            self.screen.maximize(self, container=False)

    def compose(self) -> ComposeResult:
        """Lay out what ``PlotWidget`` draws on."""
        with Grid():
            for name in ("margin-top", "margin-left", "plot", "margin-bottom"):
                yield _Canvas(1, 1, id=name)
        yield Legend(id="legend")

    def show(self, drawing: Drawing, window: tuple[float, float] | None) -> None:
        """Show a drawing, all of its time or a window of it; its title has the words that there is room for."""
        low, high = window or (drawing.span[0], max(drawing.span[1], drawing.span[0] + 1.0))
        cells = max(self.size.width - _LABEL_WIDTH, _TICK_WIDTH)
        self.clear()
        self.set_xlimits(low, high)
        self.set_ylimits(drawing.low, drawing.high)
        ticks = self._x_formatter.get_ticks(low, high)
        self.set_xticks(ticks[:: -(-len(ticks) * _TICK_WIDTH // cells)])
        self._x_formatter.unit = drawing.over
        for mark in drawing.marks:
            if low < mark < high:
                self.add_v_line(mark, self._style("mark"))
        for times, values, style, sds in drawing.curves:
            if sds:
                self.errorbar(times, values, None, sds, "●", self._style(style))
                continue
            first, last = max(bisect_left(times, low) - 1, 0), bisect_right(times, high) + 1
            part = slice(first, last, max((last - first) // (cells * _DOTS_WIDE), 1))
            self.plot(times[part], values[part], self._style(style), _DOTS)
        room = self.size.width - 4
        words = [*([("0 shows all", "limit")] if window else []), *drawing.words]
        fitting = [word for at, word in enumerate(words) if sum(len(text) + 2 for text, _ in words[: at + 1]) <= room]
        self.border_title = Content.assemble(*((f" {text} ", self._style(s) if s else "") for text, s in fitting))

    def _style(self, name: str) -> str:
        return str(self.get_component_rich_style(f"chart--{name}"))
