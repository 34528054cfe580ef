"""Numbers with units made of other units: "0.005 deg/s/degC", "200 ppm/(deg/s)2", to SI."""

from drivers.units import split_quantity, unit_size
from sims.physics.hidden.errors import HiddenError


def quantity(text: object, like: str) -> float:
    """Return the SI value of a text whose unit measures the same as ``like``; HiddenError if it does not."""
    if not isinstance(text, str):
        raise HiddenError(f'{text!r} has no unit: write a text, for instance "1 {like}"')
    if (found := split_quantity(text)) is None:
        raise HiddenError(f'{text!r} is no number with a unit: write for instance "1 {like}"')
    number, unit = found
    try:
        factor, powers = unit_size(unit)
    except ValueError:
        missing = "a unit is missing" if not unit else f"there is no unit {unit!r}"
        raise HiddenError(f'{text!r}: {missing}; write for instance "1 {like}"') from None
    if powers != unit_size(like)[1]:
        raise HiddenError(f"{text!r}: unit {unit!r} does not measure the same as {like!r}")
    return number * factor
