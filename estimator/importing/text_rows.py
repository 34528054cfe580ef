"""Rows of numbers of a text log, which may have broken lines, comments, a preamble and a row of units."""

import re
from collections import Counter
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from estimator.errors import RecordingError
from estimator.importing.mapping.mapping import FileFormat
from estimator.importing.stamps import ISO, has_date, over_midnight, pattern_of, seconds_of
from estimator.importing.table import Table, Wanted, no_column
from estimator.packaged import sentence

Lines = list[tuple[int, str]]

BROKEN_SHARE = 0.1
"""A text file of which more lines than this cannot be read is refused."""
_PREAMBLE_LINES = 200
_COMMENTS = ("#", "%", "//")
_DELIMITERS = {",": ",", ";": ";", "tab": "\t", "space": ""}
_BLANKS = frozenset(("", "-", "na", "n/a", "null", "none"))
_SHOWN = 60  # characters of a broken line in a message


@dataclass(frozen=True, slots=True)
class _Body:
    """Lines below the heading of a file, the names of its columns, and the wanted ones."""

    name: str
    lines: Lines
    header: list[str]
    format: FileFormat
    wanted: Wanted

    @property
    def where(self) -> list[int]:
        """Place of each wanted number in a line."""
        return [self.header.index(_bare(key)) for key in self.wanted.numeric]

    def fast(self) -> Table | None:
        """Return all rows at once if nothing is special about them, else None.

        Special are labels, stamps by a calendar, decimal commas, blanks as delimiter, and lines of another width or
        without a number.
        """
        delimiter, separators = self.format.delimiter, len(self.header) - 1
        if self.wanted.labels or self.wanted.calendar or self.format.decimal != "." or not delimiter:
            return None
        if any(line.count(delimiter) != separators for _, line in self.lines):
            return None
        try:
            lines = [line for _, line in self.lines]
            values = np.loadtxt(lines, delimiter=delimiter, usecols=self.where, comments=None, ndmin=2)
        except ValueError:
            return None
        return Table(
            name=self.name,
            columns=dict(zip(self.wanted.numeric, values.T, strict=True)),
            position=np.arange(len(values)),
        )

    def careful(self) -> Table:
        """Return the rows that can be read, line by line; others are counted, and the first is described.

        Broken lines leave a gap in the positions of rows, a repeated heading does not. A blank field too many at the
        end of a line is no fault. Times of day go on over midnight.
        """
        wanted, header = self.wanted, self.header
        label_at = [header.index(_bare(key)) for key in wanted.labels]
        to_seconds = partial(seconds_of, pattern=wanted.calendar)
        needed = [to_seconds if wanted.calendar else float] * len(wanted.needed)
        columns = list(zip(self.where, [*needed, *[_number_or_blank] * len(wanted.may_be_blank)], strict=True))
        good: list[tuple[int, list[float], list[str]]] = []  # by their place among the lines
        skipped, first_skipped, at = 0, "", 0
        for number, line in self.lines:
            fields = _fields(line, self.format)
            whole = len(fields) == len(header) or (len(fields) == len(header) + 1 and not fields[-1])
            row, wrong = [], ""
            for i, to_number in columns if len(fields) >= len(header) else ():
                try:
                    row.append(to_number(fields[i].replace(",", ".") if self.format.decimal == "," else fields[i]))
                except ValueError:
                    whole, wrong = False, f", where {header[i]} holds {fields[i]!r}"
                    break
            if not whole:
                skipped += 1
                first_skipped = first_skipped or f"line {number} ({line.strip()[:_SHOWN]!r}){wrong}"
                at += fields != header  # a heading that comes again stands for no sample
                continue
            good.append((at, row, [fields[i] for i in label_at]))
            at += 1
        values = np.array([row for _, row, _ in good]).reshape(len(good), len(columns))
        if wanted.calendar and not has_date(wanted.calendar) and len(good):
            stamps = slice(0, len(wanted.needed))
            values[:, stamps] = np.column_stack([over_midnight(column) for column in values[:, stamps].T])
        return Table(
            name=self.name,
            columns=dict(zip(wanted.numeric, values.T, strict=True)),
            labels={key: tuple(texts[i] for _, _, texts in good) for i, key in enumerate(wanted.labels)},
            skipped_lines=skipped,
            first_skipped=first_skipped,
            position=np.array([place for place, _, _ in good], dtype=np.int64),
        )

    def hint(self) -> str:
        """Return what to write in the mapping so that more lines can be read.

        In this order: names of columns for a heading that is too short or long, the other decimal mark, the form of the
        stamps; else the advice to check the format or repair the file.
        """
        widths = Counter(len(_fields(line, self.format)) for _, line in self.lines)
        width, count = widths.most_common(1)[0]
        if width != len(self.header) and width > 1 and count > (1 - BROKEN_SHARE) * len(self.lines):
            return (
                f"its heading names {len(self.header)} columns ({', '.join(self.header)[:_SHOWN]}) and its rows have "
                f"{width} fields: name them with columns = [...] in [file]"
            )
        mark, now = "," if self.format.decimal == "." else ".", self.careful()
        for other, hint in (
            (replace(self, format=replace(self.format, decimal=mark)), f'write decimal = "{mark}" in [file]'),
        ):
            if other.careful().skipped_lines < min(now.skipped_lines, len(self.lines) / 2):
                return hint
        if self.wanted.needed and (told := self._stamps_hint()):
            return told
        stamps = any(f", where {_bare(name)} holds" in now.first_skipped for name in self.wanted.needed)
        unit = ', unit in [time] (stamps are numbers, or ISO 8601 as "iso"; without, state rate_hz in [time])'
        return f"check delimiter and decimal in [file]{unit * stamps}, or repair the file"

    def _stamps_hint(self) -> str:
        """Return how to state stamps that are dates or times; "" if they are numbers, of no known form, or missing."""
        at = self.header.index(_bare(self.wanted.needed[0]))
        fields = [_fields(line, self.format) for _, line in self.lines]
        texts = [own[at] for own in fields if len(own) >= len(self.header)]
        if not texts or all(_is_number(text) for text in texts):
            return ""
        pattern = pattern_of(texts)
        if pattern is None:
            return ""
        return (
            'write unit = "iso" in [time]'
            if pattern == ISO
            else f'write unit = "pattern", pattern = "{pattern}" in [time]'
        )


