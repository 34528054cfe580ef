"""Foreign files as named columns: delimited text and MATLAB files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.errors import RecordingError
from estimator.mapping import Columns, FileFormat

Floats = NDArray[np.float64]

BROKEN_SHARE = 0.05
"""A text file of which more lines than this cannot be read is refused."""


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """Columns of one foreign file by name, each (rows,) or (rows, width), and how many lines were unreadable."""

    name: str
    columns: Mapping[str, NDArray[Any]]
    labels: Mapping[str, tuple[str, ...]]
    skipped_lines: int

    def values(self, wanted: Columns, width: int, what: str) -> Floats:
        """Return (rows, width) values in SI; RecordingError if columns are missing or not this many."""
        parts = [np.atleast_2d(self.columns[name].T).T for name in wanted.names]
        found = sum(part.shape[1] for part in parts)
        if found != width or len({len(part) for part in parts}) != 1:
            shapes = ", ".join(f"{n} {self.columns[n].shape}" for n in wanted.names)
            raise RecordingError(f"{self.name}: {what} needs {width} columns of one length, there are {shapes}")
        return np.asarray(np.hstack(parts) * wanted.scale + wanted.shift, dtype=np.float64)

    def number(self, name: str) -> float:
        """Return a variable that holds one number."""
        value = self.columns[name]
        if value.size != 1 or not np.isfinite(value).all():
            raise RecordingError(f"{self.name}: {name} must be one number, it has shape {value.shape}")
        return float(value.reshape(-1)[0])


def read_table(
    path: Path, file_format: FileFormat, needed: Sequence[str], blank_ok: Sequence[str], labels: Sequence[str]
) -> Table:
    """Read the columns ``needed``, those of ``blank_ok`` (may be blank: NaN) and, as text, of ``labels``.

    Raises RecordingError, naming the file, if it is empty, lacks a column, or is broken in more than 5 % of
    its lines.
    """
    try:
        if path.stat().st_size == 0:
            raise RecordingError(f"{path.name} is empty")
        if file_format.kind == "mat":
            return _read_mat(path, [*needed, *blank_ok, *labels])
        raw = path.read_bytes()
    except OSError as error:
        raise RecordingError(f"{path.name} cannot be read: {error.strerror or error}") from None
    encoding = "utf-16" if raw[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
    text = raw.decode(encoding, errors="replace")
    return _read_text(path.name, text, file_format, needed, blank_ok, labels)


def _read_text(
    name: str,
    text: str,
    file_format: FileFormat,
    needed: Sequence[str],
    blank_ok: Sequence[str],
    labels: Sequence[str],
) -> Table:
    lines = [line for line in text.splitlines() if line.strip()]
    if not lines:
        raise RecordingError(f"{name} is empty")
    header = [field.strip().strip("\"'") for field in lines[0].split(file_format.delimiter)]
    _check_present(name, [*needed, *blank_ok, *labels], header, "its first line")
    numeric = [*needed, *blank_ok]
    where = [header.index(key) for key in numeric]
    label_at = [header.index(key) for key in labels]
    may_be_blank = [False] * len(needed) + [True] * len(blank_ok)
    rows: list[list[float]] = []
    texts: list[list[str]] = []
    comma = file_format.decimal == ","
    for line in lines[1:]:
        fields = line.split(file_format.delimiter)
        if len(fields) != len(header):
            continue
        try:
            row = [
                _number(fields[at].replace(",", ".") if comma else fields[at], blank)
                for at, blank in zip(where, may_be_blank, strict=True)
            ]
        except ValueError:
            continue
        rows.append(row)
        texts.append([fields[at].strip() for at in label_at])
    _check_broken(name, len(lines) - 1, len(rows), file_format)
    values = np.array(rows)
    named = {key: values[:, i] for i, key in enumerate(numeric)}
    return Table(
        name,
        named,
        {key: tuple(row[i] for row in texts) for i, key in enumerate(labels)},
        len(lines) - 1 - len(rows),
    )


def _number(field: str, blank_ok: bool) -> float:
    return float("nan") if blank_ok and not field.strip() else float(field)


def _check_broken(name: str, lines: int, good: int, file_format: FileFormat) -> None:
    if not lines:
        raise RecordingError(f"{name} has a heading but no rows")
    if lines - good > BROKEN_SHARE * lines:
        raise RecordingError(
            f"{name}: {lines - good} of {lines} lines are no rows of numbers with delimiter "
            f"{file_format.delimiter!r} and decimal mark {file_format.decimal!r}: check these two in [file] of the "
            "mapping, or repair the file"
        )


def _check_present(name: str, wanted: Sequence[str], present: Sequence[str], where: str) -> None:
    missing = [key for key in wanted if key not in present]
    if missing:
        raise RecordingError(
            f"{name} has no column {', '.join(missing)}: {where} has {', '.join(present)}; correct the mapping "
            "(names, delimiter) or give the file it is for"
        )


def _read_mat(path: Path, wanted: Sequence[str]) -> Table:
    from scipy.io import loadmat  # only where a .mat file is read

    try:
        found = loadmat(str(path), squeeze_me=False)
    except NotImplementedError:
        raise RecordingError(f"{path.name} is a MATLAB 7.3 file: save it with -v7") from None
    except Exception as error:  # of a damaged file scipy raises whatever its decoders do: zlib.error, IndexError, ...
        raise RecordingError(f"{path.name} is no MATLAB file, or a damaged one: {error}") from None
    present = {key: value for key, value in found.items() if not key.startswith("__")}
    _check_present(path.name, wanted, list(present), "it")
    columns: dict[str, NDArray[Any]] = {}
    for key in wanted:
        try:
            columns[key] = np.asarray(present[key], dtype=np.float64)
        except (TypeError, ValueError):
            raise RecordingError(f"{path.name}: {key} is not numeric") from None
    return Table(path.name, columns, {}, 0)
