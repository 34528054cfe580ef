"""Numbers with units as people write them, "20 deg/s", and back."""

import math
import re

_DEG = math.pi / 180

UNITS: dict[str, dict[str, float]] = {
    "angle": {
        "rad": 1.0,
        "mrad": 1e-3,
        "urad": 1e-6,
        "deg": _DEG,
        "arcmin": _DEG / 60,
        "arcsec": _DEG / 3600,
        "turn": 2 * math.pi,
    },
    "rate": {"rad/s": 1.0, "deg/s": _DEG, "deg/h": _DEG / 3600, "rpm": 2 * math.pi / 60},
    "acceleration": {"rad/s2": 1.0, "deg/s2": _DEG},
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "min": 60.0, "h": 3600.0},
    "frequency": {"Hz": 1.0, "kHz": 1e3},
    "ratio": {"1": 1.0, "ppm": 1e-6, "%": 1e-2},
    "angle random walk": {"rad/s/rtHz": 1.0, "deg/s/rtHz": _DEG, "deg/rth": _DEG / 60},
    "rate random walk": {"rad/s/rts": 1.0, "deg/s/rts": _DEG, "deg/h/rth": _DEG / 3600 / 60},
    "temperature": {"degC": 1.0},
}
"""Units by what they measure, each with its factor to SI."""

_NUMBER = re.compile(r"^\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*(\S*)\s*$")


class QuantityError(ValueError):
    """A text that is no such quantity; the message says what would be."""


def parse(text: object, kind: str) -> float:
    """Return the SI value of a text such as "0.1 deg/s"; QuantityError for a wrong or missing unit."""
    units = UNITS[kind]
    example = f'"20 {next(iter(units)) if kind == "ratio" else list(units)[min(1, len(units) - 1)]}"'
    known = ", ".join(units)
    if not isinstance(text, str):
        raise QuantityError(f"{text!r} has no unit: write a text with one of {known}, for instance {example}")
    match = _NUMBER.match(text)
    if match is None:
        raise QuantityError(f"{text!r} is no number with a unit: write for instance {example}")
    number, unit = match.groups()
    if unit not in units:
        what = f"unit {unit!r} does not measure {kind}" if unit else "a unit is missing"
        raise QuantityError(f"{text!r}: {what}; use one of {known}")
    value = float(number) * units[unit]
    if not math.isfinite(value):
        raise QuantityError(f"{text!r} is too large a number")
    return value
