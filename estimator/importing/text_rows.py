"""Rows of numbers of a text log, which may have broken lines, comments, a preamble and a row of units."""

from __future__ import annotations

import re
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime

import numpy as np
from numpy.typing import NDArray

from estimator.errors import RecordingError
from estimator.importing.mapping.mapping import FileFormat
from estimator.types import Floats

Lines = list[tuple[int, str]]

BROKEN_SHARE = 0.1
"""A text file of which more lines than this cannot be read is refused."""
_PREAMBLE_LINES = 200
_COMMENTS = ("#", "%", "//")
_DELIMITERS = {",": ",", ";": ";", "tab": "\t", "space": ""}
_BLANKS = frozenset(("", "-", "na", "n/a", "null", "none"))
_SHOWN = 60  # characters of a broken line in a message


@dataclass(frozen=True, slots=True)
class Wanted:
    """Names of columns: ``needed`` in every row, those that ``may_be_blank`` (NaN there), and ``labels`` (text).

    With ``calendar`` the needed ones are dates with times (ISO 8601), which become seconds since 1970.
    """

    needed: tuple[str, ...]
    may_be_blank: tuple[str, ...]
    labels: tuple[str, ...] = ()
    calendar: bool = False

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
    needed, blank, labels = (tuple(map(_bare, names)) for names in (wanted.needed, wanted.may_be_blank, wanted.labels))
    wanted = Wanted(needed, blank, labels, wanted.calendar)
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
            f"{found.first_skipped}: {_rows_hint(body[:_PREAMBLE_LINES], header, where, file_format, wanted)}"
        )
    return TextRows(found.values, found.labels, found.position, found.skipped, found.first_skipped, units)


def _rows_hint(body: Lines, header: list[str], where: list[int], file_format: FileFormat, wanted: Wanted) -> str:
    mark, now = "," if file_format.decimal == "." else ".", _careful(body, header, where, file_format, wanted)
    for other, rows, hint in (
        (replace(file_format, decimal=mark), wanted, f'write decimal = "{mark}" in [file]'),
        (file_format, replace(wanted, calendar=True), 'write unit = "iso" in [time]'),
    ):
        if _careful(body, header, where, other, rows).skipped < min(now.skipped, len(body) / 2):
            return hint
    stamps = any(f", where {name} holds" in now.first_skipped for name in wanted.needed)
    unit = ', unit in [time] (stamps are numbers, or ISO 8601 as "iso"; without, state rate_hz in [time])'
    return f"check delimiter and decimal in [file]{unit * stamps}, or repair the file"


def _heading(name: str, lines: Lines, file_format: FileFormat, wanted: Wanted) -> tuple[int, list[str]]:
    """Return at which of the lines the rows begin, and the names of the columns."""
    if file_format.columns:
        missing = [key for key in wanted.all if key not in file_format.columns]
        if missing:
            raise RecordingError(f"columns in [file] does not name {', '.join(missing)}, which the mapping uses")
        return 0, list(file_format.columns)
    headers = [_fields(_bare(line), file_format) for _, line in lines[:_PREAMBLE_LINES]]
    likely = [(sum(key in h for key in wanted.all), sum(bool(_like(key, h)) for key in wanted.all)) for h in headers]
    best_at = max(range(len(headers)), key=likely.__getitem__)
    best = headers[best_at]
    for key in wanted.all:
        if (count := best.count(key)) > 1:
            raise RecordingError(
                f"{name} has {count} columns {key}: name all of its columns, each otherwise, by columns = [...] in "
                "[file]"
            )
    missing = [key for key in wanted.all if key not in best]
    if not missing:
        return best_at + 1, best
    which = "its first line" if best_at == 0 else f"its line {lines[best_at][0]}"
    hint = _heading_hint(lines, file_format, wanted, missing, best)
    raise RecordingError(
        f"{name} has no column {', '.join(missing)}: {which} has {', '.join(best)[:400]}; correct the mapping "
        f"(names, delimiter) or give the file it is for{hint}"
    )


