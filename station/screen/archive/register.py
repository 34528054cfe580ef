"""Registers of documents, so that a number is used for one recording only.

One is of this user on this computer, among what programs remember of a user, as the indexes of recordings are. Unlike
those it cannot be made anew from the recordings, so it is never dropped, and a damaged one is told. The other is a list
beside the recordings. It goes where they go, knows the documents of every user of the folder, and outlives the first.
"""

import json
import os
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path

from station.errors import UsageError
from station.screen.memory import is_of_this_user_alone, state_folder

_PATIENCE_S = 5.0  # for another station, which writes for some milliseconds
LIST = "documents.jsonl"
"""Name of the list beside the recordings: a document a line, as JSON."""
_MOST_BYTES = 1 << 24  # of a list: some 50,000 documents
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
    """An issued document: its number, its recording, its title, the number that it replaces or None."""

    number: str
    data_sha256: str
    recording: str
    title: str
    replaces: str | None = None


def register_file() -> Path:
    """Return where the register is."""
    return state_folder() / "documents.sqlite"


def check_number(number: str, data_sha256: str, folder: Path) -> None:
    """See that no other recording has a document of this number, by the register and the list in ``folder``.

    That is the folder of the recording. Recordings with the same raw data, by ``data_sha256``, count as one. UsageError
    that names the other recording, or that the register cannot be used.
    """
    with _register() as register:
        _check(register, number, data_sha256, folder)


def enter(document: Document) -> None:
    """Enter a document in the register, replacing one with the same number and data, and in the list of its folder.

    UsageError as for ``check_number``. A list that cannot be written to is ignored.
    """
    folder = Path(document.recording).parent
    with _register() as register:
        register.execute("BEGIN IMMEDIATE")
        _check(register, document.number, document.data_sha256, folder)
        register.execute(
            "REPLACE INTO documents VALUES (?, ?, ?, ?, ?)",
            (document.number, document.data_sha256, document.recording, document.title, document.replaces),
        )
        _add(document, folder)


def _check(register: sqlite3.Connection, number: str, data_sha256: str, folder: Path) -> None:
    """Raise UsageError if the number is in use for other data, in the register or in the folder's list."""
    query = "SELECT recording FROM documents WHERE number = ? AND data_sha256 <> ?"
    others = [recording for (recording,) in register.execute(query, (number, data_sha256))]
    others += [one.recording for one in _listed(folder) if one.number == number and one.data_sha256 != data_sha256]
    for recording in others:
        raise UsageError(
            f"certificate.number: {number!r} is the number of the document of {recording}: "
            "give this one a number of its own, or leave it out"
        )


def _listed(folder: Path) -> Iterator[Document]:
    """Yield the documents of the list in a folder; none if there is no list, it is a link, or it cannot be read.

    Damaged lines are skipped, as others may write there, and what is beyond 16 MiB.
    """
    try:
        with open(os.open(folder / LIST, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK), "rb") as file:
            lines = file.read(_MOST_BYTES).splitlines()
    except OSError:
        return
    for line in lines:
        with suppress(ValueError, TypeError, RecursionError):
            yield Document(**json.loads(line))


def _add(document: Document, folder: Path) -> None:
    """Append a document to the list in a folder unless one of its number and data is there.

    Nothing happens if the folder cannot be written to, or the list is a link.
    """
    known = {(one.number, one.data_sha256) for one in _listed(folder)}
    if (document.number, document.data_sha256) in known:
        return
    flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK
    with suppress(OSError), open(os.open(folder / LIST, flags, 0o644), "ab", buffering=0) as file:
        file.write(json.dumps(asdict(document)).encode() + b"\n")


@contextmanager
def _register() -> Iterator[sqlite3.Connection]:
    """Context that opens the user's register of documents, made if missing; changes are undone by an exception.

    UsageError if it cannot be used, also within the context, or others can write to its folder.
    """
    path = register_file()
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        if not is_of_this_user_alone(path.parent):
            raise UsageError(
                f"{path.parent}: other users can write there, so no number can be registered. Run chmod go-w on it"
            )
        with closing(sqlite3.connect(path, timeout=_PATIENCE_S)) as register, register:
            register.execute(_SCHEMA)
            yield register
    except (sqlite3.Error, OSError) as error:
        raise UsageError(
            f"{path}: the register of documents cannot be used ({error}): restore it from a backup, or move it away"
        ) from None
