"""Tables of figures as the screen shows them."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from rich.text import Text

from station.render.template import rendered
from station.views.figures import clock, three_digits


def columns(rows: Sequence[Sequence[str]], gap: str = "  ") -> list[str]:
    """Return rows of cells as lines: the first column left-aligned, the others right-aligned."""
    return list(map(gap.join, padded(rows)))


def padded(rows: Sequence[Sequence[str]]) -> list[list[str]]:
    """Return the cells of ``columns``, each as wide as its column."""
    first, *others = (max(map(len, column)) for column in zip(*rows, strict=True))
    return [[row[0].ljust(first), *map(str.rjust, row[1:], others)] for row in rows]


def templated(name: str, values: Mapping[str, Any]) -> Text:
    """Return a text from a template of the screens, whose lines have the markup of rich."""
    made = rendered("station.screen", name, {**_FUNCTIONS, **values})
    return Text.from_markup(made.removesuffix("\n"), emoji=False)


def bar(share: float, width: int) -> str:
    """Return a progress bar, an eighth of a character fine."""
    eighths = round(min(max(share if math.isfinite(share) else 0.0, 0.0), 1.0) * width * 8)
    whole, part = divmod(eighths, 8)
    return ("█" * whole + (" ▏▎▍▌▋▊▉"[part] if part else "")).ljust(width, "·")


_FUNCTIONS = {
    "columns": columns,
    "padded": padded,
    "bar": bar,
    "clock": clock,
    "three_digits": three_digits,
    "hypot": math.hypot,
}
