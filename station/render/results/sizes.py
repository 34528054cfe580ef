"""Sizes of uncertainties as text."""

import math

_MOST_DECIMALS = 9


def two_digits(value: float) -> str:
    """Return a size with two digits that count, without an exponent."""
    if value >= 10 or value == 0 or not math.isfinite(value):
        return f"{value:.0f}"
    return f"{value:.{min(1 - math.floor(math.log10(value)), _MOST_DECIMALS)}f}"
