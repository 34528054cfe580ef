"""Checks of answers, made by the readers of the bench file themselves."""

import re
from collections.abc import Callable

from station.errors import BenchError, UsageError
from station.schema.quantities import QuantityError, parse
from station.schema.tables import Table

_WHERE = re.compile(r"^bench(, line \d+)?: (\S+: )?")


def read_section(text: str, read: Callable[[Table], object]) -> None:
    """Read a part of a bench file; UsageError with what is wrong, without the line, which nobody has seen."""
    try:
        read(Table.parse(text, "bench", BenchError))
    except BenchError as error:
        raise UsageError(_WHERE.sub("", str(error))) from None


def quantity_of(kind: str, *, optional: bool = False) -> Callable[[str], object]:
    """Return the check for a quantity of one kind, or for nothing if it is optional; it raises UsageError."""

    def check(text: str) -> object:
        try:
            return text if optional and not text else parse(text, kind)
        except QuantityError as error:
            raise UsageError(str(error)) from None

    return check


def whole_number(low: int, high: int) -> Callable[[str], object]:
    """Return the check for a whole number; it raises UsageError."""

    def check(text: str) -> object:
        if not (text.isascii() and text.isdecimal() and low <= int(text) <= high):
            raise UsageError(f"give a whole number from {low} to {high}")
        return int(text)

    return check