def read_rows(name: str, text: str, file_format: FileFormat, wanted: Wanted) -> Table:
    """Return the wanted columns of a text log; a row of units below the heading is kept apart.

    Blank lines and comments are ignored; broken lines are left out and counted. A first row without a number in any
    wanted column is the row of units, unless the mapping names the columns. RecordingError, naming the file, if it is
    empty, has a heading but no rows, lacks a wanted column or has it twice, or more than 10 % of its lines are broken;
    then with the first of these and a hint.
    """
    lines = [(number, line) for number, line in enumerate(re.split(r"\r\n|\n|\r", text), 1) if line.strip("\0 \t")]
    if not lines:
        raise RecordingError(f"{name} is empty")
    needed, blank, labels = (tuple(map(_bare, names)) for names in (wanted.needed, wanted.may_be_blank, wanted.labels))
    start, header = _heading(name, lines, file_format, Wanted(needed, blank, labels))
    body = [(number, line) for number, line in lines[start:] if not line.lstrip().startswith(_COMMENTS)]
    if not body:
        raise RecordingError(f"{name} has a heading but no rows")
    units: dict[str, str] = {}
    own, first = _Body(name, body, header, file_format, wanted), _fields(body[0][1], file_format)
    if not file_format.columns and len(first) == len(header) and not any(_is_number(first[at]) for at in own.where):
        units = {key: first[at].strip("[]()") for key, at in zip(wanted.numeric, own.where, strict=True)}
        own = replace(own, lines=body[1:])
    found = own.fast() or own.careful()
    rows = found.skipped_lines + len(next(iter(found.columns.values())))
    if not rows:
        raise RecordingError(f"{name} has a heading but no rows")
    if found.skipped_lines > BROKEN_SHARE * rows:
        raise RecordingError(
            f"{name}: {found.skipped_lines} of {rows} lines are not rows of {len(header)} fields with delimiter "
            f"{file_format.delimiter or 'space'!r} and decimal mark {file_format.decimal!r}, the first is "
            f"{found.first_skipped}: {replace(own, lines=own.lines[:_PREAMBLE_LINES]).hint()}"
        )
    return replace(found, units=units)


def _heading(name: str, lines: Lines, file_format: FileFormat, wanted: Wanted) -> tuple[int, list[str]]:
    """Return the number of the first line of rows, among ``lines``, and the names of the columns.

    Names stated in [file] hold as they are; else the heading is that of the first 200 lines which has most of the
    wanted names. RecordingError if a wanted name is missing or occurs twice.
    """
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
            raise RecordingError(sentence("importing.column_twice", file=name, count=count, column=key))
    missing = [key for key in wanted.all if key not in best]
    if not missing:
        return best_at + 1, best
    which = "its first line" if best_at == 0 else f"its line {lines[best_at][0]}"
    raise no_column(name, missing, which, best, _heading_hint(lines, file_format, wanted, missing, best))


def _heading_hint(lines: Lines, file_format: FileFormat, wanted: Wanted, missing: list[str], best: list[str]) -> str:
    """Return what to change if columns are ``missing``: delimiter, spelling, columns or rate_hz; "" if unknown.

    ``best`` are the names of the line that has most of the wanted ones.
    """
    for written, mark in _DELIMITERS.items():
        other = replace(file_format, delimiter=mark)
        if any(set(wanted.all) <= set(_fields(_bare(line), other)) for _, line in lines[:_PREAMBLE_LINES]):
            return f'; it has them with delimiter = "{written}" in [file]'
    if alike := [like for key in missing if (like := _like(key, best))]:
        return "; did you mean " + ", ".join(f'"{like}"' for like in alike) + "?"
    if len(missing) == len(wanted.all):
        return "; if it has no heading, name its columns with columns = [...] in [file]"
    return "; if it has no time, state rate_hz in [time]" if set(missing) <= set(wanted.needed) else ""


def _like(key: str, names: list[str]) -> str:
    """Return which of the names is this one but for a unit in brackets, capitals and signs; empty if none is."""
    plain = partial(re.sub, r"[\[(].*|[\W_]", "")
    return next((name for name in names if name != key and plain(name).lower() == plain(key).lower()), "")


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


def _number_or_blank(field: str) -> float:
    return float("nan" if field.lower() in _BLANKS else field)
