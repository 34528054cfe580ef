"""What the screen remembers from one day to the next: the operator, the devices on each bench, bench and script."""

import json
import os
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from estimator.errors import MISSHAPEN
from estimator.untrusted import harmless, read_text
from station.atomic_write import write_whole
from station.errors import UsageError

_FOLDER = "turntable-station"
_FILE = "screen.json"
_MOST_BENCHES = 50
REMEMBERED = ("operator", "bench", "script")
"""What is remembered beside serial numbers."""


@dataclass(frozen=True, slots=True)
class Remembered:
    """What was entered last; ``serials`` by bench."""

    operator: str = ""
    bench: str = ""
    script: str = ""
    serials: Mapping[str, str] = field(default_factory=dict)


def state_folder() -> Path:
    """Return the folder for what programs remember (XDG base directories)."""
    given = os.environ.get("XDG_STATE_HOME", "")
    return (Path(given) if given.startswith("/") else Path.home() / ".local" / "state") / _FOLDER


def load_remembered() -> Remembered:
    """Return what is remembered; nothing if the file is missing or no such file."""
    try:
        found: Any = json.loads(harmless(read_text(state_folder() / _FILE, UsageError)))
        serials = {str(bench): str(serial) for bench, serial in dict(found.get("serials", {})).items()}
        return Remembered(**{key: str(found.get(key, "")) for key in REMEMBERED}, serials=serials)
    except (UsageError, *MISSHAPEN):
        return Remembered()


def save_remembered(remembered: Remembered) -> None:
    """Keep it, the latest 50 benches; a folder that cannot be written is no reason to stop a calibration."""
    kept = asdict(remembered) | {"serials": dict(list(remembered.serials.items())[-_MOST_BENCHES:])}
    with suppress(UsageError):
        write_whole(state_folder() / _FILE, json.dumps(kept, indent=1), replace=True)
