"""Lines of words for a person: in a terminal they are broken between words. Loads nothing that takes long."""

import os
import re
import sys
import textwrap
from typing import TextIO

LINE_WIDTH = 80
GLUE = "\ue000"  # a character without a meaning, and no space: no line is broken at it
_WHOLE = re.compile(r"[+-]?\d[\d.]*(?: (?:±|\+-) \d[\d.]*)? (?:%|[a-zA-Z][\w/()]*)|`[^`]{1,60}`")
"""What is not broken: a figure with its uncertainty and its unit, and what is to be typed."""


def glued(text: str) -> str:
    """Return a text without spaces where it must not be broken."""
    return _WHOLE.sub(lambda found: found[0].replace(" ", GLUE), text)


def unglued(text: str) -> str:
    """Return a text with its spaces again."""
    return text.replace(GLUE, " ")


def tell(text: str, stream: TextIO | None = None) -> None:
    """Print a line on ``stream``, by default stdout; in a terminal it is broken between words at 80 columns."""
    stream = stream or sys.stdout
    for line in _broken(text, _width(stream)):
        print(line, file=stream, flush=True)


def _width(stream: TextIO) -> int:
    """Return the columns of a terminal, at most ``LINE_WIDTH``, also if unknown; 0, no limit, for any other stream."""
    if not stream.isatty():
        return 0
    try:
        columns = os.get_terminal_size(stream.fileno()).columns
    except OSError:
        columns = LINE_WIDTH
    return min(columns or LINE_WIDTH, LINE_WIDTH)


def _broken(text: str, width: int) -> list[str]:
    """Return the lines of a text broken at ``width``; figures stay with their units. A width of 0 breaks nothing."""
    if not width:
        return [text]
    lines: list[str] = []
    for paragraph in text.splitlines():
        parts = textwrap.wrap(glued(paragraph), width, break_long_words=False, break_on_hyphens=False)
        lines += map(unglued, parts or [""])
    return lines
