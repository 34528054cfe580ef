"""A journal beside a recording: all data of a run so far, until its recording is complete.

Records one after another, each a mark, length and CRC-32 of what follows, and that: a msgpack list of entries ``[kind,
group, values]``, arrays as extension 1, a msgpack list of type, shape and bytes. What is torn or damaged fails its
check and costs itself alone. The format is documented in docs/pages/reference/recording.md.
"""

import math
import os
import re
import struct
import threading
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO

import msgpack
import numpy as np

from estimator.recordings.recording import LAYOUT

try:
    import fcntl
except ImportError:  # Windows, where a run in progress cannot be detected
    fcntl = None  # type: ignore[assignment]

ATTRIBUTES, ROWS, ARRIVED = range(3)
"""Kinds of entries: attributes of a group, rows of its datasets, samples that have arrived and have no time yet."""

Entry = tuple[int, str, Mapping[str, Any]]

_NAME = r"(?!\.{1,2}(?:/|$))[^/\0]{1,200}"
_GROUP = re.compile(rf"/|{_NAME}(?:/{_NAME}){{0,3}}")
_COLUMN = re.compile(_NAME)
_MOST_ROW_BYTES = 1 << 16
_MOST_ATTRIBUTE_BYTES = 64_000
_MOST_TEXT_BYTES = 1 << 22
"""Of one attribute: HDF5 keeps numbers, and references to texts, in 64 KiB beside its name."""
_MARK = b"\x93TTJ"
_HEAD = struct.Struct("<4sII")
_MOST_BYTES = 1 << 26  # of a record
_MOST_SEARCHED_BYTES = 1 << 30
"""Read in vain while looking for whole records: false marks must not keep a reader busy for hours."""
_LEAST_BLOCK_BYTES, _MOST_BLOCK_BYTES = 1 << 12, 1 << 20
"""Read at once while looking for a mark."""
_ARRAY = 1
_NEW = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND | getattr(os, "O_BINARY", 0)
_TYPE = re.compile(r"[<|>]([iuf][1248]|b1|S[1-9]\d{0,3})")


def journal_of(recording: Path) -> Path:
    """Return where the journal of a recording is."""
    return recording.with_name(f"{recording.name}.journal")


class Journal:
    """A journal of entries; locked until it is removed, so that no other process takes the run for dead."""

    def __init__(self, recording: Path) -> None:
        """Create it; OSError if that fails, FileExistsError if there is one."""
        self._path = journal_of(recording)
        self._file = os.open(self._path, _NEW, 0o666)
        lock(self._file, alone=True)
        self._one_at_a_time = threading.Lock()
        self.unsynced, self._named = False, False

    def write(self, entries: Sequence[Entry]) -> None:
        """Write the entries as one record, from any thread; OSError if that fails. It is not synced to the disk."""
        payload = msgpack.packb(entries, default=_packed)
        record = memoryview(_HEAD.pack(_MARK, len(payload), zlib.crc32(payload)) + payload)
        with self._one_at_a_time:
            while record:
                record = record[os.write(self._file, record) :]
            self.unsynced = True

    def sync(self) -> None:
        """Sync the written data to disk; this may take seconds."""
        self.unsynced = False
        getattr(os, "fdatasync", os.fsync)(self._file)
        if not self._named:
            sync(self._path.parent)
            self._named = True

    def close(self, *, remove: bool) -> None:
        """Release the lock, and remove the file if the recording is complete; a second call does nothing."""
        if remove:
            self._path.unlink(missing_ok=True)
        if self._file >= 0:
            os.close(self._file)
            self._file = -1


