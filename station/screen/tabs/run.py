"""Run: what the table and the gyros do now, how the estimates narrow, whether the filter is right."""

from __future__ import annotations

import math
import textwrap
import time
from typing import ClassVar

from rich.text import Text
from textual.app import ComposeResult
from textual.containers import Container, Vertical

from station.run.snapshot import PAUSED, Snapshot, SourceSnapshot
from station.screen.bars import SILENCE_S, Lines
from station.screen.base import StationScreen
from station.screen.dialogs import AskTextDialog
from station.screen.figures import columns, headed, state_lines
from station.screen.plots import bar, gyro_plots
from station.screen.sessions.live_run import LiveRun, Stage, Trend
from station.views.figures import OUTCOME_STYLES, clock, number

PLOT_PERIOD_S = 1.0
_BLOCKS = ("axes", "sources", "innovations", "estimates", "plots", "events")
_EVENTS = 8
_REASON_ROWS = 4
_NIS_OFF = 0.25
_WHITE_OFF = 0.2
_MANY_SIGMAS = 4.0  # by which both are off before anybody is to look
_DEG = math.degrees(1)
_STAGE_WORDS = {Stage.STARTING: "the session is starting", Stage.RUNNING: "connected, waiting for the first figures"}


class RunScreen(StationScreen):
    """The run, live."""

    MODE = "run"
    WIDE = 146
    BINDINGS: ClassVar = [
        ("p", "pause", "Pause after step / go on"),
        ("n", "note", "Note"),
        ("o", "others", "Other session"),
        ("right", "gyro(1)", "Next gyro"),
        ("left", "gyro(-1)", "Previous gyro"),
    ]

    _drawn_s = -math.inf

    def body(self) -> ComposeResult:
        yield Lines(id="progress")
        with Container(id="columns"):
            with Vertical(id="figures"):
                for name in _BLOCKS[:4]:
                    yield Lines(id=name, classes="block")
            with Vertical(id="pictures"):
                for name in _BLOCKS[4:]:
                    yield Lines(id=name, classes="block")

    def redraw(self) -> None:
        """Draw all at once, the plots too."""
        self._drawn_s = -math.inf
        self.tick()

    on_screen_resume = redraw

    def tick(self) -> None:
        """Show figures at each tick, plots once a second; what has not changed costs nothing."""
        run = self.station.shown
        if run is None:
            others = self.station.others
            said = f"{others} of your sessions run: o shows one." if others else "No session runs."
            self._show("progress", [Text(f"{said} F2 prepares one."), Text("")])
            return
        self._show("progress", _progress(run, self.size.width - 4))
        snapshot = run.snapshot
        if snapshot is None:  # what is there is of the run before
            for name in _BLOCKS:
                self._show(name, [])
            return
        for name, rows in (
            ("axes", axis_lines(snapshot, run)),
            ("sources", source_lines(snapshot)),
            ("innovations", innovation_lines(snapshot)),
            ("estimates", state_lines(snapshot.gyros, nis=True)),
        ):
            self._show(name, rows)
        self._show("events", _event_lines(run))
        now_s = time.monotonic()
        if now_s - self._drawn_s >= PLOT_PERIOD_S:
            self._drawn_s = now_s
            self._show("plots", self._plots(run, snapshot))

    def _show(self, name: str, rows: list[Text]) -> None:
        self.query_one(f"#{name}", Lines).show(Text("\n").join(rows), len(rows))

    def _plots(self, run: LiveRun, snapshot: Snapshot) -> list[Text]:
        if not snapshot.gyros:
            return []
        gyro = snapshot.gyros[self.gyro % len(snapshot.gyros)]
        room = self.query_one("#pictures").size.width or self.size.width
        name = gyro.name if gyro.name == gyro.source else f"{gyro.name} of {gyro.source}"
        return gyro_plots(name, run.trends.get(gyro.name) or Trend(), room)

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


def _event_lines(run: LiveRun) -> list[Text]:
    latest = list(run.events)[-_EVENTS:]
    lines = [Text.assemble((f"{t_s:8.1f} s  ", "dim"), text) for t_s, text in latest]
    return [Text("events", "bold"), *lines, *(Text("") for _ in range(_EVENTS + 1 - len(lines)))]
