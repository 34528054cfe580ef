"""Stamps as texts: dates and times as people and loggers write them, and how to read them."""

from collections.abc import Sequence
from datetime import UTC, datetime

import numpy as np

from estimator.types import Floats

ISO = "iso"
"""Stands for a date with its time as ISO 8601 writes it; any other text is a pattern of strptime."""
_DAY_S = 86400.0
_OF_A_DATE = ("%d", "%j", "%D", "%x", "%c")
_DATES = ("%Y-%m-%d", "%Y/%m/%d", "%m/%d/%Y", "%d/%m/%Y", "%d.%m.%Y", "%d-%b-%Y", "%d %b %Y", "%m/%d/%y", "%d/%m/%y")
_TIMES = ("%H:%M:%S.%f", "%H:%M:%S", "%I:%M:%S.%f %p", "%I:%M:%S %p", "%H:%M:%S,%f", "%H:%M", "%I:%M %p")
_BETWEEN = (" ", "T", ", ", "_")
PATTERNS = (*(f"{date}{between}{time}" for date in _DATES for between in _BETWEEN for time in _TIMES), *_TIMES)
"""Patterns that are tried, dates with times first."""


def seconds_of(text: str, pattern: str) -> float:
    """Return the seconds since 1970 of a stamp, by a ``pattern`` of strptime or ``ISO``; ValueError if it does not fit.

    Without a zone it is in UTC; without a date the seconds are those since midnight.
    """
    if pattern == ISO:
        at = datetime.fromisoformat(text)
    elif has_date(pattern):
        at = datetime.strptime(text, pattern)
    else:
        at = datetime.strptime(f"1970 {text}", f"%Y {pattern}")
    return (at if at.tzinfo else at.replace(tzinfo=UTC)).timestamp()


def has_date(pattern: str) -> bool:
    """Return whether stamps of a pattern include the day."""
    return pattern == ISO or any(part in pattern for part in _OF_A_DATE)


def over_midnight(stamps_s: Floats) -> Floats:
    """Return stamps (n,) of a clock that begins anew each day as they would go on."""
    return np.asarray(np.unwrap(stamps_s, period=_DAY_S))


def pattern_of(texts: Sequence[str]) -> str | None:
    """Return ``ISO`` or the first of ``PATTERNS`` that reads all texts; None if there is none, ``ISO`` for no texts."""
    for pattern in (ISO, *PATTERNS):
        try:
            for text in texts:
                seconds_of(text, pattern)
        except ValueError:
            continue
        return pattern
    return None
