"""Tables of a report as values: the templates lay them out."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import date
from typing import TypeAlias

Content: TypeAlias = str | date | None
"""What stands in a cell: text, of which only markupsafe.Markup is taken for HTML, a day, or nothing."""
_LONG_ROWS = 16
_WIDE_COLUMNS = 10


@dataclass(kw_only=True, frozen=True, slots=True)
class Cell:
    """A cell, or the head of a column; numbers stand on the right."""

    content: Content
    is_number: bool


@dataclass(kw_only=True, frozen=True, slots=True)
class Row:
    """A row: what names it, and its other cells."""

    name: Content
    cells: tuple[Cell, ...]


@dataclass(kw_only=True, frozen=True, slots=True)
class Group:
    """Rows under a common name."""

    name: str
    rows: tuple[Row, ...]


@dataclass(kw_only=True, frozen=True, slots=True)
class Table:
    """A table of rows, or of groups of rows.

    A long one may be broken between rows, or between its groups; a wide one is set in small type.
    """

    heads: tuple[Cell, ...]
    rows: tuple[Row, ...] = ()
    groups: tuple[Group, ...] = ()
    is_long: bool
    is_wide: bool


def table_of(
    heads: Sequence[Content], align: str, rows: Iterable[Sequence[Content]], *, length: int | None = None
) -> Table:
    """Return a table of rows, the first cell of which is the name of the row; ``align`` has "l" or "r" for each column.

    It is long with more than 16 rows, and wide with more than ten columns. ``length`` is the number of rows that counts
    for the former, by default that of its rows.
    """
    laid_out = tuple(_row(cells, align) for cells in rows)
    return Table(
        heads=_cells(heads, align),
        rows=laid_out,
        is_long=(len(laid_out) if length is None else length) > _LONG_ROWS,
        is_wide=len(heads) > _WIDE_COLUMNS,
    )


def grouped_table(
    heads: Sequence[Content], align: str, groups: Iterable[tuple[str, Iterable[Sequence[Content]]]]
) -> Table:
    """Return a table of groups (name, rows), whose names stand in the first column; ``align`` as in ``table_of``.

    Rows have no cell for the first column. The number of all rows together decides whether the table is long.
    """
    laid_out = tuple(Group(name=name, rows=tuple(_row(cells, align[1:]) for cells in rows)) for name, rows in groups)
    return Table(
        heads=_cells(heads, align),
        groups=laid_out,
        is_long=sum(len(group.rows) for group in laid_out) > _LONG_ROWS,
        is_wide=len(heads) > _WIDE_COLUMNS,
    )


def _row(cells: Sequence[Content], align: str) -> Row:
    name, *others = cells
    return Row(name=name, cells=_cells(others, align[1:]))


def _cells(contents: Sequence[Content], align: str) -> tuple[Cell, ...]:
    """Return contents as cells; ``align`` may be longer."""
    return tuple(Cell(content=content, is_number=side == "r") for content, side in zip(contents, align, strict=False))


@dataclass(kw_only=True, frozen=True, slots=True)
class Fact:
    """A line of a list of facts."""

    name: str
    content: Content


def facts_of(pairs: Iterable[tuple[str, Content]]) -> tuple[Fact, ...]:
    """Return names and what they are as facts; pairs without content are left out."""
    return tuple(Fact(name=name, content=content) for name, content in pairs if content not in (None, ""))
