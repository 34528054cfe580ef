"""Tables of figures as the screen shows them."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from rich.text import Text

from station.render.template import rendered
from station.run.snapshot import GyroSnapshot
from station.views.figures import STATE_FIGURES, number


def columns(rows: Sequence[Sequence[str]], gap: str = "  ") -> list[str]:
    """Return rows of cells as lines: the first column left-aligned, the others right-aligned."""
    first, *others = (max(map(len, column)) for column in zip(*rows, strict=True))
    return [gap.join([row[0].ljust(first), *map(str.rjust, row[1:], others)]) for row in rows]


def state_heads(first: str, beside: str = "±") -> list[list[str]]:
    """Return the two heading rows of a table with a pair of columns for each state."""
    names = [first, *(word for state in STATE_FIGURES for word in (state.name, beside))]
    return [names, ["", *(word for state in STATE_FIGURES for word in (state.unit, ""))]]


def state_lines(gyros: Sequence[GyroSnapshot], *, nis: bool = False) -> list[Text]:
    """Return the states with their sigmas, a line a gyro below a heading; with ``nis`` that of each beside them."""
    rows = state_heads("gyro")
    for gyro in gyros:
        states = zip(STATE_FIGURES, gyro.values, gyro.sds, strict=True)
        cells = [text for s, x, sd in states for text in (s.text(x).rjust(s.width), s.text(sd).rjust(s.width - 1))]
        rows.append([gyro.name, *cells])
    if nis:
        beside = ["NIS", "", *(number(gyro.nis, 2).rjust(4) for gyro in gyros)]
        rows = [[*row, cell] for row, cell in zip(rows, beside, strict=True)]
    return headed(columns(rows, gap=" "), 2)


def headed(lines: Sequence[str], heads: int = 1) -> list[Text]:
    """Return lines as texts, the first ``heads`` of them as a heading."""
    return [*(Text(line, "bold") for line in lines[:heads]), *map(Text, lines[heads:])]


def templated(name: str, values: Mapping[str, Any]) -> Text:
    """Return a text from a template of the screens, whose lines have the markup of rich."""
    return Text.from_markup(rendered("station.screen", name, values).removesuffix("\n"), emoji=False)


def titled(title: str, lines: Sequence[Text]) -> Text:
    """Return lines as one text below a title."""
    return Text("\n").join([Text(title, "bold underline"), *lines])


def bar(share: float, width: int) -> str:
    """Return a progress bar, an eighth of a character fine."""
    eighths = round(min(max(share if math.isfinite(share) else 0.0, 0.0), 1.0) * width * 8)
    whole, part = divmod(eighths, 8)
    return ("█" * whole + (" ▏▎▍▌▋▊▉"[part] if part else "")).ljust(width, "·")
