"""The charts of a screen: side by side as the room allows, or one in sight and the others scrolled to."""

import asyncio
from collections.abc import Callable, Sequence
from functools import partial
from importlib import import_module
from typing import TYPE_CHECKING, Any, cast

from textual.binding import Binding
from textual.containers import Grid

from station.screen.app_protocol import SeenApp
from station.screen.drawings import Drawing

if TYPE_CHECKING:
    from station.screen.chart import Chart

_WIDE_TO_HIGH, _LEAST_ROWS = 3.0, 7.0
_TICKS = 3
"""In so many ticks one chart is drawn anew, so that no key waits for several, and the session keeps its core."""


class Charts(Grid):
    """Charts by name. A function returns the drawing of each, None while there is nothing to show."""

    BINDINGS = [Binding("0", "show_all", "All of the time", show=False)]  # noqa: RUF012

    def __init__(self, names: Sequence[str], draw: Callable[[str], Drawing | None]) -> None:
        super().__init__()
        self._names, self._draw = list(names), draw
        self._charts: list[Chart] = []
        self._turn = 0
        self._window: tuple[float, float] | None = None

    def on_show(self) -> None:
        """Load the charts after the first picture, as their libraries take a while to load."""
        self.call_after_refresh(lambda: cast(SeenApp, self.app).work(self._bring, f"charts {id(self)}"))

    async def _bring(self) -> None:
        await self._mount_missing()

    def add(self, names: Sequence[str]) -> None:
        """Show more charts, after those that are there; a name that is known is passed over."""
        new = [name for name in names if name not in self._names]
        self._names = [*self._names, *new]
        if new and self._charts:
            self.call_after_refresh(lambda: cast(SeenApp, self.app).work(self._mount_missing, f"more {id(self)}"))

    async def _mount_missing(self) -> None:
        """Create the charts that have a name but no widget yet; their library is loaded in a thread.

        Nothing if there are none, or if this widget was removed meanwhile.
        """
        kind = (await asyncio.to_thread(import_module, "station.screen.chart")).Chart
        missing = range(len(self._charts), len(self._names))
        if not self.is_attached or not missing:
            return
        charts = [kind(partial(self.draw, at), self._names[at]) for at in missing]
        self._charts = [*self._charts, *charts]
        await self.mount(*charts)
        self.on_resize()
        self.draw()

    def on_resize(self) -> None:
        """Choose the number of columns that gives each chart the most room; if they do not all fit, show one at a
        time.
        """
        count, size = sum(chart.display for chart in self._charts) or len(self._names), self.size
        room = {n: min(size.width / n / _WIDE_TO_HIGH, size.height / -(-count // n)) for n in range(1, count + 1)}
        across = max(room, key=room.__getitem__)
        fits = room[across] >= _LEAST_ROWS
        self.styles.grid_size_columns = across if fits else 1
        self.styles.grid_rows = "1fr" if fits else "100%"

    def draw(self, only: int | None = None) -> None:
        """Draw all charts, or only number ``only``; charts out of sight are skipped, those without a drawing hidden.

        A hidden chart that has a drawing again is shown at once and drawn when it has its size.
        """
        for at, chart in enumerate(self._charts):
            if only not in (None, at):
                continue
            if chart.visible and not chart.size.area:  # scrolled out of sight: drawn once it gets a size
                continue
            drawing = self._draw(self._names[at])
            chart.visible = drawing is not None  # a hidden chart has no size: show it first, its resize draws it
            if drawing is not None and chart.size.area:
                chart.show(drawing, self._window)

    def draw_next(self) -> None:
        """Draw the chart whose turn it is, of those in sight."""
        seen = [at for at, chart in enumerate(self._charts) if self._in_sight(chart)] or [0]
        self._turn = (self._turn + 1) % (_TICKS * len(seen))
        if self._turn % _TICKS == 0:
            self.draw(seen[self._turn // _TICKS])

    def _in_sight(self, chart: "Chart") -> bool:
        """Return whether any part of a chart is visible, or the chart is maximized."""
        top = chart.virtual_region.y - self.scroll_offset.y
        return chart.is_maximized or -chart.size.height < top < self.size.height

    def on_plot_widget_scale_changed(self, event: Any) -> None:
        """Show in all charts the time that one was moved to."""
        self._window = event.x_min, event.x_max
        self.draw()

    def action_show_all(self) -> None:
        """Show the whole time range, including what comes."""
        self._window = None
        self.draw()
