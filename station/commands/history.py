"""station history: the recordings of a folder."""

import argparse
import asyncio
import json
import os
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from estimator.geometry.model import STATES
from station.errors import UsageError
from station.render.progress import TracingProgress
from station.render.template import rendered
from station.render.terminal import print_rendered, stdout
from station.run.snapshot import GyroSnapshot
from station.screen.archive.archive import Archive
from station.screen.archive.entries import Entry
from station.views.figures import OUTCOME_STYLES
from station.views.json_values import by_state

_MOST_ROWS = 50  # for a person
_TEXTS = {"device_serial": "serial", "station": "bench"} | {
    key: key for key in ("script", "outcome", "reason", "operator", "accepted_by", "accepted_utc")
}


def command_history(arguments: argparse.Namespace) -> int:
    """List the recordings of a folder, the newest first; always 0."""
    folder, data, since = Path(arguments.folder), arguments.json or arguments.csv, arguments.since or ""
    outcome = arguments.outcome and arguments.outcome.upper()
    if not folder.is_dir():
        raise UsageError(f"{folder} is no folder: name the one that holds the recordings")
    if not f"{since}0000"[:4].isdigit():
        raise UsageError(f"--since {since}: write a date, for instance 2026-11 or 2026-11-21")
    if outcome not in (None, *OUTCOME_STYLES):
        raise UsageError(f"--outcome {outcome}: write one of {', '.join(OUTCOME_STYLES)}")
    entries = asyncio.run(_listed(folder, data))
    wanted = {"device_serial": arguments.serial, "station": arguments.bench, "outcome": outcome}
    wanted = {key: value for key, value in wanted.items() if value is not None}
    entries = [entry for entry in entries if entry.when >= since and wanted.items() <= entry.texts.items()]
    shown = entries[: arguments.last or (len(entries) if data else _MOST_ROWS)]
    found = {
        "folder": str(folder),
        "found": len(entries),
        "recordings": [_row(entry, folder) for entry in shown],
    }
    if arguments.json:
        print(json.dumps(found))
    elif arguments.csv:
        print(rendered("station.render", "history.csv", {**found, "states": STATES}), end="")
    else:
        print_rendered(stdout(), "station.render", "history.rich", found)
    return 0


async def _listed(folder: Path, quiet: bool) -> list[Entry]:
    """Return the recordings of a folder, the newest first; with progress while some are read."""
    archive, found, bar = Archive(), [], None
    with ExitStack() as stack:
        async for entry in archive.entries(folder):
            found.append(entry)
            if archive.unread:
                bar = bar or stack.enter_context(TracingProgress(quiet))
                left = archive.unread
                bar.show(len(found) / (len(found) + left), f"reading {folder}: {left} left")
    await archive.close()
    return sorted(found, key=lambda entry: entry.when_utc_s, reverse=True)


def _row(entry: Entry, folder: Path) -> dict[str, Any]:
    told = {name: entry.texts.get(key, "") for key, name in _TEXTS.items()}
    told |= {"file": os.path.relpath(entry.path, folder), "wrong": entry.wrong, "device": entry.device}
    gyros = [{"name": _name(g), **by_state(g.values), "sd": by_state(g.sds)} for g in entry.gyros]
    return {"when": entry.when, **told, "when_utc_s": entry.when_utc_s, "gyros": gyros}


def _name(gyro: GyroSnapshot) -> str:
    return " ".join(dict.fromkeys((gyro.source, gyro.name)))  # two devices may have gyros of one name
