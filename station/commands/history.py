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

import numpy as np

from estimator.calibration.calibration_file import read_calibration
from estimator.calibration.values import Calibration
from estimator.estimation.control_charts import control_chart
from estimator.untrusted import harmless
from station.errors import UsageError
from station.render.archive.charts import history_shown
from station.render.archive.comma_separated import csv_text
from station.render.archive.gauge import gauge_shown
from station.render.archive.recordings import recordings_shown
from station.render.lines import tell
from station.render.progress import TracingProgress
from station.render.terminal import print_all, stdout
from station.screen.archive.archive import Archive
from station.screen.archive.entries import Entry, comparable, moves
from station.screen.archive.validity import validity_on
from station.views.figures import OUTCOME_STYLES
from station.views.history import (
    ChartView,
    GaugeStudy,
    GaugeView,
    HistoryGyro,
    HistoryRow,
    Move,
    chart_object,
    gauge_object,
    row_object,
)
from station.views.json_values import by_state

_MOST_ROWS = 50  # for a person
_TEXTS = {"device_serial": "serial", "station": "bench"} | {
    key: key for key in ("script", "outcome", "reason", "operator", "accepted_by", "accepted_utc")
}


def command_history(arguments: argparse.Namespace) -> int:
    """List the recordings of a folder, newest first, with charts of a device, or print a gauge study.

    Return 0; with --valid-on 1 if no calibration was valid on that day. Without --last a person gets 50 recordings,
    --json and --csv all. There are charts with --serial only, of two or more comparable runs that did not fail.
    UsageError for wrong options and a folder that cannot be read.
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
    if arguments.gauge:
        _print_gauge(folder, comparable(entries[: arguments.last], 2), as_json=arguments.json)
        return 0
    charts = [_chart(runs) for runs in charted if sum(not run.failed for run in runs) > 1]
    if arguments.json:
        recordings = [row_object(row) for row in rows]
        found = {"folder": str(folder), "found": len(entries), "recordings": recordings}
        print(json.dumps({**found, "charts": [chart_object(chart) for chart in charts]}))
    elif arguments.csv:
        print(harmless(csv_text(rows)), end="")
    else:
        console = stdout()
        print_all(console, recordings_shown(rows, console))
        print_all(console, history_shown(str(folder), rows, len(entries), arguments.serial, charts))
    return 0


def _print_gauge(folder: Path, series: Sequence[Sequence[Entry]], *, as_json: bool) -> None:
    """Print a gauge study of each series of comparable runs."""
    studies = [_study(runs) for runs in series]
    if as_json:
        print(json.dumps({"folder": str(folder), "gauge": [gauge_object(study) for study in studies]}))
    else:
        print_all(stdout(), gauge_shown(str(folder), studies))


def calibration_valid_on(serial: str, day: date, folder: Path | str = "recordings") -> Calibration:
    """Return the calibration of a device that was valid on ``day``, from the recordings of a folder.

    UsageError with the reason if there was none. The rule is that of ``archive.validity``. Call it outside an event
    loop.
    """
    found = validity_on(asyncio.run(_listed(Path(folder), True)), serial, day)
    if found.reason or found.entry is None:
        raise UsageError(found.reason)
    return read_calibration(found.entry.path)


def _print_valid(arguments: argparse.Namespace, folder: Path) -> int:
    """Print which calibration of a device was valid on a day; return 0 if there was one, else 1.

    UsageError without --serial, with options that do not go together, or for a day that is no date.
    """
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
        print(json.dumps({**result, "recording": row and row_object(row)}))
    elif found.entry is not None and valid:
        tell(harmless(f"{recording}: measured {found.entry.when}, valid for {arguments.serial} on {day}"))
    else:
        tell(harmless(f"none: {found.reason}"))
    return 0 if valid else 1


async def _listed(folder: Path, quiet: bool) -> list[Entry]:
    """Return the recordings of a folder and its subfolders, newest first, unreadable ones included.

    Progress is shown while new ones are read, unless ``quiet``.
    """
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


def _chart(runs: Sequence[Entry]) -> ChartView:
    """Return control charts of runs of one script on one bench, at least one run, in the order given.

    Failed runs set no limits. Units are those of the last run.
    """
    counted = [not run.failed for run in runs]
    return ChartView(
        bench=runs[0].texts["station"],
        script=runs[0].texts["script"],
        counted=counted,
        gyros=[gyro.full_name for gyro in runs[0].gyros],
        files=[run.path.name for run in runs],
        when=[run.when for run in runs],
        units=runs[-1].units,
        chart=control_chart([[gyro.values for gyro in run.gyros] for run in runs], counted),
    )


def _study(runs: Sequence[Entry]) -> GaugeView:
    """Return a gauge study of comparable runs, at least one.

    Its figures are None unless two devices have each been measured more than once by the same operator at the same
    station.
    """
    conditions = [(run.texts.get("operator", ""), run.texts.get("station", "")) for run in runs]
    times = Counter(zip((run.serial for run in runs), conditions, strict=True))
    repeated = {serial for (serial, _), number in times.items() if number > 1}
    return GaugeView(
        script=runs[0].texts.get("script", ""),
        gyros=[gyro.full_name for gyro in runs[0].gyros],
        operators=sorted({operator for operator, _ in conditions}),
        benches=sorted({bench for _, bench in conditions}),
        devices=len({run.serial for run in runs}),
        runs=len(runs),
        failed=sum(run.failed for run in runs),
        repeated=len(repeated),
        units=runs[-1].units,
        study=_gauge_study(runs, conditions) if len(repeated) > 1 else None,
    )


def _gauge_study(runs: Sequence[Entry], conditions: Sequence[tuple[str, str]]) -> GaugeStudy:
    """Return the figures of a gauge study; ``conditions`` are operator and bench of each run."""
    from estimator.estimation.repeatability import gauge_study  # takes longer than ten thousand recordings to list

    each = [(run, gyro, str(condition)) for run, condition in zip(runs, conditions, strict=True) for gyro in run.gyros]
    values = np.array([gyro.values for _, gyro, _ in each], float)
    sds = np.array([gyro.sds for _, gyro, _ in each], float)
    parts = [str((run.serial, gyro.source, gyro.name)) for run, gyro, _ in each]
    figures = gauge_study(values, sds, parts, [condition for *_, condition in each])
    return GaugeStudy(**{key: by_state(value) for key, value in figures.items()})


def _row(entry: Entry, folder: Path, moved: Sequence[Move]) -> HistoryRow:
    """Return an entry as a row for printing, its path relative to ``folder``.

    ``moved`` are its states that moved since the run before.
    """
    return HistoryRow(
        when=entry.when,
        **{name: entry.texts.get(key, "") for key, name in _TEXTS.items()},
        file=os.path.relpath(entry.path, folder),
        wrong=entry.wrong,
        device=entry.device,
        when_utc_s=entry.when_utc_s,
        nis_mean=entry.nis_mean,
        moved=moved,
        gyros=[
            HistoryGyro(name=gyro.full_name, values=by_state(gyro.values), sds=by_state(gyro.sds))
            for gyro in entry.gyros
        ],
    )
