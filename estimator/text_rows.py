"""Rows of numbers of a text log, which may have broken lines, comments, a preamble and a row of units."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.errors import RecordingError
from estimator.mapping import FileFormat

Floats = NDArray[np.float64]

BROKEN_SHARE = 0.1
"""A text file of which more lines than this cannot be read is refused."""
_PREAMBLE_LINES = 200
_COMMENTS = ("#", "%", "//")
_SHOWN = 60  # characters of a broken line in a message


@dataclass(frozen=True, slots=True)
class Wanted:
    """Names of columns: ``needed`` in every row, those that ``may_be_blank`` (NaN there), and ``labels`` (text)."""

    needed: tuple[str, ...]
    may_be_blank: tuple[str, ...]
    labels: tuple[str, ...] = ()

    @property
    def numeric(self) -> tuple[str, ...]:
        return (*self.needed, *self.may_be_blank)

    @property
    def all(self) -> tuple[str, ...]:
        return (*self.numeric, *self.labels)


@dataclass(frozen=True, slots=True, eq=False)
class TextRows:
    """Good rows: numbers (rows, columns), labels by row, and ``position`` (rows,) among good and broken lines.

    ``units`` are the fields of the row of units, empty without one.
    """

    values: Floats
    labels: list[list[str]]
    position: NDArray[np.int64]
    skipped: int
    first_skipped: str
    units: tuple[str, ...]


def read_rows(name: str, text: str, file_format: FileFormat, wanted: Wanted) -> TextRows:
    """Return the rows of a text log.

    Raises RecordingError, naming the file, if it is empty, lacks a column, or is broken in more than 10 % of its
    lines; then with the first of them.
    """
    lines = [(number, line) for number, line in enumerate(re.split(r"\r\n|\n|\r", text), 1) if line.strip("\0 \t")]
    if not lines:
        raise RecordingError(f"{name} is empty")
    start, header = _heading(name, lines, file_format, wanted)
    body = [(number, line) for number, line in lines[start:] if not line.lstrip().startswith(_COMMENTS)]
    if not body:
        raise RecordingError(f"{name} has a heading but no rows")
    where = [header.index(key) for key in wanted.numeric]
    units: tuple[str, ...] = ()
    first = _fields(body[0][1], file_format)
    if not file_format.columns and len(first) == len(header) and not any(_is_number(first[at]) for at in where):
        units = tuple(first[at].strip("[]()") for at in where)
        body = body[1:]
    found = _fast(body, header, where, file_format, wanted) or _careful(body, header, where, file_format, wanted)
    rows = found.skipped + len(found.values)
    if not rows:
        raise RecordingError(f"{name} has a heading but no rows")
    if found.skipped > BROKEN_SHARE * rows:
        raise RecordingError(
            f"{name}: {found.skipped} of {rows} lines are no rows of {len(header)} fields with delimiter "
            f"{file_format.delimiter or 'space'!r} and decimal mark {file_format.decimal!r}, the first is "
            f"{found.first_skipped}: check these two in [file] of the mapping, or repair the file"
        )
    return TextRows(found.values, found.labels, found.position, found.skipped, found.first_skipped, units)


def _heading(name: str, lines: list[tuple[int, str]], file_format: FileFormat, wanted: Wanted) -> tuple[int, list[str]]:
    """Return at which of the lines the rows begin, and the names of the columns."""
    if file_format.columns:
        missing = [key for key in wanted.all if key not in file_format.columns]
        if missing:
            raise RecordingError(f"columns in [file] does not name {', '.join(missing)}, which the mapping uses")
        return 0, list(file_format.columns)
    best, best_at, best_count = [""], 0, -1
    for at, (_, line) in enumerate(lines[:_PREAMBLE_LINES]):
        header = _fields(re.sub(r"^\s*(#|%|//)\s*", "", line), file_format)
        count = sum(key in header for key in wanted.all)
        if count == len(wanted.all):
            return at + 1, header
        if count > best_count:
            best, best_at, best_count = header, at, count
    missing = [key for key in wanted.all if key not in best]
    which = "its first line" if best_at == 0 else f"its line {lines[best_at][0]}"
    hint = "; if it has no heading, name its columns by columns = [...] in [file]" if best_count == 0 else ""
    raise RecordingError(
        f"{name} has no column {', '.join(missing)}: {which} has {', '.join(best)[:400]}; correct the mapping "
        f"(names, delimiter) or give the file it is for{hint}"
    )


def _fields(line: str, file_format: FileFormat) -> list[str]:
    fields = line.split(file_format.delimiter) if file_format.delimiter else line.split()
    return [field.strip().strip("\"'").strip() for field in fields]


def _is_number(field: str) -> bool:
    try:
        float(field.replace(",", "."))
    except ValueError:
        return field == ""
    return True


def _fast(
    body: list[tuple[int, str]], header: list[str], where: list[int], file_format: FileFormat, wanted: Wanted
) -> TextRows | None:
    """Return all rows at once if nothing about them is special, else None."""
    if wanted.labels or file_format.decimal != "." or not file_format.delimiter:
        return None
    separators = len(header) - 1
    if any(line.count(file_format.delimiter) != separators for _, line in body):
        return None
    try:
        values = np.loadtxt(
            [line for _, line in body], delimiter=file_format.delimiter, usecols=where, comments=None, ndmin=2
        )
    except ValueError:
        return None
    return TextRows(values, [], np.arange(len(values)), 0, "", ())


def _careful(
    body: list[tuple[int, str]], header: list[str], where: list[int], file_format: FileFormat, wanted: Wanted
) -> TextRows:
    label_at = [header.index(key) for key in wanted.labels]
    blank_ok = [False] * len(wanted.needed) + [True] * len(wanted.may_be_blank)
    comma = file_format.decimal == ","
    rows: list[list[float]] = []
    texts: list[list[str]] = []
    position: list[int] = []
    skipped, first_skipped, at = 0, "", 0
    for number, line in body:
        fields = _fields(line, file_format)
        row = None
        if len(fields) == len(header) or (len(fields) == len(header) + 1 and not fields[-1]):
            numbers = [fields[i].replace(",", ".") if comma else fields[i] for i in where]
            row = _numbers(numbers, blank_ok)
        if row is None:
            skipped += 1
            first_skipped = first_skipped or f"line {number} ({line.strip()[:_SHOWN]!r})"
            at += fields != header  # a heading that comes again stands for no sample
            continue
        rows.append(row)
        texts.append([fields[i] for i in label_at])
        position.append(at)
        at += 1
    values = np.array(rows).reshape(len(rows), len(where))
    return TextRows(values, texts, np.array(position, dtype=np.int64), skipped, first_skipped, ())


def _numbers(fields: list[str], blank_ok: list[bool]) -> list[float] | None:
    """Return the numbers of a line, NaN where a field is blank that may be; None for a broken line."""
    try:
        return [float(f) if f or not blank else float("nan") for f, blank in zip(fields, blank_ok, strict=True)]
    except ValueError:
        return None
