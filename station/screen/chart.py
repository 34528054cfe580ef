"""One chart, drawn by textual-plot. It loads numpy: import it only where nobody waits for a picture."""

import math
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Sequence
from datetime import datetime
from itertools import pairwise
from typing import ClassVar, Self

import numpy as np
from textual.app import ComposeResult
from textual.binding import Binding
from textual.containers import Grid
from textual.content import Content
from textual.geometry import Region
from textual.strip import Strip
from textual_hires_canvas import Canvas
from textual_plot import HiResMode, PlotWidget
from textual_plot.axis_formatter import NumericAxisFormatter
from textual_plot.plot_widget import Legend

from drivers.types import Floats
from station.screen.drawings import Drawing
from station.screen.run_charts import DIALS

_DOTS, _DOTS_WIDE, _DOTS_HIGH = HiResMode.BRAILLE, 2, 4
_DAY_S, _YEAR_DAYS = 86400.0, 300.0
_LABEL_WIDTH, _TICK_WIDTH, _MARGIN, _DIAL_REACH = 9, 6, 0.06, 1.08


class _Canvas(Canvas):
    """A canvas whose lines always have a style: lines without one end the app where colours are switched off."""

    def refresh(self, *regions: Region, repaint: bool = True, layout: bool = False, recompose: bool = False) -> Self:
        """Ask once for all dots: each that is set asks for the whole canvas to be painted."""
        if self._repaint_required and not (regions or layout or recompose):
            return self
        return super().refresh(*regions, repaint=repaint, layout=layout, recompose=recompose)

    def render_line(self, y: int) -> Strip:
        strip = super().render_line(y)
        return strip if strip.cell_length else Strip.blank(0, self.rich_style)


