"""Where running sessions have their sockets: a folder of this user alone."""

import os
import stat
import tempfile
from contextlib import suppress
from pathlib import Path

from station.errors import UsageError

_LONGEST_PATH = 107  # bytes that a Unix socket's address can hold
_LONGEST_NAME = len("4194304.sock.new")


def socket_folder() -> Path:
    """Return the folder for sockets of this user, made if it is not there; UsageError if none can be had."""
    refused = []
    for folder in _places():
        try:
            with suppress(FileExistsError):
                folder.mkdir(mode=0o700)
            reason = _objection(folder)
        except OSError as error:
            reason = f"{folder}: {error.strerror}"
        if not reason:
            return folder
        refused.append(reason)
    raise UsageError(
        f"no place for a session's socket: {'; '.join(refused) or 'there is no folder for temporary files'}; set "
        "XDG_RUNTIME_DIR to a folder that you can write to"
    )


def socket_folders() -> list[Path]:
    """Return the folders in which sockets of this user's sessions may be."""
    return [folder for folder in _places() if os.path.isdir(folder) and not _objection(folder)]


def _places() -> list[Path]:
    tops = [os.environ.get("XDG_RUNTIME_DIR", "")]
    with suppress(FileNotFoundError):
        tops.append(tempfile.gettempdir())
    return [Path(top) / f"station-{os.getuid()}" for top in dict.fromkeys(tops) if top]


def _objection(folder: Path) -> str:
    """Return why a folder is not to be used: in one of somebody else a stranger could pose as a session."""
    found = folder.lstat()
    if not stat.S_ISDIR(found.st_mode):
        return f"{folder} is no folder"
    if found.st_uid != os.getuid():
        return f"{folder} belongs to somebody else"
    if found.st_mode & 0o077:
        return f"{folder} is open to others (chmod 700 {folder})"
    if not os.access(folder, os.W_OK | os.X_OK):
        return f"{folder} cannot be written to"
    if len(os.fsencode(folder)) + 1 + _LONGEST_NAME > _LONGEST_PATH:
        return f"{folder} is too long a name for a socket"
    return ""
