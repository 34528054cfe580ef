"""Questions over a screen."""

from collections.abc import Iterable, Sequence
from itertools import zip_longest
from typing import ClassVar

from textual.app import ComposeResult
from textual.binding import Binding
from textual.containers import Horizontal, Vertical
from textual.screen import ModalScreen
from textual.widgets import Button, Input, OptionList, Static
from textual.widgets.option_list import Option

from station.screen.bars import StopBar
from station.screen.base import Field

_FRAME = ("scroll", "page", "app.focus", "screen.", "command_palette", "help_quit")
"""Actions of every textual screen, which need no help."""


class StationDialog(ModalScreen[str | None]):
    """A question over a screen, with STOP below it as everywhere.

    ``answers`` are what comes back, and the words for it; ``begun`` is what is chosen or written at first.
    """

    BINDINGS: ClassVar = [("escape", "dismiss(None)", "Back")]

    def __init__(self, question: str, answers: Sequence[tuple[str, str]] = (), begun: str = "") -> None:
        super().__init__()
        self._question, self._answers, self._begun = question, answers, begun

    def compose(self) -> ComposeResult:
        with Vertical(id="dialog"):
            yield Static(self._question, markup=False, id="question")
            yield from self.answers()
        yield StopBar()

    def answers(self) -> ComposeResult:
        """Yield what may be answered."""
        yield from ()


class HelpDialog(StationDialog):
    """All keys that do something on a screen."""

    def __init__(self, bindings: Iterable[Binding]) -> None:
        super().__init__("")
        own = (b for b in bindings if b.description and not b.action.startswith(_FRAME))
        told = [f"{b.key_display or b.key.upper():7} {b.description:26}" for b in own]
        rows = zip_longest(told[::2], [*told[1::2], "CTRL+P  Commands, themes"], fillvalue="")
        self._question = "\n".join(map("".join, rows))


class AskDialog(StationDialog):
    """A question with a few answers as buttons; the first is the careful one."""

    def answers(self) -> ComposeResult:
        with Horizontal(classes="buttons"):
            for key, words in self._answers:
                yield Button(words, id=key, compact=True, action=f"screen.dismiss('{key}')")


class ChooseDialog(StationDialog):
    """A list to choose one line from."""

    def answers(self) -> ComposeResult:
        yield OptionList(*(Option(words, id=key) for key, words in self._answers), markup=False)

    def on_mount(self) -> None:
        self.query_one(OptionList).highlighted = [*dict(self._answers)].index(self._begun) if self._begun else 0

    def on_option_list_option_selected(self, event: OptionList.OptionSelected) -> None:
        self.dismiss(event.option.id)


class AskTextDialog(StationDialog):
    """A question that is answered by a line of text."""

    def answers(self) -> ComposeResult:
        yield Field(value=self._begun, max_length=200)

    def on_input_submitted(self, event: Input.Submitted) -> None:
        self.dismiss(event.value.strip())