def lock(file: BinaryIO | int, *, alone: bool) -> bool:
    """Lock a file, exclusively (``alone``) or shared, without waiting; return whether that succeeded.

    True, too, if the system or the file system has no such locks.
    """
    if fcntl is None:
        return True
    try:
        fcntl.flock(file, (fcntl.LOCK_EX if alone else fcntl.LOCK_SH) | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        pass  # a file system without locks
    return True


def sync(path: Path) -> None:
    """Sync a file, or the names in a folder, to the disk; OSError if that fails. Nothing for one that may not be
    opened.
    """
    with suppress(PermissionError):  # Windows opens no folders
        descriptor = os.open(path, os.O_RDWR if path.is_file() else os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def is_sound(entry: Entry) -> bool:
    """Return whether a recording can hold an entry: the one rule for writing and for reading.

    Groups are paths of up to four names; the root "/" has attributes only. Rows are arrays of numbers, truth values or
    bytes, of at most 64 KiB a row, and at least one column of them. Columns that ``LAYOUT`` describes have its
    dimensions and type. Samples without a time have exactly the columns ``arrival_ns`` (n,) and ``rate_rps`` (n, m).
    """
    kind, group, values = entry
    if not _GROUP.fullmatch(group) or not all(isinstance(name, str) and _COLUMN.fullmatch(name) for name in values):
        return False
    if kind == ATTRIBUTES:
        return all(map(_is_attribute, values.values()))
    if kind not in (ROWS, ARRIVED) or group == "/" or not values:
        return False
    if not all(_is_column(name, column) for name, column in values.items()):
        return False
    if kind == ROWS:
        return True
    if values.keys() != {"arrival_ns", "rate_rps"} or len(values["arrival_ns"]) != len(values["rate_rps"]):
        return False
    return bool(values["arrival_ns"].ndim == 1 and values["arrival_ns"].dtype.kind == "i")


def _is_column(name: str, column: Any) -> bool:
    """Return whether a value can be rows of a dataset of this name: an array of one to three dimensions, not too wide.

    A name that ``LAYOUT`` describes must have its dimensions and be of integers, of any size, or if it says so floats,
    for which integers do as well.
    """
    if not isinstance(column, np.ndarray) or not 1 <= column.ndim <= 3 or not _TYPE.fullmatch(column.dtype.str):
        return False
    if column.dtype.itemsize * math.prod(column.shape[1:]) > _MOST_ROW_BYTES:
        return False
    described = LAYOUT.get(name, {})
    if "dimensions" not in described:
        return True
    kinds = "iu" if described["type"] == "int64" else "iuf"
    return column.dtype.kind in kinds and described["dimensions"] in (0, column.ndim)


def _is_attribute(value: Any) -> bool:
    """Return whether HDF5 can store a value as an attribute: a text, a number, or a sequence or array of one kind.

    A sequence may be empty. False above ``_MOST_ATTRIBUTE_BYTES`` of numbers, or of references to texts at 16 bytes
    each, above ``_MOST_TEXT_BYTES`` of text, and for texts with the character 0.
    """
    if isinstance(value, np.ndarray):
        return bool(_TYPE.fullmatch(value.dtype.str)) and value.nbytes <= _MOST_ATTRIBUTE_BYTES
    items = list(value) if isinstance(value, (list, tuple)) else [value]
    if all(isinstance(item, str) for item in items):
        text = "".join(items)
        room = 16 * len(items) <= _MOST_ATTRIBUTE_BYTES and len(text.encode(errors="replace")) <= _MOST_TEXT_BYTES
        return room and "\0" not in text
    room = 16 * len(items) <= _MOST_ATTRIBUTE_BYTES
    return room and all(isinstance(item, (int, float, np.number, np.bool_)) for item in items)


def read_journal(file: BinaryIO) -> Iterator[Entry | None]:
    """Yield the entries of every intact record, and None for each place that is skipped.

    Skipped are torn or damaged records, bytes that are no record, and entries that no recording can hold
    (``is_sound``). The journal ends early, without an entry, once more than ``_MOST_SEARCHED_BYTES`` had to be searched
    after damage.
    """
    at, searched, size = 0, 0, file.seek(0, os.SEEK_END)
    while at + _HEAD.size <= size and searched < _MOST_SEARCHED_BYTES:
        file.seek(at)
        mark, length, check = _HEAD.unpack(file.read(_HEAD.size))
        payload = file.read(length) if mark == _MARK and length <= min(_MOST_BYTES, size - at) else b""
        if payload and len(payload) == length and zlib.crc32(payload) == check:
            at += _HEAD.size + length
            yield from _entries(payload)
            continue
        yield None
        after, scanned = _next_mark(file, at + 1)
        searched += len(payload) + scanned
        at = after


def _next_mark(file: BinaryIO, at: int) -> tuple[int, int]:
    """Return the position of the next mark from ``at`` on, or the end, and the number of bytes read to find it."""
    scanned, block_bytes = 0, _LEAST_BLOCK_BYTES
    while True:
        file.seek(at)
        block = file.read(block_bytes)
        scanned += len(block)
        found = block.find(_MARK)
        if found >= 0:
            return at + found, scanned
        if len(block) < len(_MARK):
            return at + len(block), scanned
        at += len(block) - len(_MARK) + 1
        block_bytes = min(4 * block_bytes, _MOST_BLOCK_BYTES)


def _entries(payload: bytes) -> list[Entry | None]:
    """Return the entries of an intact record; None for each invalid one, and a single None if it is no list of
    entries.
    """
    try:
        entries = msgpack.unpackb(payload, ext_hook=_unpacked, strict_map_key=False)
    except Exception:  # anybody may have made the bytes; msgpack raises ValueError, TypeError and more
        return [None]
    if not isinstance(entries, list):
        return [None]
    return [entry if _is_entry(entry) and is_sound(entry) else None for entry in entries]


def _is_entry(entry: Any) -> bool:
    match entry:
        case [int(), str(), dict()]:
            return True
    return False


def _packed(value: Any) -> msgpack.ExtType:
    array = np.asarray(value)
    return msgpack.ExtType(_ARRAY, msgpack.packb([array.dtype.str, array.shape, array.tobytes()]))


def _unpacked(code: int, data: bytes) -> Any:
    """Return the array in a msgpack extension of type ``code``; None if it is of another type, or damaged."""
    if code != _ARRAY:
        return None
    try:
        kind, shape, raw = msgpack.unpackb(data)
        if not _TYPE.fullmatch(kind) or 0 in shape[1:] or min(shape, default=0) < 0:
            return None
        return np.frombuffer(raw, kind).reshape(shape)
    except (ValueError, TypeError, ArithmeticError):
        return None
