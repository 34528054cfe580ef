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
from collections.abc import Mapping, Sequence
from contextlib import closing, suppress
from functools import cache
from pathlib import Path
from typing import Any

from drivers.packaged import packaged_text
from estimator.errors import MISSHAPEN
from station.screen.archive.entries import TEXTS, Entry, File
from station.screen.memory import state_folder

_VERSION = 2  # of what an entry holds: an older index is left to older stations
_PATIENCE_S = 1.0  # for another station, which writes for some milliseconds
_NUMBERS = ("mtime_ns", "size", "when_utc_s", "is_other")
_COLUMNS = {"station": "bench", "device_serial": "serial"}  # what is not called as its attribute is
_NAMES = ("path", "wrong", "devices", *(_COLUMNS.get(name, name) for name in TEXTS), "figures")
_AS_BYTES = "IFNULL(CAST({} AS BLOB), x'')"  # also where harm made it no text


def index_file(folder: Path) -> Path:
    """Return where the index of a folder is."""
    name = hashlib.sha256(os.fsencode(folder.resolve())).hexdigest()[:20]
    return state_folder() / "records" / f"{name}-{_VERSION}.sqlite"


def load(folder: Path) -> dict[File, Entry]:
    """Return what the index of a folder holds; nothing if there is none, or none that can be read."""
    found, top, devices = {}, os.path.join(folder, ""), cache(lambda told: tuple(json.loads(told)))
    rows = _done(
        folder, f"SELECT checksum, {', '.join(_NUMBERS)}, {', '.join(map(_AS_BYTES.format, _NAMES))} FROM recordings"
    )
    gc.disable()  # none of ten thousand entries is garbage: to look for it takes a third of the time
    try:
        for checksum, mtime_ns, size, when_utc_s, foreign, *texts, figures in rows or ():
            if checksum == _checksum((mtime_ns, size, when_utc_s, foreign), texts, figures):
                path, wrong, told, *others = b"\0".join(texts).decode(errors="surrogateescape").split("\0")
                about = dict(zip(TEXTS, others, strict=True))
                entry = Entry(top + path, when_utc_s, wrong, bool(foreign), about, devices(told), figures)
                found[entry.file, mtime_ns, size] = entry
    finally:
        gc.enable()
    return found


def keep(folder: Path, entries: Mapping[File, Entry]) -> bool:
    """Add recordings to the index of a folder; return whether it could be written."""
    rows = []
    for (path, *about), entry in entries.items():
        numbers = (*about, entry.when_utc_s, int(entry.foreign))
        told = (os.path.relpath(path, folder), entry.wrong, json.dumps(entry.devices), *map(entry.texts.get, TEXTS))
        texts = [(text or "").encode(errors="surrogateescape") for text in told]
        rows.append([_checksum(numbers, texts, entry.figures), *numbers, *texts, entry.figures])
    names = ", ".join(("checksum", *_NUMBERS, *_NAMES))
    values = "?, " * (1 + len(_NUMBERS)) + ", ".join(["CAST(? AS TEXT)"] * len(_NAMES))
    return _done(folder, f"REPLACE INTO recordings ({names}) VALUES ({values})", rows) is not None


def _checksum(numbers: tuple[Any, ...], texts: Sequence[bytes], figures: bytes) -> int:
    return zlib.crc32(figures, zlib.crc32(b"\0".join(texts), zlib.crc32(repr(numbers).encode())))


def _done(folder: Path, sql: str, rows: Sequence[Sequence[Any]] | None = None) -> list[Any] | None:
    """Return what a statement gives, None if it fails; then an index that is not just busy goes."""
    path = index_file(folder)
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        with closing(sqlite3.connect(path, timeout=_PATIENCE_S)) as index, index:
            index.text_factory = bytes
            index.executescript(packaged_text("station.screen.archive", "index.sql"))
            return (index.execute(sql) if rows is None else index.executemany(sql, rows)).fetchall()
    except (sqlite3.Error, *MISSHAPEN) as error:  # of a damaged one the words of an error may be no text
        if getattr(error, "sqlite_errorcode", None) != sqlite3.SQLITE_BUSY:
            with suppress(OSError):
                path.unlink()
        return None
