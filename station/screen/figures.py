"""Tables of figures as the screen shows them."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from rich.text import Text

from station.render.template import rendered
from station.views.figures import clock, clock_between, three_digits


def padded(rows: Sequence[Sequence[str]]) -> list[list[str]]:
    """Return rows of cells as wide as their columns: the first left-aligned, the others right-aligned."""
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


_FUNCTIONS = {each.__name__: each for each in (padded, bar, clock, clock_between, three_digits, math.hypot)}
