"""station history: the recordings of a folder, control charts of a device, and a gauge study of the station."""

import argparse
import asyncio
import json
import os
import re
from collections import Counter
from collections.abc import Sequence
from contextlib import ExitStack
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np

from estimator.calibration.calibration_file import read_calibration
from estimator.calibration.values import Calibration
from estimator.estimation.control_charts import control_chart
from estimator.geometry.model import STATES
from estimator.untrusted import harmless
from station.errors import UsageError
from station.render.history_printed import recordings_shown
from station.render.lines import tell
from station.render.progress import TracingProgress
from station.render.template import rendered
from station.render.terminal import print_all, print_rendered, stdout
from station.screen.archive.archive import Archive
from station.screen.archive.entries import Entry, comparable, moves
from station.screen.archive.validity import validity_on
from station.views.figures import OUTCOME_STYLES, figures_from
from station.views.json_values import by_state, json_object

_MOST_ROWS = 50  # for a person
_TEXTS = {"device_serial": "serial", "station": "bench"} | {
    key: key for key in ("script", "outcome", "reason", "operator", "accepted_by", "accepted_utc")
}


def command_history(arguments: argparse.Namespace) -> int:
    """List the recordings of a folder, newest first, with charts of a device, or print a gauge study.

    Return 0; with --valid-on 1 if no calibration was valid on that day. UsageError for wrong options.
    """
    folder, data, since = Path(arguments.folder), arguments.json or arguments.csv, arguments.since or ""
    outcome = arguments.outcome and arguments.outcome.upper()
    try:
        os.scandir(folder).close()
    except OSError as error:
        raise UsageError(f"{folder}: {error.strerror}. Name the folder that holds the recordings") from None
    if not re.fullmatch(r"(\d{4}(-\d\d){0,2})?", since, re.ASCII):
        raise UsageError(f"--since {since}: write a date, for instance 2026-11 or 2026-11-21")
    if outcome not in (None, *OUTCOME_STYLES):
        raise UsageError(f"--outcome {outcome}: write one of {', '.join(OUTCOME_STYLES)}")
    if arguments.gauge and arguments.csv:
        raise UsageError("--gauge with --csv: a study has no line per recording. Use --json instead of --csv")
    if arguments.valid_on is not None:
        return _print_valid(arguments, folder)
    every = asyncio.run(_listed(folder, data))
    wanted = {"device_serial": arguments.serial, "station": arguments.bench, "outcome": outcome}
    wanted = {key: value for key, value in wanted.items() if value is not None}
    entries = [e for e in every if wanted.items() <= e.texts.items() and (not since or e.when >= since)]
    shown = entries[: arguments.last or (len(entries) if data else _MOST_ROWS)]
    serials = set() if arguments.gauge else {entry.serial for entry in shown}  # ten thousand figures take a while
    moved = moves(entry for entry in every if entry.serial in serials)
    charted = comparable(entries) if arguments.serial else []
    rows = [_row(entry, folder, moved.get(entry.file, [])) for entry in shown]
    found = {
        "folder": str(folder),
        "found": len(entries),
        "recordings": rows,
        "charts": [_chart(runs) for runs in charted if sum(not run.failed for run in runs) > 1],
    }
    if arguments.gauge:
        found = {"folder": str(folder), "gauge": [_study(runs) for runs in comparable(entries[: arguments.last], 2)]}
    if arguments.json:
        print(json.dumps(found))
    elif arguments.csv:
        print(harmless(rendered("station.render", "history.csv", {**found, "states": STATES})), end="")
    else:
        console = stdout()
        if not arguments.gauge:
            print_all(console, recordings_shown(rows, console))
        name = "gauge.rich" if arguments.gauge else "history.rich"
        print_rendered(
            console,
            "station.render",
            name,
            {**found, "serial": arguments.serial, "states": STATES, "figures_in": figures_from},
        )
    return 0


def calibration_valid_on(serial: str, day: date, folder: Path | str = "recordings") -> Calibration:
    """Return the calibration of a device that was valid on ``day``, from the recordings of a folder.

    UsageError with the reason if there was none. The rule is that of ``archive.validity``.
    """
    found = validity_on(asyncio.run(_listed(Path(folder), True)), serial, day)
    if found.reason or found.entry is None:
        raise UsageError(found.reason)
    return read_calibration(found.entry.path)


