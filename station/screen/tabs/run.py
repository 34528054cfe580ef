"""Run: what the table and the gyros do now, how the estimates narrow, whether the filter is right."""

from __future__ import annotations

import math
import textwrap
from typing import ClassVar

from rich.text import Text
from textual.app import ComposeResult
from textual.binding import Binding
from textual.containers import Container, Vertical

from station.run.snapshot import PAUSED, Snapshot, SourceSnapshot
from station.screen.bars import SILENCE_S, Lines
from station.screen.base import StationScreen
from station.screen.charts import Charts
from station.screen.dialogs import AskTextDialog
from station.screen.drawings import RUN_CHARTS, Drawing, run_drawing
from station.screen.figures import bar, columns, headed, state_lines
from station.screen.sessions.live_run import LiveRun, Stage
from station.views.figures import OUTCOME_STYLES, clock, number

_FIGURES, _EVENTS = ("axes", "sources", "innovations", "estimates"), ("events", "latest")
_MOST_EVENTS = 24
_REASON_ROWS = 4
_NIS_OFF = 0.25
_WHITE_OFF = 0.2
_MANY_SIGMAS = 4.0  # by which both are off before anybody is to look
_DEG = math.degrees(1)
_STAGE_WORDS = {Stage.STARTING: "the session is starting", Stage.RUNNING: "connected, waiting for the first figures"}


class RunScreen(StationScreen):
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
        yield Lines(id="progress")
        with Container(id="columns"):
            with Vertical(id="figures"):
                for name in _FIGURES:
                    yield Lines(id=name, classes="block")
            yield Lines(id="events", classes="block")
        yield Charts(RUN_CHARTS, self._drawing)
        yield Lines(id="latest", classes="block")

    def redraw(self) -> None:
        """Draw all at once, the charts too."""
        self.tick()
        self.query_one(Charts).draw()

    on_screen_resume = redraw

    def tick(self) -> None:
        """Show figures at each tick, one of the charts, too; what has not changed costs nothing."""
        run = self.station.shown
        if run is None:
            others = self.station.others
            said = f"{others} of your sessions run: o shows one." if others else "No session runs."
            self._show("progress", [Text(f"{said} F2 prepares one."), Text("")])
            return
        self._show("progress", _progress(run, self.size.width - 4))
        snapshot = run.snapshot
        if snapshot is None:  # what is there is of the run before
            for name in (*_FIGURES, *_EVENTS):
                self._show(name, [])
            return
        large = self.has_class("-large")
        for name, rows in (
            ("axes", axis_lines(snapshot, run)),
            ("sources", source_lines(snapshot) if large else source_summary(snapshot)),
            ("innovations", innovation_lines(snapshot)),
            ("estimates", state_lines(snapshot.gyros, nis=True)),
        ):
            self._show(name, rows)
        for name in _EVENTS:
            self._show(name, _event_lines(run, max(self.query_one(f"#{name}").size.width, 30)))
        self.query_one(Charts).draw_next()

    def _show(self, name: str, rows: list[Text]) -> None:
        self.query_one(f"#{name}", Lines).show(Text("\n").join(rows), len(rows))

    def _drawing(self, name: str) -> Drawing | None:
        run = self.station.shown
        if run is None or not run.seen or not run.seen[-1].gyros:
            return None
        gyros = run.seen[-1].gyros
        return run_drawing(name, run, gyros[self.gyro % len(gyros)])

    def action_pause(self) -> None:
        """Hold after the step under way, or go on."""
        self.station.pause_run()

    def action_others(self) -> None:
        self.station.choose_session()

    def action_note(self) -> None:
        if self.station.shown is not None and self.station.shown.active:
            self.app.push_screen(
                AskTextDialog("Note for the record (Enter keeps it, Escape goes back)"), self.station.note_run
            )


def _progress(run: LiveRun, width: int) -> list[Text]:
    snapshot = run.snapshot
    if run.stage is Stage.ENDED:
        return _ended(run, width)
    if run.stage is Stage.LOST:
        return [
            Text("LINK LOST: the session goes on without the screen, which looks for it", "bold red"),
            *_wrapped(run.trouble, width),
            Text(f"recording: {run.recording}"),
        ]
    if run.silent_s > SILENCE_S:
        return [
            Text(f"NO WORD FROM THE SESSION for {run.silent_s:.0f} s: all below is old", "bold red"),
            Text(f"recording: {run.recording}"),
        ]
    if snapshot is None:
        return [Text(_STAGE_WORDS[run.stage]), Text(f"recording: {run.recording}", "dim")]
    share = f" {snapshot.share:4.0%}"
    head = Text.assemble(
        (snapshot.doing, "bold"),
        f"   {clock(snapshot.remaining_s)} left of {clock(snapshot.elapsed_s + snapshot.remaining_s)}",
    )
    if snapshot.paused:
        paused = "PAUSED" if snapshot.paused == PAUSED else "will pause after this step"
        head.append(f"   {paused}: p goes on", "bold yellow")
    head.append(f"   {run.script}")
    return [head, Text.assemble((bar(snapshot.share, width - len(share)), "green"), share)]


