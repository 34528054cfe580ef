"""Questions over a screen."""

from collections.abc import Mapping, Sequence
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

_NAMES_OF_KEYS = {"LEFT": "←", "RIGHT": "→", "CTRL+Q": "Ctrl+Q", "CTRL+C": "Ctrl+C", "CTRL+P": "Ctrl+P", "TAB": "Tab"}


class StationDialog(ModalScreen[str | None]):
    """A question over a screen, with STOP below as everywhere.

    ``answers`` are (result, words); ``begun`` is the answer or text at the start.
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
        """Yield the widgets for possible answers."""
        yield from ()


class HelpDialog(StationDialog):
    """All keys that have an effect on a screen, in groups; STOP comes first."""

    def __init__(self, groups: Mapping[str, Sequence[Binding]]) -> None:
        """``groups``: title of each group and its keys, from the tables of keys."""
        super().__init__("")
        self._question = "\n\n".join(_group(title, keys) for title, keys in groups.items() if keys)


def _group(title: str, keys: Sequence[Binding]) -> str:
    """Return ``title`` and below it the keys, two entries a line; keys with the same description are one entry."""
    shown: dict[str, list[str]] = {}
    for binding in keys:
        name = binding.key_display or (binding.key.upper() if len(binding.key) > 1 else binding.key)
        shown.setdefault(binding.description, []).append(_NAMES_OF_KEYS.get(name, name))
    entries = [f"{', '.join(names):9} {words:25}" for words, names in shown.items()]
    rows = zip_longest(entries[::2], entries[1::2], fillvalue="")
    return "\n".join([title, *(f"  {left} {right}".rstrip() for left, right in rows)])


class AskDialog(StationDialog):
    """A question with a few answers as buttons; the first is the cautious one."""

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
