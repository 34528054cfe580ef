"""State that the screen stores: the operator and when that was confirmed, files, the theme."""

import json
import os
import stat
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from estimator.errors import MISSHAPEN
from estimator.untrusted import harmless, read_text
from station.atomic_write import write_whole
from station.errors import UsageError

_FOLDER = "turntable-station"
_FILE = "screen.json"
REMEMBERED = ("operator", "bench", "script")
"""What is remembered of the fields: the number of a device is not, the next device has another."""


@dataclass(frozen=True, slots=True)
class Remembered:
    """The values entered last; ``operator_utc_s`` is when the operator was entered, in seconds since 1970."""

    operator: str = ""
    bench: str = ""
    script: str = ""
    operator_utc_s: float = 0.0
    theme: str = ""


def state_folder() -> Path:
    """Return the folder for stored state of programs (XDG base directories)."""
    given = os.environ.get("XDG_STATE_HOME", "")
    return (Path(given) if given.startswith("/") else Path.home() / ".local" / "state") / _FOLDER


def is_of_this_user_alone(folder: Path) -> bool:
    """Return whether only this user and root can change a folder's content; OSError if it cannot be examined."""
    if os.name != "posix":
        return True
    found = folder.lstat()
    return stat.S_ISDIR(found.st_mode) and found.st_uid == os.geteuid() and not found.st_mode & 0o022


def whole(path: str) -> str:
    """Return the absolute path of a file, empty for none."""
    return str(Path(path).absolute()) if path else ""


def load_remembered() -> Remembered:
    """Return the stored entries; empty ones if the file is missing or invalid."""
    found = load_state(_FILE)
    texts = {key: str(found.get(key, "")) for key in (*REMEMBERED, "theme")}
    with suppress(*MISSHAPEN):
        return Remembered(**texts, operator_utc_s=float(found.get("operator_utc_s", 0.0)))
    return Remembered()


def save_remembered(remembered: Remembered) -> None:
    save_state(_FILE, asdict(remembered))


def load_state(file: str) -> dict[str, Any]:
    """Return the content of a file in the state folder; empty if it is missing or invalid."""
    with suppress(UsageError, *MISSHAPEN):
        return dict(json.loads(harmless(read_text(state_folder() / file, UsageError))))
    return {}


def save_state(file: str, state: Mapping[str, Any]) -> str:
    """Keep it; a folder that cannot be written is no reason to stop a calibration, and is returned in words."""
    try:
        write_whole(state_folder() / file, json.dumps(state, indent=1), replace=True)
    except UsageError as error:
        return str(error)
    return ""
