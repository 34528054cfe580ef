"""Questions over a screen."""

from collections.abc import Sequence

from textual.app import ComposeResult
from textual.containers import Horizontal, Vertical
from textual.widgets import Button, OptionList, Static
from textual.widgets.option_list import Option

from station.screen.bars import StopBar
from station.screen.base import StationDialog


class _Dialog(StationDialog):
    """A question and what may be answered: what comes back, and the words for it."""

    def __init__(self, question: str, answers: Sequence[tuple[str, str]]) -> None:
        super().__init__()
        self._question, self._answers = question, answers

    def compose(self) -> ComposeResult:
        with Vertical(id="dialog"):
            yield Static(self._question, markup=False)
            yield from self.answers()
        yield StopBar()

    def answers(self) -> ComposeResult:
        """Yield what may be answered."""
        yield from ()


class AskDialog(_Dialog):
    """A question with a few answers as buttons; the first is the careful one."""

    def answers(self) -> ComposeResult:
        with Horizontal(classes="buttons"):
            for key, words in self._answers:
                yield Button(words, id=key, compact=True)

    def on_button_pressed(self, event: Button.Pressed) -> None:
        self.dismiss(event.button.id)


class ChooseDialog(_Dialog):
    """A list to choose one line from."""

    def answers(self) -> ComposeResult:
        yield OptionList(*(Option(words, id=key) for key, words in self._answers), markup=False)

    def on_option_list_option_selected(self, event: OptionList.OptionSelected) -> None:
        self.dismiss(event.option.id)
