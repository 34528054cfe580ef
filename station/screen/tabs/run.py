"""Run: the present state of table and gyros, the narrowing of the estimates, whether the filter is right."""

import math
import textwrap
from functools import partial
from typing import Any, ClassVar

from rich.text import Text
from textual.app import ComposeResult
from textual.binding import Binding
from textual.containers import Container

from station.run.snapshot import Snapshot
from station.screen.bars import SILENCE_S, Lines
from station.screen.charts import Charts
from station.screen.dialogs import AskTextDialog
from station.screen.drawings import DIALS, RUN_CHARTS, Drawing, run_drawing, series_charts
from station.screen.figures import templated
from station.screen.sessions.live_run import LiveRun, Stage
from station.screen.tabs.manual import ManualScreen
from station.views.figures import figures_from

_SOURCES = ("sources", "details")  # beside the figures, or at the end of all
_MOST_EVENTS = 24
_REASON_ROWS = 4
_NIS_OFF = 0.25
_WHITE_OFF = 0.2
_MANY_SIGMAS = 4.0  # by which both must be off to be reported


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
        """Update all figures, and one chart per call; unchanged parts cost nothing."""
        run = self.station.shown
        width = self.size.width - 4
        wrapped = partial(textwrap.wrap, width=max(width, 1), max_lines=_REASON_ROWS, placeholder=" ...")
        shown = {"run": run, "others": self.station.others, "width": width, "wrapped": wrapped, "silence_s": SILENCE_S}
        self._show("progress", templated("progress.rich", {**shown, **self.manual_values()}))
        if run is None or run.snapshot is None:  # the screen still shows the run before
            for name in ("figures", *_SOURCES, "events"):
                self._show(name, Text())
            return
        values = _values(run, run.snapshot, self.has_class("-large"))
        self._show("figures", templated("figures.rich", values))
        sources = templated("sources.rich", values)
        for name in _SOURCES:
            self._show(name, sources)
        events = {"events": list(run.events)[-_MOST_EVENTS:], "wrap": textwrap.wrap, "width": max(width, 30)}
        self._show("events", templated("events.rich", events))
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
        gyros = run.seen[-1].gyros
        return run_drawing(name, run, gyros[self.gyro % len(gyros)])

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


def _values(run: LiveRun, snapshot: Snapshot, large: bool) -> dict[str, Any]:
    """Return the template values for axes, sources, innovations and states; after the run, the last known ones."""
    judged, style = _judgement(snapshot)
    return {
        "snapshot": snapshot,
        "old": run.stage is not Stage.RUNNING or run.silent_s > SILENCE_S,
        "moving": not run.at_rest,  # the last figures may be from before it came to rest
        "rate_hz": max((s.rate_hz for s in snapshot.sources if math.isfinite(s.rate_hz)), default=math.nan),
        "judged": judged,
        "style": style,
        "large": large,
        "state_figures": figures_from((run.hello.get("limits") or {}).get("units")),
    }


def _judgement(snapshot: Snapshot) -> tuple[str, str]:
    """Return a text on the innovations of the live filter, and its style.

    It says whether their NIS is off 1 or they are not white, by more than chance; "not known yet" with too few blocks.
    """
    if not (math.isfinite(snapshot.nis_recent) and math.isfinite(snapshot.whiteness)):  # too few blocks for either
        return "not known yet", "dim"
    by_chance = _MANY_SIGMAS / math.sqrt(max(snapshot.recent, 1))
    if abs(snapshot.nis_recent - 1) > max(_NIS_OFF, math.sqrt(2) * by_chance):
        return "NIS OFF 1: the noise or the model differs from what was assumed", "bold red"
    if abs(snapshot.whiteness) > max(_WHITE_OFF, by_chance):
        return "NOT WHITE: the model misses something", "bold red"
    return "good: near 1, and white", "green"
