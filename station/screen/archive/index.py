"""Index of the recordings of a folder, kept between sessions; the files themselves are authoritative.

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
from collections.abc import Mapping, Sequence
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

from drivers.packaged import packaged_text
from estimator.errors import MISSHAPEN
from station.screen.archive.entries import Entry, File
from station.screen.memory import is_of_this_user_alone, state_folder

_VERSION = 2  # of the content of an entry: an older index is left to older stations
_PATIENCE_S = 1.0  # for another station, which writes for some milliseconds
_AS_JSON = ("when_utc_s", "wrong", "foreign", "devices", "texts", "nis_mean", "units")


def index_file(folder: Path) -> Path:
    """Return where the index of a folder is."""
    name = hashlib.sha256(os.fsencode(folder.resolve())).hexdigest()[:20]
    return state_folder() / "records" / f"{name}-{_VERSION}.sqlite"


def load(folder: Path) -> dict[File, Entry]:
    """Return the entries in the index of a folder, also those whose file has changed or gone since.

    Nothing if there is no index or it is damaged, and a new one is begun; nothing either if others can write to its
    folder. Damaged rows are skipped.
    """
    found, top = {}, os.path.join(folder, "")
    texts = "IFNULL(CAST(entry AS TEXT), ''), IFNULL(CAST(figures AS TEXT), '')"  # also where harm made them other
    rows = _done(folder, f"SELECT path, mtime_ns, size, {texts}, checksum FROM recordings") or ()
    gc.disable()  # none of ten thousand entries is garbage: to look for it takes a third of the time
    try:
        sound = [row for *row, checksum in rows if checksum == _checksum(row)]
        about = json.loads(b"[%b]" % b",".join(row[3] for row in sound))
        for (path, mtime_ns, size, _, figures), more in zip(sound, about, strict=True):
            more["devices"] = tuple(more["devices"])
            entry = Entry(top + os.fsdecode(path), figures=figures, **more)
            found[entry.file, mtime_ns, size] = entry
    finally:
        gc.enable()
    return found


def keep(folder: Path, entries: Mapping[File, Entry]) -> bool:
    """Add entries to the index of a folder, or replace those of the same files; return whether that succeeded.

    If not, the index is deleted, unless it was only busy or others can write to its folder.
    """
    rows = []
    for file, entry in entries.items():
        as_json = json.dumps({name: getattr(entry, name) for name in _AS_JSON})
        rows.append([os.fsencode(os.path.relpath(file[0], folder)), *file[1:], as_json.encode(), entry.figures])
    sql = "REPLACE INTO recordings VALUES (CAST(? AS TEXT), ?, ?, CAST(? AS TEXT), CAST(? AS TEXT), ?)"
    return _done(folder, sql, [[*row, _checksum(row)] for row in rows]) is not None


def _checksum(row: Sequence[Any]) -> int:
    return zlib.crc32(row[4], zlib.crc32(row[3], zlib.crc32(repr(row[:3]).encode())))


def _done(folder: Path, sql: str, rows: Sequence[Sequence[Any]] | None = None) -> list[Any] | None:
    """Run a statement on the index of a folder, created if missing; return its rows, None if it failed.

    Texts in its rows are bytes. With ``rows`` the statement is run once for each of them, as its parameters, and
    returns []. An index that failed, except for being busy, is deleted. Return None, and touch nothing, if the folder
    of the index is not this user's alone.
    """
    path = index_file(folder)
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        if not is_of_this_user_alone(path.parent):
            return None  # SQLite follows links, and writes into their targets
        with closing(sqlite3.connect(path, timeout=_PATIENCE_S)) as index, index:
            index.text_factory = bytes
            index.executescript(packaged_text("station.screen.archive", "index.sql"))
            return (index.execute(sql) if rows is None else index.executemany(sql, rows)).fetchall()
    except (sqlite3.Error, *MISSHAPEN) as error:  # of a damaged one the words of an error may be no text
        if getattr(error, "sqlite_errorcode", None) != sqlite3.SQLITE_BUSY:
            with suppress(OSError):
                path.unlink()
        return None
