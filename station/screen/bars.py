"""What every screen has: the row of screens on top, and STOP at the bottom."""

from __future__ import annotations

from typing import cast

from textual import events
from textual.app import RenderResult
from textual.widget import Widget
from textual.widgets import Static

from station.screen.seen_app import SeenApp
from station.screen.sessions.live_run import LiveRun, Stage
from station.views.figures import clock

STOP_KEY = "f9"
STOP_WORDS = "■ STOP  F9"
_PATIENCE_S = 2.0  # that a session has to be seen to heed STOP
SILENCE_S = 3.0
"""After so long without a word from a session, what is shown of it is old."""
_EMERGENCY = "USE THE EMERGENCY STOP"
_NAMES = {"F2": "Prepare", "F3": "Run", "F4": "Result", "F5": "History", "F10": "Tray"}
SCREENS = tuple((name.lower(), key, name) for key, name in _NAMES.items())


class Lines(Static):
    """Text of a fixed height whose updates cost no layout, and nothing at all if nothing changed."""

    def __init__(self, *, id: str | None = None, classes: str | None = None) -> None:
        """Begin empty; text is shown as it is, brackets too."""
        super().__init__("", id=id, classes=classes, markup=False)
        self._shown: object = ""
        self._height = 0

    def show(self, text: object, lines: int) -> None:
        """Show a text (str or rich Text) of so many lines."""
        if text == self._shown:
            return
        self._shown = text
        grown = lines != self._height
        self._height = lines
        self.update(text, layout=grown)  # type: ignore[arg-type]


class TopBar(Static):
    """The screens by name, the one that is shown marked; a click changes to another."""

    def __init__(self, mode: str) -> None:
        """``mode`` is the screen's own."""
        names = [
            f"[bold reverse] {key} {name} [/]" if mode == its else f"[@click=app.switch_mode('{its}')] {key} {name} [/]"
            for its, key, name in SCREENS
        ]
        super().__init__(" ".join(names) + "   [dim]Ctrl+Q quits[/]", id="top")


class StopBar(Widget):
    """STOP, with its key, and what the run is doing: red while a table may move. The whole bar is the button."""

    def __init__(self) -> None:
        super().__init__(id="stop-bar")
        self._text = ""

    def on_mount(self) -> None:
        """Show the run at once, not at the next tick."""
        app = cast(SeenApp, self.app)
        self.show(app.shown, app.others)

    def show(self, run: LiveRun | None, others: int) -> None:
        """Show a run's state; if none is shown, how many ``others`` there are."""
        text, kind = _stop_words(run) if run is not None else _others_words(others)
        if text != self._text:
            self._text = text
            for each in ("armed", "sent", "rest"):
                self.set_class(each == kind, f"-{each}")
            self.refresh()

    def render(self) -> RenderResult:
        """Return the text, cut to the bar."""
        return self._text.replace("[", r"\[")

    def on_mouse_down(self, event: events.MouseDown) -> None:
        """Stop when the button goes down: nobody waits for it to come up."""
        event.stop()
        cast(SeenApp, self.app).action_stop()


def _others_words(others: int) -> tuple[str, str]:
    if not others:
        return "no session runs", ""
    what = "your session" if others == 1 else f"your {others} sessions"
    return f"{STOP_WORDS}   or Ctrl+C: stops {what}, not shown here (F3 o: show)", "armed"


def _stop_words(run: LiveRun) -> tuple[str, str]:
    if run.stage is Stage.ENDED:
        ended = f"the run has ended: {run.outcome or 'no result'}"
        if run.at_rest:
            return f"{ended}, table at rest", "rest"
        unseen = run.moved or run.unconfirmed
        return (f"{ended}; TABLE NOT SEEN AT REST: {_EMERGENCY}", "armed") if unseen else (ended, "")
    if run.at_rest:
        return f"{'STOP sent, ' if run.stop_asked else ''}table at rest", "rest"
    if run.unconfirmed:
        return f"{STOP_WORDS}   THE TABLE DID NOT CONFIRM IT: {_EMERGENCY}", "armed"
    if run.stop_asked:
        return _asked_words(run)
    if run.stage is Stage.LOST:
        return f"{STOP_WORDS}   link to the session lost: {run.trouble}", "armed"
    if run.silent_s > SILENCE_S:
        return f"{STOP_WORDS}   no word from the session for {run.silent_s:.0f} s", "armed"
    snapshot = run.snapshot
    doing = "starting" if snapshot is None else f"{snapshot.phase}, {clock(snapshot.remaining_s)} left"
    return f"{STOP_WORDS}   or Ctrl+C, or press here   {doing}", "armed"


def _asked_words(run: LiveRun) -> tuple[str, str]:
    """Return how far a STOP has come that was pressed: sent is not heard, and heard is not at rest."""
    if run.stop_heard:
        return f"{STOP_WORDS}   heard; the table is coming to rest", "sent"
    if run.stop_age_s < _PATIENCE_S:
        return f"{STOP_WORDS}   sent; waiting for the session to heed it", "sent"
    return f"{STOP_WORDS}   sent {run.stop_age_s:.0f} s ago, NOT HEEDED: {_EMERGENCY}", "armed"
