"""Columns of an external file, their units and their axes, as stated by a mapping file."""

from dataclasses import dataclass

from estimator.packaged import packaged_toml
from estimator.strict_toml import StrictTable
from estimator.types import Floats

UNITS: dict[str, dict[str, float]] = packaged_toml("estimator.importing.mapping", "units.toml")
"""What a column can be, and the size in SI of the units it may have."""
_SHIFT = {"K": -273.15}
KEYS = packaged_toml("estimator.importing.mapping", "keys.toml")
"""Plain keys by table, as ``StrictTable.stated`` takes them."""

Vector = tuple[float, float, float]


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class Columns:
    """Columns of a text file, or variables of a .mat file; SI is (value - ``offset``) * ``scale`` + ``shift``.

    ``names`` stand for ``width`` columns. Row i of ``axes`` (width, c), if any, is the direction of column i.
    """

    names: tuple[str, ...]
    scale: float = 1.0
    shift: float = 0.0
    raw: bool = False
    offset: float = 0.0
    width: int = 1
    axes: Floats | None = None


def stated_columns(section: StrictTable, quantity: str, key: str = "columns", *, count_needed: bool = True) -> Columns:
    """Return the columns that a table names under ``key``, with their conversion to SI.

    The conversion is a unit of ``quantity``, or the size of a count; unless ``count_needed``, a count without a size is
    one ``count_unit``, by default one degree per second. ``offset`` in the table is the value for zero, in the unit of
    the column. The width is 1 for the key "column", else 3, however many names there are. The section's error for a
    unit or count that is missing or wrong.
    """
    units, names, offset = UNITS[quantity], section.strings(key), section.number("offset", 0.0)
    unit = section.string("unit", one_of=(*units, "raw"))
    raw, size = unit == "raw", 1.0
    if raw and not count_needed and not section.has("count"):
        unit = section.string("count_unit", "deg/s", one_of=tuple(units))
    elif raw:
        unit, size = section.string("count_unit", one_of=tuple(units)), section.number("count", positive=True)
    return Columns(
        names=names,
        scale=size * units[unit],
        shift=_SHIFT.get(unit, 0.0),
        raw=raw,
        offset=offset,
        width=1 if key == "column" else 3,
    )


def signed_axis(text: str) -> Vector:
    """Return the unit vector of x, y or z, in either case, with + or - before it or no sign; ValueError for anything
    else.
    """
    letter = text.strip().lower()
    sign = -1.0 if letter.startswith("-") else 1.0
    letter = letter.lstrip("+-")
    if letter not in ("x", "y", "z"):
        raise ValueError(f"{text!r} is not an axis. Write x, y or z, with a sign if needed")
    return sign * (letter == "x") + 0.0, sign * (letter == "y") + 0.0, sign * (letter == "z") + 0.0


def direction(value: object) -> Vector:
    """Return a direction in body axes, x, y or z with a sign, or three numbers; ValueError for anything else."""
    if isinstance(value, str):
        return signed_axis(value)
    if not (isinstance(value, list) and len(value) == 3 and all(isinstance(v, (int, float)) for v in value)):
        raise ValueError(f"holds {value!r}: write x, y or z with a sign, or three numbers")
    return float(value[0]), float(value[1]), float(value[2])
