"""The charts of a screen, side by side as the room allows, or one after the other."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, cast

from textual import events
from textual.containers import Grid

from station.screen.drawings import Drawing
from station.screen.seen_app import SeenApp

if TYPE_CHECKING:
    from station.screen.chart import Chart

_WIDE_TO_HIGH = 3.0
_LEAST_ROWS = 8.0
_TURNS = 10
"""Every chart is drawn anew once in so many ticks, one at a tick, so that no key waits for several."""


class Charts(Grid):
    """Charts by name, drawn by a function that returns what each is to show; None while there is nothing."""

    def __init__(self, names: Sequence[str], draw: Callable[[str], Drawing | None]) -> None:
        super().__init__(id="charts")
        self._names, self._draw = names, draw
        self._charts: list[Chart] = []
        self._first = self._turn = 0
        self._all = True
        self._stamps: dict[str, object] = {}
        self._window: tuple[float, float] | None = None

    def on_mount(self) -> None:
        """Bring the charts once the first picture is out: what draws them takes a while to load."""
        self.call_after_refresh(lambda: cast(SeenApp, self.app).work(self._bring, f"charts {id(self)}"))

    async def _bring(self) -> None:
        def load() -> type[Chart]:
            from station.screen.chart import Chart

            return Chart

        kind = await asyncio.to_thread(load)
        if self.is_attached:
            charts = [kind() for _ in self._names]
            await self.mount(*charts)
            self._charts = charts
            self._arrange()
            self.call_after_refresh(self.draw)

    def on_resize(self, event: events.Resize) -> None:
        """Lay the charts out anew."""
        self._arrange()
        self.call_after_refresh(self.draw)

    def _arrange(self) -> None:
        """Choose the columns that leave each chart the most room; if that is too little for all, show one."""
        count, size = len(self._names), self.size
        room = {n: min(size.width / n / _WIDE_TO_HIGH, size.height / -(-count // n)) for n in range(1, count + 1)}
        across = max(room, key=room.__getitem__)
        self._all = room[across] >= _LEAST_ROWS
        self.styles.grid_size_columns = across if self._all else 1
        for number, chart in enumerate(self._charts):
            chart.display = self._all or number == self._first

    def draw(self) -> None:
        """Draw all that are in sight."""
        for name, chart in zip(self._names, self._charts, strict=False):
            self._draw_one(name, chart)

    def draw_next(self, stamp: object) -> None:
        """Draw the chart whose turn it is, unless it was drawn with this stamp."""
        self._turn = (self._turn + 1) % max(_TURNS, len(self._names))
        for name, chart in list(zip(self._names, self._charts, strict=False))[self._turn :][:1]:
            if self._stamps.get(name) != stamp:
                self._stamps[name] = stamp
                self._draw_one(name, chart)

    def _draw_one(self, name: str, chart: Chart) -> None:
        if chart.display and chart.size.area:
            drawing = self._draw(name)
            chart.visible = drawing is not None
            if drawing is not None:
                chart.show(drawing, self._window)

    def next(self) -> None:
        """Give the next chart the focus, and show it if there is room for one."""
        if not self._charts:
            return
        focused = self.screen.focused
        at = self._charts.index(cast(Any, focused)) if focused in self._charts else self._first if not self._all else -1
        self._first = (at + 1) % len(self._charts)
        self._arrange()
        chart = self._charts[self._first]
        if self.screen.maximized is not None:
            chart.display = True
            self.screen.maximize(chart, container=False)
        self.screen.set_focus(chart)
        self.call_after_refresh(self.draw)

    def enlarge(self) -> None:
        """Give the chart that has the focus, or the first, all the room; or put it back."""
        if self.screen.maximized is not None:
            self.screen.minimize()
        elif self._charts:
            focused = self.screen.focused
            chart = focused if focused in self._charts else self._charts[self._first]
            self.screen.set_focus(chart)
            self.screen.maximize(cast(Any, chart), container=False)
        self.call_after_refresh(self.draw)

    def on_plot_widget_scale_changed(self, event: Any) -> None:
        """Show in all charts the time that one was moved to."""
        event.stop()
        self._window = event.x_min, event.x_max
        self.draw()

    def show_all(self) -> None:
        """Show all of the time, and what comes."""
        self._window = None
        self.draw()
