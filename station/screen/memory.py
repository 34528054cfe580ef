"""What the screen remembers from one day to the next: the operator and when that was confirmed, files, the theme."""

import json
import os
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
    """What was entered last; ``operator_utc_s`` is when the operator was, in seconds since 1970."""

    operator: str = ""
    bench: str = ""
    script: str = ""
    operator_utc_s: float = 0.0
    theme: str = ""


def state_folder() -> Path:
    """Return the folder for what programs remember (XDG base directories)."""
    given = os.environ.get("XDG_STATE_HOME", "")
    return (Path(given) if given.startswith("/") else Path.home() / ".local" / "state") / _FOLDER


def load_remembered() -> Remembered:
    """Return what is remembered; nothing if the file is missing or no such file."""
    try:
        found: Any = json.loads(harmless(read_text(state_folder() / _FILE, UsageError)))
        texts = {key: str(found.get(key, "")) for key in REMEMBERED}
        return Remembered(
            **texts, operator_utc_s=float(found.get("operator_utc_s", 0.0)), theme=str(found.get("theme", ""))
        )
    except (UsageError, *MISSHAPEN):
        return Remembered()


def save_remembered(remembered: Remembered) -> None:
    """Keep it; a folder that cannot be written is no reason to stop a calibration."""
    with suppress(UsageError):
        write_whole(state_folder() / _FILE, json.dumps(asdict(remembered), indent=1), replace=True)
