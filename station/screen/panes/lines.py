"""Lines of rich text, of which the panes of the screens are made."""

import math
from collections.abc import Iterable, Sequence
from enum import StrEnum
from typing import TypeAlias

from rich.text import Text

Part: TypeAlias = str | tuple[str, str]
"""A text, or a text and its style."""
TITLE = "bold underline"
"""Style of the first line of a block."""


class Mark(StrEnum):
    """The word at the beginning of a line that says what the line means for a start."""

    OK = "OK"
    NOTE = "NOTE"
    WAIT = "WAIT"
    WRONG = "WRONG"


MARK_STYLES = {Mark.OK: "bold green", Mark.NOTE: "bold yellow", Mark.WAIT: "bold yellow", Mark.WRONG: "bold red"}
_MARK_WIDTH = 6


def line(*parts: Part) -> Text:
    """Return a line of texts, of which some have a style."""
    return Text.assemble(*parts)


def marked(mark: Mark, *parts: Part) -> Text:
    """Return a line that begins with a mark, in a column of its own."""
    return line((mark.ljust(_MARK_WIDTH), MARK_STYLES[mark]), *parts)


def joined(lines: Iterable[Text]) -> Text:
    """Return lines as one text."""
    return Text("\n").join(lines)


def padded(rows: Sequence[Sequence[str]]) -> list[list[str]]:
    """Return rows of cells as wide as their columns: the first left-aligned, the others right-aligned.

    There must be one row or more, all of the same length.
    """
    first, *others = (max(map(len, column)) for column in zip(*rows, strict=True))
    return [[row[0].ljust(first), *map(str.rjust, row[1:], others)] for row in rows]


def bar(share: float, width: int) -> str:
    """Return a progress bar, an eighth of a character fine."""
    eighths = round(min(max(share if math.isfinite(share) else 0.0, 0.0), 1.0) * width * 8)
    whole, part = divmod(eighths, 8)
    return ("█" * whole + (" ▏▎▍▌▋▊▉"[part] if part else "")).ljust(width, "·")
