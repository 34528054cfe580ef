"""A journal beside a recording: all that a run has taken so far, until its recording is closed whole.

Records one after another, each a mark, length and CRC-32 of what follows, and that: a msgpack list of entries
``[kind, group, values]``, arrays as extension 1, a msgpack list of type, shape and bytes. What is torn or damaged fails
its check and costs itself alone. The format is documented in docs/pages/reference/recording.md.
"""

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

try:
    import fcntl
except ImportError:  # Windows: nothing tells there whether a run still goes on
    fcntl = None  # type: ignore[assignment]

ATTRIBUTES, ROWS, ARRIVED = range(3)
"""Kinds of entries: attributes of a group, rows of its datasets, samples that have arrived and have no time yet."""

Entry = tuple[int, str, Mapping[str, Any]]

_MARK = b"\x93TTJ"
_HEAD = struct.Struct("<4sII")
_MOST_BYTES = 1 << 26  # of a record
_MOST_FAILED = 32  # records that are looked at in vain; what is torn is one or two
_ARRAY = 1
_NEW = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND | getattr(os, "O_BINARY", 0)
_TYPE = re.compile(r"[<|>]([iuf][1248]|b1|S[1-9]\d{0,3})")


def journal_of(recording: Path) -> Path:
    """Return where the journal of a recording is."""
    return recording.with_name(f"{recording.name}.journal")


class Journal:
    """Writes entries; locked until it is removed, so that nobody takes the run for dead."""

    def __init__(self, recording: Path) -> None:
        """Create it; OSError if that fails, FileExistsError if there is one."""
        self._path = journal_of(recording)
        self._file = os.open(self._path, _NEW, 0o666)
        lock(self._file, alone=True)
        self._one_at_a_time = threading.Lock()
        self.unsynced, self._named = False, False

    def write(self, entries: Sequence[Entry]) -> None:
        """Hand one record to the operating system, from whatever thread; OSError if that fails."""
        payload = msgpack.packb(entries, default=_packed)
        record = memoryview(_HEAD.pack(_MARK, len(payload), zlib.crc32(payload)) + payload)
        with self._one_at_a_time:
            while record:
                record = record[os.write(self._file, record) :]
            self.unsynced = True

    def sync(self) -> None:
        """Have the disk keep what has been written; it may take seconds."""
        self.unsynced = False
        getattr(os, "fdatasync", os.fsync)(self._file)
        if not self._named:
            sync(self._path.parent)
            self._named = True

    def close(self, *, remove: bool) -> None:
        """Give up its lock, and remove it where the recording is whole; twice is once."""
        if remove:
            self._path.unlink(missing_ok=True)
        if self._file >= 0:
            os.close(self._file)
            self._file = -1


def lock(file: BinaryIO | int, *, alone: bool, wait: bool = False) -> bool:
    """Lock a file, against all others or only against who wants it alone; return whether that could be done."""
    if fcntl is None:
        return True
    try:
        fcntl.flock(file, (fcntl.LOCK_EX if alone else fcntl.LOCK_SH) | (0 if wait else fcntl.LOCK_NB))
    except BlockingIOError:
        return False
    except OSError:
        pass  # a file system without locks
    return True


def sync(path: Path) -> None:
    """Have the disk keep a file, or the names in a folder; OSError if it does not."""
    with suppress(PermissionError):  # Windows opens no folders
        descriptor = os.open(path, os.O_RDWR if path.is_file() else os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def read_journal(file: BinaryIO) -> Iterator[Entry | None]:
    """Yield the entries of every whole record, and None for each place where something was passed over.

    ValueError for a record that is whole and is none of ours.
    """
    at, failed, size = 0, 0, file.seek(0, os.SEEK_END)
    while at + _HEAD.size <= size and failed < _MOST_FAILED:
        file.seek(at)
        mark, length, check = _HEAD.unpack(file.read(_HEAD.size))
        payload = file.read(length) if mark == _MARK and length <= min(_MOST_BYTES, size - at) else b""
        if payload and len(payload) == length and zlib.crc32(payload) == check:
            at += _HEAD.size + length
            yield from _entries(payload)
            continue
        failed += mark == _MARK
        yield None
        at = _next_mark(file, at + 1)


def _next_mark(file: BinaryIO, at: int) -> int:
    """Return where the next mark is, or the end."""
    while True:
        file.seek(at)
        block = file.read(1 << 20)
        if (found := block.find(_MARK)) >= 0:
            return at + found
        if len(block) < len(_MARK):
            return at + len(block)
        at += len(block) - len(_MARK) + 1


def _entries(payload: bytes) -> list[Entry]:
    entries = msgpack.unpackb(payload, ext_hook=_unpacked)
    if not isinstance(entries, list):
        raise ValueError("no list of entries")
    for entry in entries:
        match entry:
            case [int(), str(), dict()]:
                pass
            case _:
                raise ValueError("an entry that is none")
    return entries


def _packed(value: Any) -> msgpack.ExtType:
    array = np.asarray(value)
    return msgpack.ExtType(_ARRAY, msgpack.packb([array.dtype.str, array.shape, array.tobytes()]))


def _unpacked(code: int, data: bytes) -> Any:
    kind, shape, raw = msgpack.unpackb(data)
    if code != _ARRAY or not isinstance(kind, str) or not _TYPE.fullmatch(kind) or (shape and 0 in shape[1:]):
        raise ValueError("an array of no type that a recording has")
    return np.frombuffer(raw, kind).reshape(shape)