def _heading_hint(lines: Lines, file_format: FileFormat, wanted: Wanted, missing: list[str], best: list[str]) -> str:
    for written, mark in _DELIMITERS.items():
        other = replace(file_format, delimiter=mark)
        if any(set(wanted.all) <= set(_fields(_bare(line), other)) for _, line in lines[:_PREAMBLE_LINES]):
            return f'; it has them with delimiter = "{written}" in [file]'
    if alike := [like for key in missing if (like := _like(key, best))]:
        return "; did you mean " + ", ".join(f'"{like}"' for like in alike) + "?"
    if len(missing) == len(wanted.all):
        return "; if it has no heading, name its columns by columns = [...] in [file]"
    return "; if it has no time, state rate_hz in [time]" if set(missing) <= set(wanted.needed) else ""


def _like(key: str, names: list[str]) -> str:
    """Return which of the names is this one but for a unit in brackets, capitals and signs; empty if none is."""
    return next((name for name in names if name != key and _plain(name) == _plain(key)), "")


def _plain(name: str) -> str:
    return re.sub(r"[\[(].*|[\W_]", "", name).lower()


def _fields(line: str, file_format: FileFormat) -> list[str]:
    fields = line.split(file_format.delimiter) if file_format.delimiter else line.split()
    return [field.strip().strip("\"'").strip() for field in fields]


def _bare(text: str) -> str:
    """Return a heading, or a name in one, without the comment sign before it."""
    return re.sub(r"^\s*(#+|%+|//)\s*", "", text) or text


def _is_number(field: str) -> bool:
    try:
        float(field.replace(",", "."))
    except ValueError:
        return field == ""
    return True


def _fast(body: Lines, header: list[str], where: list[int], file_format: FileFormat, wanted: Wanted) -> TextRows | None:
    """Return all rows at once if nothing about them is special, else None."""
    if wanted.labels or wanted.calendar or file_format.decimal != "." or not file_format.delimiter:
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


def _careful(body: Lines, header: list[str], where: list[int], file_format: FileFormat, wanted: Wanted) -> TextRows:
    label_at = [header.index(key) for key in wanted.labels]
    comma = file_format.decimal == ","
    needed = [_calendar_s if wanted.calendar else float] * len(wanted.needed)
    convert: list[Callable[[str], float]] = [*needed, *[_number_or_blank] * len(wanted.may_be_blank)]
    rows: list[list[float]] = []
    texts: list[list[str]] = []
    position: list[int] = []
    skipped, first_skipped, at = 0, "", 0
    for number, line in body:
        fields = _fields(line, file_format)
        row = None
        if len(fields) == len(header) or (len(fields) == len(header) + 1 and not fields[-1]):
            numbers = [fields[i].replace(",", ".") if comma else fields[i] for i in where]
            with suppress(ValueError):
                row = [to_number(field) for to_number, field in zip(convert, numbers, strict=True)]
        if row is None:
            skipped += 1
            first_skipped = (
                first_skipped or f"line {number} ({line.strip()[:_SHOWN]!r}){_wrong(fields, header, where, convert)}"
            )
            at += fields != header  # a heading that comes again stands for no sample
            continue
        rows.append(row)
        texts.append([fields[i] for i in label_at])
        position.append(at)
        at += 1
    values = np.array(rows).reshape(len(rows), len(where))
    return TextRows(values, texts, np.array(position, dtype=np.int64), skipped, first_skipped, ())


def _wrong(fields: list[str], header: list[str], where: list[int], convert: list[Callable[[str], float]]) -> str:
    """Return which field of a broken line is no number, in words; empty if it is another number of fields."""
    for at, to_number in zip(where, convert, strict=True) if len(fields) >= len(header) else ():
        try:
            to_number(fields[at])
        except ValueError:
            return f", where {header[at]} holds {fields[at]!r}"
    return ""


def _number_or_blank(field: str) -> float:
    return float("nan" if field.lower() in _BLANKS else field)


def _calendar_s(field: str) -> float:
    """Return seconds since 1970 of a date with its time (ISO 8601), UTC if it has no zone; ValueError."""
    at = datetime.fromisoformat(field)
    return (at if at.tzinfo else at.replace(tzinfo=UTC)).timestamp()
