"""Index of the recordings of a folder, kept between sessions: made of the files, and never the truth itself.

It is among what programs remember of this user, not in the folder, which may be a stranger's, write-protected, or on a
share whose locks do not reach other machines. A row counts if its checksum holds and its file has still the same size
and date; an index with which anything else is wrong is begun anew.
"""

import gc
import hashlib
import json
import os
import sqlite3
import zlib
from collections.abc import Sequence
from contextlib import closing, suppress
from pathlib import Path
from typing import Any, TypeAlias

from drivers.packaged import packaged_text
from estimator.errors import MISSHAPEN
from station.screen.archive.entries import Entry
from station.screen.memory import state_folder

_VERSION = 1  # of what an entry holds: an older index is left to older stations
_PATIENCE_S = 1.0  # for another station, which writes for some milliseconds
_TOLD = ("when_utc_s", "wrong", "foreign", "devices", "texts")
File: TypeAlias = tuple[str, int, int]
"""Path of a file, when it was changed in nanoseconds since 1970, and its size in bytes."""


def index_file(folder: Path) -> Path:
    """Return where the index of a folder is."""
    name = hashlib.sha256(os.fsencode(folder.resolve())).hexdigest()[:20]
    return state_folder() / "records" / f"{name}-{_VERSION}.sqlite"


def load(folder: Path) -> dict[File, Entry]:
    """Return what the index of a folder holds; nothing if there is none, or none that can be read."""
    found = {}
    texts = "IFNULL(CAST(entry AS TEXT), ''), IFNULL(CAST(figures AS TEXT), '')"  # also where harm made them other
    rows = _done(folder, f"SELECT path, mtime_ns, size, {texts}, checksum FROM recordings")
    gc.disable()  # none of ten thousand entries is garbage: to look for it takes a third of the time
    try:
        for *row, checksum in rows:
            if checksum == _checksum(row):
                path, told = os.path.join(folder, os.fsdecode(row[0])), json.loads(row[3])
                told["devices"] = tuple(told["devices"])
                found[path, row[1], row[2]] = Entry(Path(path), figures=row[4].decode(), **told)
    finally:
        gc.enable()
    return found


def keep(folder: Path, file: File, entry: Entry) -> None:
    """Add a recording to the index of a folder, if it can be written."""
    told = json.dumps({name: getattr(entry, name) for name in _TOLD})
    row = [os.fsencode(os.path.relpath(file[0], folder)), *file[1:], told.encode(), entry.figures.encode()]
    values = "CAST(? AS TEXT), ?, ?, CAST(? AS TEXT), CAST(? AS TEXT), ?"
    _done(folder, f"REPLACE INTO recordings VALUES ({values})", *row, _checksum(row))


def _checksum(row: Sequence[Any]) -> int:
    return zlib.crc32(row[4], zlib.crc32(row[3], zlib.crc32(repr(row[:3]).encode())))


def _done(folder: Path, sql: str, *values: Any) -> list[Any]:
    """Return what a statement gives, nothing if it fails; then an index that is not just busy goes."""
    path = index_file(folder)
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        with closing(sqlite3.connect(path, timeout=_PATIENCE_S)) as index, index:
            index.text_factory = bytes
            index.executescript(packaged_text("station.screen.archive", "index.sql"))
            return index.execute(sql, values).fetchall()
    except (sqlite3.Error, *MISSHAPEN) as error:  # of a damaged one the words of an error may be no text
        if getattr(error, "sqlite_errorcode", None) != sqlite3.SQLITE_BUSY:
            with suppress(OSError):
                path.unlink()
        return []
