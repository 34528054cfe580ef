"""External files as named columns: delimited text and MATLAB files."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.errors import MISSHAPEN, RecordingError, first_line
from estimator.importing.mapping.mapping import FileFormat
from estimator.importing.table import HUGE, Table, Wanted, no_column
from estimator.importing.text_rows import read_rows
from estimator.packaged import sentence
from estimator.recordings.safe_open import probe
from estimator.untrusted import read_bytes

_ABSURD_SHARE = 0.1
_LOOKED_AT, _BINARY = 4000, 0.05  # bytes at the beginning, and how many of them may be no text
_TEXT = bytes([*range(9, 14), *range(32, 256)])


def read_table(path: Path, file_format: FileFormat, wanted: Wanted) -> Table:
    """Return the wanted columns of a file: MATLAB, binary, a capture, or text, as ``file_format`` says.

    RecordingError, naming the file, if it is empty, of another kind, lacks a column, or is damaged; text may be broken
    in up to 10 % of its lines.
    """
    try:
        if path.stat().st_size == 0:
            raise RecordingError(f"{path.name} is empty")
    except OSError as error:
        raise RecordingError(f"{path.name} cannot be read: {error.strerror or error}") from None
    if file_format.kind == "mat":
        return _read_mat(path, wanted.all)
    raw = read_bytes(path, RecordingError, name=path.name)
    if file_format.record is not None:
        return _read_binary(path.name, raw, file_format.record, file_format.header_bytes, wanted.all)
    if file_format.capture is not None:
        try:
            columns, notes = file_format.capture(raw, (*wanted.may_be_blank, *wanted.needed))
        except MISSHAPEN as error:
            raise RecordingError(f"{path.name} cannot be read: it is damaged ({first_line(error)})") from None
        if not columns:
            raise RecordingError(f"{path.name} holds no message of {file_format.kind}. Check [file]")
        _check_present(path.name, wanted.all, list(columns), "the capture")
        return Table(name=path.name, columns=columns, notes=notes)
    if raw[:4] == b"PK\x03\x04":
        raise RecordingError(f"{path.name} is a spreadsheet or an archive. Save its table as CSV")
    if raw[:1] not in (b"\xff", b"\xfe") and len(raw[:_LOOKED_AT].translate(None, _TEXT)) > _BINARY * len(
        raw[:_LOOKED_AT]
    ):
        raise RecordingError(sentence("importing.no_text", name=path.name))
    return read_rows(path.name, _decoded(raw, wanted), file_format, wanted)


def _decoded(raw: bytes, wanted: Wanted) -> str:
    """Return the text of a file in UTF-16 (with its mark), else UTF-8, or Latin-1 if a wanted column is not found in
    that.

    Only names with characters beyond ASCII are looked for. Bytes that are no text of the encoding are replaced.
    """
    if raw[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return raw.decode("utf-16", errors="replace")
    text = raw.decode("utf-8-sig", errors="replace")
    # A degree sign of Latin-1 in a heading is no UTF-8, but neither is the garbage in a broken line.
    special = [key for key in wanted.all if not key.isascii()]
    if any(key not in text for key in special):
        return raw.decode("latin-1")
    return text


def _check_present(name: str, wanted: Sequence[str], present: Sequence[str], where: str) -> None:
    missing = [key for key in wanted if key not in present]
    if missing:
        raise no_column(name, missing, where, present)


def _read_binary(name: str, raw: bytes, record: np.dtype[Any], header_bytes: int, wanted: Sequence[str]) -> Table:
    """Return the wanted columns of a binary file of rows of type ``record``, behind ``header_bytes``.

    Bytes of an unfinished row at the end are skipped, with a note. RecordingError if a column is missing, the file has
    no row, or its numbers are implausible.
    """
    numeric = [key for key in record.names or () if record[key].base.kind != "V"]
    _check_present(name, wanted, numeric, "record in [file]")
    count, rest = divmod(len(raw) - header_bytes, record.itemsize)
    if count < 1:
        raise RecordingError(sentence("importing.short_record", name=name, size=len(raw), record=record.itemsize))
    rows = np.frombuffer(raw, record, count, header_bytes)
    with np.errstate(invalid="ignore"):  # values that are not numbers may be signalling NaN
        columns = {key: rows[key].astype(np.float64) for key in wanted}
    size = np.concatenate([np.abs(column).ravel() for column in columns.values()])
    if np.mean((size > HUGE) | ((size > 0) & (size < 1 / HUGE))) > _ABSURD_SHARE:
        raise RecordingError(f"{name} holds no plausible numbers. Check record, header_bytes and byte_order in [file]")
    notes = (f"it ends within a record; the last {rest} bytes were skipped",) if rest else ()
    return Table(name=name, columns=columns, notes=notes)


def _read_mat(path: Path, wanted: Sequence[str]) -> Table:
    """Return the wanted variables of a MATLAB file, samples along their first dimension.

    RecordingError if the file cannot be read, or one is missing or not numeric.
    """
    from scipy.io import loadmat  # only where a .mat file is read

    try:
        probe(path, "MATLAB")
    except RecordingError as error:
        raise RecordingError(str(error).replace(f"{path} cannot be read: it", path.name)) from None
    found = loadmat(str(path), squeeze_me=False)  # as the process that reads files first has done
    present = {key: value for key, value in found.items() if not key.startswith("__")}
    _check_present(path.name, wanted, list(present), "it")
    columns: dict[str, NDArray[Any]] = {}
    for key in wanted:
        try:
            columns[key] = np.asarray(present[key], dtype=np.float64)
        except (TypeError, ValueError):
            raise RecordingError(f"{path.name}: {key} is not numeric") from None
    return Table(name=path.name, columns=by_rows(columns))


def by_rows(columns: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Return arrays with samples along their first dimension, (n,) or (n, width), however they are stored.

    The number of samples is the longest side of any array. Arrays with it along another side only are turned, and
    further dimensions joined; arrays without it stay as they are.
    """
    rows = max((max(values.shape, default=1) for values in columns.values()), default=1)
    found = {}
    for name, values in columns.items():
        along = [axis for axis, size in enumerate(values.shape) if size == rows]
        turned = np.moveaxis(values, along[-1], 0) if along and 0 not in along and rows > 1 else values
        if turned.ndim > 1 and len(turned) == rows and rows > 1:
            turned = turned.reshape(rows, -1)
        found[name] = turned
    return found
