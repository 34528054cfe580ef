"""Numbers of plans."""

import math

_MOST_DECIMALS = 9


def three_digits(value: float) -> str:
    """Return three digits without an exponent."""
    if value == 0 or not math.isfinite(value):
        return f"{value:g}"
    digits = max(2 - math.floor(math.log10(abs(value))), 0)
    return f"{value:.{min(digits, _MOST_DECIMALS)}f}"
