"""Columns of one external file by name, in any format, and the columns wanted of it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.errors import RecordingError
from estimator.importing.mapping.columns import Columns
from estimator.types import Floats

HUGE = 1e25
"""No measured number is larger, nor smaller than one in it, if its bytes are read as they were written."""


def no_column(name: str, missing: Sequence[str], where: str, present: Sequence[str], hint: str = "") -> RecordingError:
    """Return the error of a file that lacks columns that the mapping names."""
    return RecordingError(
        f"{name} has no column {', '.join(missing)}: {where} has {', '.join(present)[:400]}; correct the mapping "
        f"(names, delimiter) or give the matching file{hint}"
    )


@dataclass(frozen=True, slots=True)
class Wanted:
    """Names of columns: ``needed`` in every row, ``may_be_blank`` (NaN then), and ``labels`` (text).

    With ``calendar`` the needed ones are dates or times in that pattern (``stamps``), converted to seconds.
    """

    needed: tuple[str, ...]
    may_be_blank: tuple[str, ...]
    labels: tuple[str, ...] = ()
    calendar: str = ""

    @property
    def numeric(self) -> tuple[str, ...]:
        return (*self.needed, *self.may_be_blank)

    @property
    def all(self) -> tuple[str, ...]:
        return (*self.numeric, *self.labels)


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class Table:
    """Columns, each (rows,) or (rows, width), labels by row, and the number of unreadable lines.

    ``position`` (rows,) numbers the rows of a text file, broken ones included, ``first_skipped`` is the first of these,
    ``units`` has the row of units by column, ``notes`` further remarks.
    """

    name: str
    columns: Mapping[str, NDArray[Any]]
    labels: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    skipped_lines: int = 0
    first_skipped: str = ""
    position: NDArray[np.int64] | None = None
    units: Mapping[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def values(self, wanted: Columns, quantity: str) -> Floats:
        """Return the values (rows, c) of wanted columns in SI along their axes, NaN if absurdly large.

        ``quantity`` names them in the error: RecordingError if the width is wrong or columns differ in length.
        """
        parts = [np.atleast_2d(self.columns[name].T).T for name in wanted.names]
        found = sum(part.shape[1] for part in parts)
        if found != wanted.width or len({len(part) for part in parts}) != 1:
            shapes = ", ".join(f"{n} {self.columns[n].shape}" for n in wanted.names)
            raise RecordingError(
                f"{self.name}: {quantity} needs {wanted.width} columns of one length, there are {shapes}"
            )
        with np.errstate(invalid="ignore", over="ignore"):
            values = (np.hstack(parts).astype(np.float64) - wanted.offset) * wanted.scale + wanted.shift
            values = np.where(np.abs(values) < HUGE, values, np.nan)
        return values if wanted.axes is None else values @ wanted.axes

    def number(self, name: str) -> float:
        """Return a variable that holds one number; RecordingError for any other."""
        value = self.columns[name]
        if value.size != 1 or not np.isfinite(value).all():
            raise RecordingError(f"{self.name}: {name} must be one number, it has shape {value.shape}")
        return float(value.reshape(-1)[0])
