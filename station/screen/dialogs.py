"""Questions over a screen."""

from collections.abc import Sequence

from textual.app import ComposeResult
from textual.containers import Horizontal, Vertical
from textual.widgets import Button, OptionList, Static
from textual.widgets.option_list import Option

from station.screen.bars import StopBar
from station.screen.base import StationDialog


class AskDialog(StationDialog):
    """A question with a few answers as buttons; the first is the careful one."""

    def __init__(self, question: str, answers: Sequence[tuple[str, str]]) -> None:
        """``answers``: what comes back, and the words on the button."""
        super().__init__()
        self._question, self._answers = question, answers

    def compose(self) -> ComposeResult:
        """Yield question and buttons."""
        with Vertical(id="dialog"):
            yield Static(self._question, markup=False)
            with Horizontal(classes="buttons"):
                for key, words in self._answers:
                    yield Button(words, id=key, compact=True)
        yield StopBar()

    def on_button_pressed(self, event: Button.Pressed) -> None:
        """Hand the answer over."""
        self.dismiss(event.button.id)


class ChooseDialog(StationDialog):
    """A list to choose one line from."""

    def __init__(self, question: str, choices: Sequence[tuple[str, str]]) -> None:
        """``choices``: what comes back, and the line."""
        super().__init__()
        self._question, self._choices = question, choices

    def compose(self) -> ComposeResult:
        """Yield question and list."""
        with Vertical(id="dialog"):
            yield Static(self._question, markup=False)
            yield OptionList(*(Option(words, id=key) for key, words in self._choices), markup=False)
        yield StopBar()

    def on_option_list_option_selected(self, event: OptionList.OptionSelected) -> None:
        """Hand the choice over."""
        self.dismiss(event.option.id)
