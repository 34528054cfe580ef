"""Parts of every screen: the row of screens on top, STOP at the bottom, and the layout for small terminals."""

import math
from typing import cast

from rich.text import Text
from textual import events
from textual.app import RenderResult
from textual.widget import Widget
from textual.widgets import Static

from station.errors import sentence
from station.screen.app_protocol import SeenApp
from station.screen.panes.stop import StopColour, stop_view
from station.screen.sessions.live_run import LiveRun
from station.views.figures import OUTCOME_STYLES, clock_between, number

STOP_KEY = "f9"
_NAMES = {"F2": "Prepare", "F3": "Run", "F4": "Result", "F5": "History", "F10": "Tray"}
SCREENS = tuple((name.lower(), key, name) for key, name in _NAMES.items())


class Lines(Static):
    """Text of a fixed height; updates cost no layout, and nothing if the text is the same."""

    def __init__(self, *, id: str | None = None, classes: str | None = None) -> None:
        """Begin empty; text is shown literally, including brackets."""
        super().__init__("", id=id, classes=classes, markup=False)
        self._shown: object = ""
        self._height = 0

    def show(self, text: object, lines: int) -> None:
        """Show a text (str or rich Text) of ``lines`` lines; nothing is done if it is shown already.

        The layout is computed anew only if the number of lines has changed.
        """
        if text == self._shown:
            return
        self._shown = text
        grown = lines != self._height
        self._height = lines
        self.update(text, layout=grown)  # type: ignore[arg-type]


class TopBar(Static):
    """The names of the screens, the present one marked; a click changes to another."""

    def __init__(self, mode: str) -> None:
        """List all screens with their keys, that of ``mode`` highlighted, the others as links, and the key to quit."""
        names = [
            f"[bold reverse] {key} {name} [/]"
            if mode == screen_name
            else f"[@click=app.switch_mode('{screen_name}')] {key} {name} [/]"
            for screen_name, key, name in SCREENS
        ]
        super().__init__(" ".join(names) + "   [dim]Ctrl+Q quits[/]", id="top")


class StopBar(Widget):
    """STOP with its key, and the state of the run; red while a table may move. The whole bar is the button."""

    def __init__(self) -> None:
        super().__init__(id="stop-bar")
        self._text = ""

    def on_mount(self) -> None:
        """Show the run at once, not at the next tick."""
        cast(SeenApp, self.app).show_stop()

    def show(self, run: LiveRun | None, other_sessions: int, recording_line: str = "") -> None:
        """Show the state of a run; without one the number of ``other_sessions``; if that is 0, ``recording_line``.

        That is a text about a recording; if it is empty too, say that no session is running.
        """
        view = stop_view(run, other_sessions, recording_line)
        if view.text != self._text:
            self._text = view.text
            for colour in filter(None, StopColour):
                self.set_class(colour is view.colour, f"-{colour}")
            self.refresh()

    def render(self) -> RenderResult:
        """Return the text, cut to the bar."""
        return self._text.replace("[", r"\[")

    def on_mouse_down(self, event: events.MouseDown) -> None:
        """Stop as soon as the button goes down."""
        event.stop()
        cast(SeenApp, self.app).action_stop()


class Small(Lines):
    """The run in a few lines, shown instead of the rest on a telephone or small terminal: verdict, step, time left."""

    def __init__(self, least: tuple[int, int]) -> None:
        """``least`` are the columns and rows that the screens need."""
        super().__init__(id="small")
        self._needs = sentence("screen.too_small", width=least[0], height=least[1])

    def show_run(self, run: LiveRun | None, other_sessions: int, recording_line: str) -> None:
        """Show a run, or without one the text ``recording_line`` on the chosen recording, else how many others run."""
        without = recording_line or (f"sessions not shown: {other_sessions}" if other_sessions else "no session runs")
        lines = Text("\n").join([*_lines(run, without), Text(), Text(self._needs, style="dim")])
        self.show(lines, len(lines.split()))


def _lines(run: LiveRun | None, without: str) -> list[Text]:
    """Return four lines about a run: what it does; time left and share done; NIS and lost samples; angles in deg.

    It is one line otherwise: outcome and reason, once there is an outcome; "starting" before the first snapshot;
    ``without`` a run that text.
    """
    if run is None:
        return [Text(without, style="bold")]
    if run.outcome:
        reason = run.result.reason if run.result is not None else ""
        style = OUTCOME_STYLES.get(run.outcome, "")
        return [Text.assemble((run.outcome, f"bold {style}"), f"  {reason}")]
    snapshot = run.snapshot
    if snapshot is None:
        return [Text("starting", style="bold")]
    left = f"{clock_between(snapshot.remaining_s, snapshot.longer_s)} left, {snapshot.share:.0%} done"
    turning = [f"{axis.name} at {number(math.degrees(axis.angle_rad), 1)} deg" for axis in snapshot.axes]
    return [
        Text(snapshot.doing, style="bold"),
        Text(left),
        Text(f"NIS {number(snapshot.nis_recent, 2)} (near 1 is good), {snapshot.lost} samples lost"),
        Text(", ".join(turning)),
    ]