def _ended(run: LiveRun, width: int) -> list[Text]:
    head, reason = "NO RESULT", run.trouble
    if run.result is not None:
        head, reason = run.outcome, str(run.result.get("reason", ""))
    lines = _wrapped(f"{head}  {reason}", width)
    lines[0].stylize(OUTCOME_STYLES.get(head, "bold red"), 0, len(head))
    return [*lines, Text(f"recording: {run.recording}{'   (F4: result)' if run.hello else ''}")]


def _wrapped(text: str, width: int) -> list[Text]:
    return [Text(line) for line in textwrap.wrap(text, max(width, 1), max_lines=_REASON_ROWS, placeholder=" ...")]


def axis_lines(snapshot: Snapshot, run: LiveRun) -> list[Text]:
    """Return the axes, a line each below a heading; of a run that has gone the last that is known of them."""
    old = run.stage is not Stage.RUNNING or run.silent_s > SILENCE_S
    moves = 0.0 if run.at_rest else _DEG  # the last figures may be from before it came to rest
    rows = [["axis", "angle deg", "rate deg/s", "setpoint deg/s", "last state" if old else "state"]]
    rows += [
        [
            axis.name,
            number(axis.angle_rad * _DEG, 3),
            number(axis.rate_rps * moves, 3),
            number(axis.setpoint_rps * moves, 3),
            "at rest" if run.at_rest and axis.state == "turning" else axis.state,
        ]
        for axis in sorted(snapshot.axes, key=lambda axis: axis.name)
    ]
    cells = columns([[row[0], *(cell.rjust(14) for cell in row[1:4])] for row in rows])
    return headed([f"{line}   {row[4]}" for line, row in zip(cells, rows, strict=True)])


def source_lines(snapshot: Snapshot) -> list[Text]:
    """Return the sources, a line each below a heading, what is wrong in red; then the counts of the links."""
    rows = [["source", "Hz", "samples", "lost", "late", "corrupt", "latency ms", "jitter ms", "degC", "link"]]
    rows += [
        [
            source.name,
            number(source.rate_hz, 1).rjust(7),
            str(source.samples).rjust(8),
            str(source.lost),
            str(source.late),
            str(source.corrupt),
            number(source.latency_s * 1e3, 2),
            number(source.jitter_s * 1e3, 2),
            number(source.temperature_c, 1),
            _link_words(source).rjust(9),
        ]
        for source in snapshot.sources
    ]
    lines = headed(columns(rows, gap=" "))
    for line, source in zip(lines[1:], snapshot.sources, strict=True):
        if _link_words(source) != "ok":
            line.stylize("bold red")
    return [*lines, *(Text(said, "dim") for said in snapshot.links)]


def _link_words(source: SourceSnapshot) -> str:
    return "losses" if source.link == "ok" and (source.lost or source.corrupt) else source.link


def source_summary(snapshot: Snapshot) -> list[Text]:
    """Return in a line how sources and filter are; sources that are not ok have lines of their own."""
    sources, lines = snapshot.sources, source_lines(snapshot)
    bad = [line for line, source in zip(lines[1:], sources, strict=True) if _link_words(source) != "ok"]
    rate_hz = max((source.rate_hz for source in sources if math.isfinite(source.rate_hz)), default=math.nan)
    words = f"{len(sources)} source{'s' * (len(sources) != 1)} at {number(rate_hz, 0)} Hz, "
    words += f"{sum(source.lost for source in sources)} lost   NIS {number(snapshot.nis_recent, 2)}  "
    return [*([lines[0], *bad] if bad else []), Text.assemble(words, _judgement(snapshot))]


def innovation_lines(snapshot: Snapshot) -> list[Text]:
    """Return how the innovations of the live filter look, and what that means."""
    figures = Text(
        f"NIS {number(snapshot.nis_mean, 3)} over the run, {number(snapshot.nis_recent, 3)} of the last 30 s;"
        f"  lag-one correlation {number(snapshot.whiteness, 3, signed=True)}"
    )
    return [Text("innovations", "bold"), figures, _judgement(snapshot)]


def _judgement(snapshot: Snapshot) -> Text:
    if not (math.isfinite(snapshot.nis_recent) and math.isfinite(snapshot.whiteness)):  # too few blocks for either
        return Text("not known yet", "dim")
    by_chance = _MANY_SIGMAS / math.sqrt(max(snapshot.recent, 1))
    if abs(snapshot.nis_recent - 1) > max(_NIS_OFF, math.sqrt(2) * by_chance):
        return Text("NIS OFF 1: the noise or the model is not what was assumed", "bold red")
    if abs(snapshot.whiteness) > max(_WHITE_OFF, by_chance):
        return Text("NOT WHITE: something is not in the model", "bold red")
    return Text("good: near 1, and white", "green")


def _event_lines(run: LiveRun, width: int) -> list[Text]:
    lines: list[Text] = []
    for t_s, text in list(run.events)[-_MOST_EVENTS:]:
        at = f"{t_s:8.1f} s  "
        first, *more = textwrap.wrap(text, width - len(at)) or [""]
        lines += [Text.assemble((at, "dim"), first), *(Text(" " * len(at) + line) for line in more)]
    return [Text("events", "bold"), *lines]
