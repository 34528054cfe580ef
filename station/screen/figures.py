"""Figures as the screen shows them: in the units of the printed tables, short, a dash for what is not known."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from rich.text import Text

UNKNOWN = "-"
OUTCOME_STYLES = {"PASS": "bold green", "FAIL": "bold red", "ABORTED": "bold yellow", "FAULT": "bold red"}
"""Colours of outcomes; the word always stands there too."""


@dataclass(frozen=True, slots=True)
class StateUnit:
    """How a state is shown: its name, its unit, the factor from SI, digits after the point, room for its digits."""

    name: str
    unit: str
    factor: float
    digits: int
    width: int

    def text(self, value: float, *, signed: bool = False) -> str:
        """Return a value in SI as digits in the unit."""
        return number(value * self.factor, self.digits, signed=signed)


STATES = (
    StateUnit("k", "ppm", 1e6, 0, 6),
    StateUnit("b", "deg/s", math.degrees(1), 5, 8),
    StateUnit("sigma_j", "deg", math.degrees(1), 5, 8),
    StateUnit("sigma_k", "deg", math.degrees(1), 5, 8),
)
"""The four states in order, in the units of the printed calibration."""


def number(value: float | None, digits: int, *, signed: bool = False) -> str:
    """Return a number with so many digits after the point, or a dash."""
    if value is None or not math.isfinite(value):
        return UNKNOWN
    text = f"{value:+.{digits}f}" if signed else f"{value:.{digits}f}"
    return text.lstrip("+-") if float(text) == 0 and not signed else text


def clock(seconds: float) -> str:
    """Return a duration as minutes and seconds."""
    if not math.isfinite(seconds):
        return UNKNOWN
    whole = max(round(seconds), 0)
    return f"{whole // 60}:{whole % 60:02d}"


def columns(rows: Sequence[Sequence[str]], *, left: int = 1, gap: str = "  ") -> list[str]:
    """Return rows of cells as lines: the first ``left`` columns left-aligned, the others right-aligned."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        gap.join(
            cell.ljust(width) if index < left else cell.rjust(width)
            for index, (cell, width) in enumerate(zip(row, widths, strict=True))
        )
        for row in rows
    ]


def state_heads(first: str, beside: str = "±") -> list[list[str]]:
    """Return the two heading rows of a table with a pair of columns for each state."""
    names = [first, *(word for state in STATES for word in (state.name, beside))]
    return [names, ["", *(word for state in STATES for word in (state.unit, ""))]]


def headed(lines: Sequence[str], heads: int = 1) -> list[Text]:
    """Return lines as texts, the first ``heads`` of them as a heading."""
    return [*(Text(line, "bold") for line in lines[:heads]), *map(Text, lines[heads:])]


def titled(title: str, lines: Sequence[Text]) -> Text:
    """Return lines as one text below a title."""
    return Text("\n").join([Text(title, "bold underline"), *lines])
