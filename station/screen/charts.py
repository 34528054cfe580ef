"""The charts of a screen, side by side as the room allows, or one after the other."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from functools import partial
from importlib import import_module
from typing import TYPE_CHECKING, Any, cast

from textual.containers import Grid

from station.screen.drawings import Drawing
from station.screen.seen_app import SeenApp

if TYPE_CHECKING:
    from station.screen.chart import Chart

_WIDE_TO_HIGH, _LEAST_ROWS = 3.0, 8.0
_TURNS = 10
"""Every chart is drawn anew once in so many ticks, one at a tick, so that no key waits for several."""


class Charts(Grid):
    """Charts by name, drawn by a function that returns what each is to show; None while there is nothing."""

    def __init__(self, names: Sequence[str], draw: Callable[[str], Drawing | None]) -> None:
        super().__init__(id="charts")
        self._names, self._draw = names, draw
        self._charts: list[Chart] = []
        self._first = self._turn = 0
        self._window: tuple[float, float] | None = None

    def on_mount(self) -> None:
        """Bring the charts once the first picture is out: what draws them takes a while to load."""
        self.call_after_refresh(lambda: cast(SeenApp, self.app).work(self._bring, f"charts {id(self)}"))

    async def _bring(self) -> None:
        kind = (await asyncio.to_thread(import_module, "station.screen.chart")).Chart
        if self.is_attached:
            charts = [kind(partial(self.draw, [at])) for at in range(len(self._names))]
            for chart in charts:
                chart.styles.opacity = 0.0  # until there is something to show; what is not visible gets no size
            await self.mount(*charts)
            self._charts = charts
            self.on_resize()

    def on_resize(self) -> None:
        """Choose the columns that leave each chart the most room; if that is too little for all, show one."""
        count, size = len(self._names), self.size
        room = {n: min(size.width / n / _WIDE_TO_HIGH, size.height / -(-count // n)) for n in range(1, count + 1)}
        across = max(room, key=room.__getitem__)
        fits = room[across] >= _LEAST_ROWS
        self.styles.grid_size_columns = across if fits else 1
        for number, chart in enumerate(self._charts):
            chart.display = fits or number == self._first
        self.call_after_refresh(self.draw)

    def draw(self, only: Sequence[int] | None = None) -> None:
        """Draw all that are in sight, or ``only`` some of them."""
        for at, chart in enumerate(self._charts):
            if chart.display and chart.size.area and (only is None or at in only):
                drawing = self._draw(self._names[at])
                chart.styles.opacity = 0.0 if drawing is None else 1.0
                if drawing is not None:
                    chart.show(drawing, self._window)

    def draw_next(self) -> None:
        """Draw the chart whose turn it is."""
        self._turn = (self._turn + 1) % max(_TURNS, len(self._names))
        self.draw([self._turn])

    def next(self) -> None:
        """Give the next chart the focus, and show it if there is room for one."""
        self.screen.minimize()
        focused = [chart.has_focus for chart in self._charts]
        at = focused.index(True) if any(focused) else -1 if all(c.display for c in self._charts) else self._first
        self._first = (at + 1) % len(self._names)
        self.on_resize()
        self.screen.set_focus(self._charts[self._first] if self._charts else None)

    def enlarge(self) -> None:
        """Give the chart that has the focus, or the first, all the room; or put it back."""
        if self.screen.maximized is not None or not self._charts:
            self.screen.minimize()
        else:
            chart = next((chart for chart in self._charts if chart.has_focus), self._charts[self._first])
            self.screen.set_focus(chart)
            self.screen.maximize(chart, container=False)
        self.call_after_refresh(self.draw)

    def on_plot_widget_scale_changed(self, event: Any) -> None:
        """Show in all charts the time that one was moved to."""
        self._window = event.x_min, event.x_max
        self.draw()

    def show_all(self) -> None:
        """Show all of the time, and what comes."""
        self._window = None
        self.draw()
