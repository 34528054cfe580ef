"""The frame of the screens: the view for terminals that are too small, the place of STOP, the ticks."""

import select
from pathlib import Path
from typing import Any, ClassVar, TextIO, cast

from textual import events
from textual.app import ComposeResult
from textual.binding import Binding
from textual.containers import VerticalScroll
from textual.screen import Screen
from textual.widgets import Footer, Input

from station.screen.app_protocol import SeenApp
from station.screen.bars import Small, StopBar, TopBar

LEAST_WIDTH, LEAST_HEIGHT = 80, 24
_TALL, _LARGE = 34, (200, 52)


def keys_of(kind: type) -> list[Binding]:
    """Return the keys with a description of a class and its bases in the station; textual's own are left out."""
    tables = [base.__dict__.get("BINDINGS", ()) for base in kind.__mro__ if base.__module__.startswith("station.")]
    found: dict[str, Binding] = {}
    for key in Binding.make_bindings(key for table in tables for key in table):
        found.setdefault(key.key, key)  # base classes come after the classes that override them
    return [key for key in found.values() if key.description]


class StationScreen(Screen[None]):
    """One of the screens: a row of names, its content, keys, STOP."""

    MODE: ClassVar[str] = ""
    WIDE: ClassVar[int] = 120
    AUTO_FOCUS = None
    ALLOW_IN_MAXIMIZED_VIEW = "#small, #start-row, #actions, Footer, StopBar"
    BINDINGS: ClassVar = [("c", "chart", "Chart")]
    gyro = 0
    """Number of the gyro whose pictures are shown, of as many as there are."""
    recording: Path | None = None
    """The recording that is shown, or chosen."""

    def compose(self) -> ComposeResult:
        """Lay out the names of the screens, ``body``, which scrolls, ``row_below``, keys, the small view and STOP."""
        yield TopBar(self.MODE)
        with VerticalScroll(id="body"):
            yield from self.body()
        yield from self.row_below()
        yield Footer(show_command_palette=False)
        yield Small((LEAST_WIDTH, LEAST_HEIGHT))
        yield StopBar()

    def body(self) -> ComposeResult:
        """Yield the widgets between the bars, which scroll."""
        yield from ()

    def row_below(self) -> ComposeResult:
        """Yield the widgets that stay in sight below the body."""
        yield from ()

    def tick(self) -> None:
        """Show changes; called ten times a second while the screen is in sight."""

    def redraw(self) -> None:
        """Draw again what depends on the size of the screen and on the gyro shown."""

    @property
    def recording_line(self) -> str:
        """Text of the bottom bar on the recording that is shown; empty for none."""
        return ""

    def shows(self, recording: Path | None) -> bool:
        """Return whether this screen shows the run of a recording."""
        return self.recording is None or (recording is not None and self.recording.absolute() == recording.absolute())

    def keys(self) -> list[Binding]:
        """Return the keys of this screen that have an effect now.

        Left out are those that ``check_action`` refuses by False, and that of the charts where there are none.
        """
        found = []
        for key in keys_of(type(self)):
            name, _, _ = key.action.partition("(")
            if self.check_action(name, ()) is not False and not (name == "chart" and not self.query("Charts")):
                found.append(key)
        return found

    def chart_keys(self) -> list[Binding]:
        """Return the keys of its charts."""
        kinds = dict.fromkeys(type(chart) for chart in self.query("Charts, Chart"))
        return [key for kind in kinds for key in keys_of(kind)]

    def action_chart(self) -> None:
        """Focus the next chart."""
        self.focus_next("Chart")

    def action_gyro(self, step: int) -> None:
        """Show another gyro."""
        self.gyro += step
        self.redraw()

    @property
    def station(self) -> SeenApp:
        """The app, with its own type."""
        return cast(SeenApp, self.app)

    @property
    def small(self) -> bool:
        """Whether there is too little room for the screen to be shown."""
        return self.size.width < LEAST_WIDTH or self.size.height < LEAST_HEIGHT

    def on_resize(self, event: events.Resize) -> None:
        size = event.size
        self.set_class(self.small, "-small")
        self.set_class(size.width >= self.WIDE, "-wide")
        self.set_class(size.height >= _TALL, "-tall")
        self.set_class(size.width >= _LARGE[0] and size.height >= _LARGE[1], "-large")
        self.call_after_refresh(self.redraw)


class Field(Input):
    """A one-line input field whose cursor does not blink: only news should move on these screens."""

    def __init__(self, **options: Any) -> None:
        """``options`` are those of ``Input``."""
        super().__init__(**{"compact": True, "select_on_focus": False, **options})
        self.cursor_blink = False


def hung_up(stream: TextIO | None) -> bool:
    """Return whether the far end of a stream is gone, or the stream is closed; False without a stream."""
    poll = select.poll()
    try:
        if stream is not None:
            poll.register(stream, 0)  # for events that are always reported: gone, broken, closed
    except (OSError, ValueError):
        return True
    return bool(poll.poll(0))