class _Ticks(NumericAxisFormatter):
    """Axis ticks as room permits, with as many digits as needed; the unit stands at the first."""

    room, unit = 1, ""
    began_utc_s: float | None = None
    """Instant of time 0 if days are shown as dates."""

    def get_ticks(self, min_: float, max_: float, max_ticks: int = 8) -> list[float]:
        ticks = super().get_ticks(min_, max_, max_ticks)
        step = max(-(-len(ticks) // max(self.room, 1)), 1)
        return ticks[min(range(len(ticks)), key=lambda at: abs(ticks[at]), default=0) % step :: step]

    def get_labels_for_ticks(self, ticks: Sequence[float]) -> list[str]:
        """Return a label for each tick: dates or times of day if the axis has a begin, empty where they repeat.

        Else numbers, all with the digits that the finest needs, seven at most, and the unit at the first.
        """
        if self.began_utc_s is not None:
            dates = [datetime.fromtimestamp(self.began_utc_s + tick * _DAY_S) for tick in ticks]
            span_days = ticks[-1] - ticks[0] if ticks else 0.0
            form = "%H:%M" if span_days < 1 else "%m-%d" if span_days < _YEAR_DAYS else "%Y-%m"
            labels = [format(date, form) for date in dates]
            return [label if label != before else "" for before, label in pairwise(["", *labels])]
        digits = max((len(f"{tick:.7f}".rstrip("0").partition(".")[2]) for tick in ticks), default=0)
        return [f"{round(tick, digits) + 0.0:.{digits}f}{'' if at else self.unit}" for at, tick in enumerate(ticks)]


class Chart(PlotWidget, inherit_bindings=False):
    """A chart with a title; when focused, keys move and scale its time window."""

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
    KEYBOARD_ZOOM_FACTOR = 0.5

    def __init__(self, draw: Callable[[], None], name: str) -> None:
        """``draw`` draws this chart; it is called on a resize, as a chart out of sight gets its size late.

        ``name`` is the chart's, and a class of its style. A chart whose name is in ``DIALS`` has no margins for axes.
        """
        super().__init__(classes=name)
        self._draw_again = draw
        self._x_formatter, self._y_formatter = self._over, self._along = _Ticks(), _Ticks()
        self.set_reactive(PlotWidget.margin_top, 0)
        self.set_reactive(PlotWidget.margin_bottom, int(name not in DIALS))
        self.set_reactive(PlotWidget.margin_left, 0 if name in DIALS else _LABEL_WIDTH)

    def on_resize(self) -> None:
        """Draw again once the size is known."""
        self.call_after_refresh(self._draw_again)

    def action_enlarge(self) -> None:
        """Take all the room, or go back."""
        if self.is_maximized:
            self.screen.minimize()
        else:
            self.screen.maximize(self, container=False)

    def compose(self) -> ComposeResult:
        """Lay out the parts that ``PlotWidget`` draws on."""
        with Grid():
            for name in ("margin-top", "margin-left", "plot", "margin-bottom"):
                yield _Canvas(1, 1, id=name)
        yield Legend(id="legend")

    def show(self, drawing: Drawing, window: tuple[float, float] | None) -> None:
        """Show a drawing, for all of its time or for ``window``, first and last in the unit of its times.

        The title has as many words as fit; with a window it says which key shows all. A dial has no axes and no window,
        and its circles are round. Without a range the values in sight give it. Curves without error bars are thinned to
        the dots there are.
        """
        time = window or (drawing.span[0], max(drawing.span[1], drawing.span[0] + 1.0))
        low, high = (-math.inf, math.inf) if drawing.dial else time
        cells = max(self.size.width - _LABEL_WIDTH, _TICK_WIDTH)
        width = _TICK_WIDTH if drawing.began_utc_s is None else _TICK_WIDTH + 2
        self._over.room, self._over.unit = cells // width, f" {drawing.over}"
        self._over.began_utc_s = drawing.began_utc_s
        self._along.room = (self.size.height - 1) // 2
        self.clear()
        for mark in drawing.marks:
            if low < mark < high:
                self.add_v_line(mark, self._style("mark"))
        shown = [np.array([0.0])]
        for times, values, style, sds in drawing.curves:
            first, last = max(bisect_left(times, low) - 1, 0), bisect_right(times, high) + 1
            part = slice(first, last, 1 if sds else max((last - first) // (cells * _DOTS_WIDE), 1))
            shown.append(np.array(values[part]))
            if sds:
                self.errorbar(times[part], values[part], None, sds[part], "●", self._style(style))
            else:
                self.plot(times[part], values[part], self._style(style), _DOTS)
        reach = drawing.range or _around(np.concatenate(shown[1:] or shown))
        if drawing.dial:  # whose circles are to be round
            shape = max(self.size.width - 2, 1) * _DOTS_WIDE / (max(self.size.height - 2, 1) * _DOTS_HIGH)
            high, up = (_DIAL_REACH * max(ratio, 1.0) for ratio in (shape, 1 / shape))
            low, reach = -high, (-up, up)
        self.set_xlimits(low, high)
        self.set_xticks([] if drawing.dial else None)
        self.set_yticks(None if drawing.curves and not drawing.dial else [])
        self.set_ylimits(*reach)
        name, *others = drawing.words
        room, title = self.size.width - 4, Content(" ")
        if others and len(name[0]) + len(others[0][0]) + 2 >= room:  # the figure goes before its unit
            name = name[0].partition(" (")[0], name[1]
        for text, style in [name, *([("0 shows all", "limit")] if window else []), *others]:
            if title.cell_length + len(text) < room:
                title += Content.assemble((text, self._style(style) if style else ""), " ")
        self.border_title = title
        self.render()  # now, so that the terminal is written to once for all that this tick has changed

    def _style(self, name: str) -> str:
        return str(self.get_component_rich_style(f"chart--{name}"))


def _around(values: Floats) -> tuple[float, float]:
    """Return a range somewhat wider than that of values."""
    finite = values[np.isfinite(values)]
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 0.0)
    margin = _MARGIN * (high - low) or 1.0
    return low - margin, high + margin
