"""Register of the documents that this user issued on this computer, so that a number is used for one recording only.

It is kept among what programs remember of this user, as the indexes of recordings are. Unlike those it cannot be made
anew from the recordings, so it is never dropped, and a damaged one is told.
"""

import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path

from station.errors import UsageError
from station.screen.memory import is_of_this_user_alone, state_folder

_PATIENCE_S = 5.0  # for another station, which writes for some milliseconds
_SCHEMA = """
CREATE TABLE IF NOT EXISTS documents (
    number TEXT PRIMARY KEY,
    data_sha256 TEXT NOT NULL,  -- of the raw data of the recording
    recording TEXT NOT NULL,
    title TEXT NOT NULL,
    replaces TEXT
)
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Document:
    """A document by its number: of which recording it is, what it is called, the number that it replaces or None."""

    number: str
    data_sha256: str
    recording: str
    title: str
    replaces: str | None = None


def register_file() -> Path:
    """Return where the register is."""
    return state_folder() / "documents.sqlite"


def check_number(number: str, data_sha256: str) -> None:
    """See that no other recording has a document of this number.

    Raises UsageError that names the other recording, or that the register cannot be read.
    """
    with _register() as register:
        _check(register, number, data_sha256)


def enter(document: Document) -> None:
    """Enter a document, in place of an earlier one of the same number and recording; UsageError as ``check_number``."""
    with _register() as register:
        register.execute("BEGIN IMMEDIATE")
        _check(register, document.number, document.data_sha256)
        register.execute(
            "REPLACE INTO documents VALUES (?, ?, ?, ?, ?)",
            (document.number, document.data_sha256, document.recording, document.title, document.replaces),
        )


def _check(register: sqlite3.Connection, number: str, data_sha256: str) -> None:
    query = "SELECT recording FROM documents WHERE number = ? AND data_sha256 <> ?"
    for (recording,) in register.execute(query, (number, data_sha256)):
        raise UsageError(
            f"certificate.number: {number!r} is the number of the document of {recording}: "
            "give this one a number of its own, or leave it out"
        )


@contextmanager
def _register() -> Iterator[sqlite3.Connection]:
    path = register_file()
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        if not is_of_this_user_alone(path.parent):
            raise UsageError(f"{path.parent}: other users can write there, so no number can be kept: chmod go-w it")
        with closing(sqlite3.connect(path, timeout=_PATIENCE_S)) as register, register:
            register.execute(_SCHEMA)
            yield register
    except (sqlite3.Error, OSError) as error:
        raise UsageError(
            f"{path}: the register of documents cannot be used ({error}): restore it from a backup, or move it away"
        ) from None
