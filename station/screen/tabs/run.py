"""Run: the present state of table and gyros, the narrowing of the estimates, whether the filter is right."""

from typing import ClassVar

from rich.text import Text
from textual.app import ComposeResult
from textual.binding import Binding
from textual.containers import Container

from station.run.snapshot import Snapshot
from station.screen.bars import Lines
from station.screen.charts import Charts
from station.screen.dialogs import AskTextDialog
from station.screen.drawings import Drawing
from station.screen.panes.measured import MeasuredView, events_text, measured_text, sources_text
from station.screen.panes.progress import ProgressView, progress_text
from station.screen.run_charts import DIALS, RUN_CHARTS, run_drawing, series_charts
from station.screen.sessions.live_run import SILENCE_S, LiveRun, Stage
from station.screen.tabs.manual import ManualScreen

_SOURCES = ("sources", "details")  # beside the figures, or at the end of all
_MOST_EVENTS = 24


class RunScreen(ManualScreen):
    """The run, live."""

    MODE = "run"
    BINDINGS: ClassVar = [
        ("p", "pause", "Pause/go on"),
        ("n", "note", "Note"),
        ("o", "others", "Sessions"),
        ("g,right", "gyro(1)", "Gyro"),
        Binding("left", "gyro(-1)", "Previous gyro", show=False),
    ]

    def body(self) -> ComposeResult:
        """Yield progress, figures, sources, charts, events and details."""
        yield Lines(id="progress")
        with Container(id="columns"):
            yield Lines(id="figures")
            yield Lines(id="sources")
            yield Charts(DIALS, self._drawing)
        yield Charts(RUN_CHARTS, self._drawing)
        yield Lines(id="events")
        yield Lines(id="details")

    def redraw(self) -> None:
        """Draw all at once, the charts too."""
        self.tick()
        for charts in self.query(Charts):
            charts.draw()

    on_screen_resume = redraw

    def tick(self) -> None:
        """Update all figures, and of each group of charts one at most; unchanged parts cost nothing.

        Before a run has figures those of the run before are cleared. A device's series get charts once there are some.
        """
        run = self.station.shown
        width = self.size.width - 4
        progress = ProgressView(run=run, others=self.station.others, width=width, manual=self.manual_view())
        self._show("progress", progress_text(progress))
        if run is None or run.snapshot is None:  # the screen still shows the run before
            for name in ("figures", *_SOURCES, "events"):
                self._show(name, Text())
            return
        self._show("figures", measured_text(_measured(run, run.snapshot, self.has_class("-large"))))
        sources = sources_text(run.snapshot)
        for name in _SOURCES:
            self._show(name, sources)
        self._show("events", events_text(list(run.events)[-_MOST_EVENTS:], width))
        if run.snapshot.series:
            self.query(Charts).last().add(series_charts(run.snapshot))
        for charts in self.query(Charts):
            charts.draw_next()

    def _show(self, name: str, text: Text) -> None:
        self.query_one(f"#{name}", Lines).show(text, text.plain.count("\n") + 1 if text else 0)

    def _drawing(self, name: str) -> Drawing | None:
        run = self.station.shown
        if run is None or not run.seen or not run.seen[-1].gyros:
            return None
        sensors = run.seen[-1].sensors
        return run_drawing(name, run, sensors[self.gyro % len(sensors)])

    def action_pause(self) -> None:
        """Pause after the current step, or resume."""
        self.station.pause_run()

    def action_others(self) -> None:
        self.station.choose_session()

    def action_note(self) -> None:
        if self.station.shown is not None and self.station.shown.active:
            self.app.push_screen(
                AskTextDialog("Note for the recording (Enter saves it, Escape goes back)"), self.station.note_run
            )


def _measured(run: LiveRun, snapshot: Snapshot, large: bool) -> MeasuredView:
    """Return ``snapshot`` as the figures of a run; ``old`` after it, or while the session is lost or silent."""
    return MeasuredView(
        snapshot=snapshot,
        figures=run.limits.figures,
        old=run.stage is not Stage.RUNNING or run.silent_s > SILENCE_S,
        moving=not run.at_rest,  # the last figures may be from before it came to rest
        large=large,
    )
