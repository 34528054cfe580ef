"""Numbers with units as people write them, "20 deg/s", and back."""

import math

from drivers.packaged import packaged_toml
from drivers.units import split_quantity, unit_size

_KINDS = packaged_toml("station.schema", "quantities.toml")
UNITS = {kind: tuple(units) for kind, units in _KINDS.items()}
"""Units that files may have, by what they measure."""
_SIZES = {kind: units for kind, units in _KINDS.items() if isinstance(units, dict)}


class QuantityError(ValueError):
    """A text that is not a quantity of the kind wanted; the message says what would be."""


def parse(text: object, kind: str) -> float:
    """Return the SI value of a text such as "0.1 deg/s" of this kind, such as "rate".

    QuantityError for what is no text with a number, a wrong or missing unit, or a value that is not finite.
    """
    units = UNITS[kind]
    example = f'"20 {units[0 if kind == "ratio" else min(1, len(units) - 1)]}"'
    known = ", ".join(units)
    if not isinstance(text, str):
        raise QuantityError(f"{text!r} has no unit. Write a text with one of {known}, for instance {example}")
    if (found := split_quantity(text)) is None:
        raise QuantityError(f"{text!r} is not a number with a unit. Write for instance {example}")
    number, unit = found
    if unit not in units:
        problem = f"unit {unit!r} does not measure {kind}" if unit else "a unit is missing"
        raise QuantityError(f"{text!r}: {problem}; use one of {known}")
    value = number * (_SIZES[kind][unit] if kind in _SIZES else unit_size(unit)[0])
    if not math.isfinite(value):
        raise QuantityError(f"{text!r} is too large a number")
    return value