def _print_valid(arguments: argparse.Namespace, folder: Path) -> int:
    """Print which calibration of a device was valid on a day; return 0 if there was one, else 1."""
    if arguments.serial is None or arguments.csv or arguments.gauge:
        raise UsageError("--valid-on needs --serial, and cannot be combined with --csv or --gauge")
    try:
        day = date.fromisoformat(arguments.valid_on)
    except ValueError:
        raise UsageError(f"--valid-on {arguments.valid_on}: write a date, for instance 2026-11-21") from None
    found = validity_on(asyncio.run(_listed(folder, arguments.json)), arguments.serial, day)
    recording = None if found.entry is None else str(found.entry.path)
    valid = found.entry is not None and not found.reason
    if arguments.json:
        row = None if found.entry is None else _row(found.entry, folder, [])
        result = {"serial": arguments.serial, "day": day.isoformat(), "valid": valid, "reason": found.reason or None}
        print(json.dumps({**result, "recording": row}))
    elif found.entry is not None and valid:
        tell(harmless(f"{recording}: measured {found.entry.when}, valid for {arguments.serial} on {day}"))
    else:
        tell(harmless(f"none: {found.reason}"))
    return 0 if valid else 1


async def _listed(folder: Path, quiet: bool) -> list[Entry]:
    """Return the recordings of a folder, newest first; progress is shown while new ones are read, unless ``quiet``."""
    archive, found, bar = Archive(), [], None
    with ExitStack() as stack:
        async for entry in archive.entries(folder):
            found.append(entry)
            if archive.unread:
                bar = bar or stack.enter_context(TracingProgress(quiet, transient=True))
                left = archive.unread
                bar.show(len(found) / (len(found) + left), f"reading {folder}: {left} left")
    await archive.close()
    return sorted(found, key=lambda entry: entry.when_utc_s, reverse=True)


def _chart(runs: Sequence[Entry]) -> dict[str, Any]:
    """Return control charts of runs in SI: values and which are outside (runs, gyros, 4). Failed runs set no limits."""
    counted = [not run.failed for run in runs]
    chart = control_chart([[gyro.values for gyro in run.gyros] for run in runs], counted)
    common = {"bench": runs[0].texts["station"], "script": runs[0].texts["script"], "counted": counted}
    names = {"gyros": [gyro.full_name for gyro in runs[0].gyros], "files": [run.path.name for run in runs]}
    return {**common, **names, "when": [run.when for run in runs], "units": runs[-1].units, **json_object(chart)}


def _study(runs: Sequence[Entry]) -> dict[str, Any]:
    """Return a gauge study of comparable runs, by state in SI; "study" is None unless two devices were measured
    repeatedly.
    """
    from estimator.estimation.repeatability import gauge_study  # takes longer than ten thousand recordings to list

    conditions = [(run.texts.get("operator", ""), run.texts.get("station", "")) for run in runs]
    times = Counter(zip((run.serial for run in runs), conditions, strict=True))
    repeated = {serial for (serial, _), number in times.items() if number > 1}
    each = [(run, gyro, str(condition)) for run, condition in zip(runs, conditions, strict=True) for gyro in run.gyros]
    study = None
    if len(repeated) > 1:
        values, sd = (np.array([getattr(gyro, key) for _, gyro, _ in each], float) for key in ("values", "sds"))
        parts = [str((run.serial, gyro.source, gyro.name)) for run, gyro, _ in each]
        figures = gauge_study(values, sd, parts, [condition for *_, condition in each])
        study = {key: by_state(value) for key, value in figures.items()}
    operators, benches = (sorted(set(names)) for names in zip(*conditions, strict=True))
    of = {"operators": operators, "benches": benches, "devices": len({run.serial for run in runs})}
    counts = {"runs": len(runs), "failed": sum(run.failed for run in runs), "repeated": len(repeated)}
    names = {"script": runs[0].texts.get("script", ""), "gyros": [gyro.full_name for gyro in runs[0].gyros]}
    return {**names, **of, **counts, "units": runs[-1].units, "study": study}


def _row(entry: Entry, folder: Path, moved: Sequence[dict[str, Any]]) -> dict[str, Any]:
    row: dict[str, Any] = {name: entry.texts.get(key, "") for key, name in _TEXTS.items()}
    row |= {"file": os.path.relpath(entry.path, folder), "wrong": entry.wrong, "device": entry.device}
    gyros = [{"name": g.full_name, **by_state(g.values), "sd": by_state(g.sds)} for g in entry.gyros]
    figures = {"nis_mean": entry.nis_mean, "moved": moved, "gyros": gyros}
    return {"when": entry.when, **row, "when_utc_s": entry.when_utc_s, **figures}
