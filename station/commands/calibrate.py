"""station calibrate: estimates from recordings that are there, one or an archive of them."""

import argparse
import json
import math
import os
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from estimator.calibration.calibration_file import write_calibration
from estimator.calibration.error_model import ErrorModel
from estimator.calibration.values import Calibration
from estimator.errors import EstimatorError, RecordingError
from estimator.estimation.calibrate import calibrate
from estimator.estimation.repeatability import Repeatability, repeatability
from estimator.recordings.reading import file_format, read_attributes, read_recording
from estimator.recordings.recording import FORMAT
from estimator.untrusted import harmless
from station.bench.bench import Limits, excluded_by_file, load_bench, read_excluded, read_limits
from station.bench.units import USUAL, Units
from station.campaigns.campaigns import run_all
from station.commands.joined import command_join
from station.errors import UsageError
from station.render import printing
from station.render.lines import tell
from station.render.results.overview import OverviewRow, print_overview, tell_compared
from station.render.results.repeatability import print_repeatability, repeatability_object
from station.run.outcome import Outcome, Verdict, ended_of, judge_recorded
from station.screen.archive.entries import series_of

_IN_FULL = 5  # more recordings than this are printed a line each: a person compares them
_ESTIMATED = (Outcome.PASS, Outcome.ESTIMATED)  # of their runs there was an estimate
_KEPT = ("device", "devices", "device_serial", "station", "script", "seed", "clock_zero_utc_s", "outcome", "reason")
_OURS = "turntable-"
"""What the formats of the station's own files begin with."""

End: TypeAlias = "tuple[str, Estimated | str]"
"""Name of a recording, and what it came to, or why it came to nothing."""
_MOST_SKIPPED = 3  # named
_Rules = tuple[Limits, frozenset[str] | None]  # limits, and effects that are ruled out


@dataclass(frozen=True, slots=True, eq=False)
class Estimated:
    """The result of one recording, without its samples.

    ``attributes`` are those of the recording that identify the device, the script and the time. ``seen`` is the largest
    sigma of all states relative to the data sheet; ``units`` are those to show states in. For a run that ended too
    early for an estimate, ``calibration`` is None and ``seen`` NaN.
    """

    calibration: Calibration | None
    verdict: Verdict
    attributes: Mapping[str, Any]
    seen: float
    units: Units = USUAL


@dataclass(frozen=True, slots=True)
class OtherFile:
    """A file of the station that is not a recording, such as an investigation; ``reason`` says so."""

    reason: str


def command_calibrate(arguments: argparse.Namespace) -> int:
    """Calibrate each recording, print the results, and return the worst exit code.

    With --join all are calibrated together. A recording that fails does not keep the others. Files of the station that
    are not recordings are skipped if a folder was named, else an error. UsageError for a folder without recordings;
    errors in the files of --bench, --model and --undeclared are raised, too.
    """
    names = recordings_of(arguments.recordings)
    if arguments.join:
        return command_join(arguments, names)
    bench = load_bench(Path(arguments.bench)) if arguments.bench else None
    model = ErrorModel.read(Path(arguments.model)) if arguments.model else None
    results, failures = run_all(
        partial(
            estimate,
            limits=(bench.limits, bench.excluded) if bench else None,
            write=arguments.write,
            model=model,
            undeclared=(excluded_by_file(Path(arguments.undeclared)),) if arguments.undeclared else None,
        ),
        [str(Path(name).absolute()) for name in names] if arguments.scheduler else names,
        label="calibrating",
        scheduler=arguments.scheduler,
        workers=arguments.jobs,
        quiet=arguments.json or len(names) == 1,
    )
    reasons = iter(failure.reason for failure in failures)  # in the order of the recordings, as the gaps are
    folders = [argument for argument in arguments.recordings if Path(argument).is_dir()]
    ends: list[End] = []
    skipped: list[str] = []
    for name, found in zip(names, results, strict=True):
        if not isinstance(found, OtherFile):
            ends.append((name, next(reasons) if found is None else found))
        elif name in arguments.recordings:
            ends.append((name, found.reason))
        else:
            skipped.append(name)
    if arguments.json:
        worst = _print_json(ends)
    else:
        worst = _print(
            ends, in_lines=len(ends) > _IN_FULL or bool(folders and len(ends) > 1), details=arguments.details
        )
    if skipped:
        files = f"{len(skipped)} file{'s' if len(skipped) > 1 else ''}"
        shown = ", ".join(Path(name).name for name in skipped[:_MOST_SKIPPED])
        more = f" and {len(skipped) - _MOST_SKIPPED} more" if len(skipped) > _MOST_SKIPPED else ""
        note = f"skipped {files} of the station that hold{'' if len(skipped) > 1 else 's'} no recording: {shown}{more}"
        tell(harmless(note), sys.stderr if arguments.json else sys.stdout)
    return worst


def recordings_of(arguments: Sequence[str]) -> list[str]:
    """Return the recordings named by ``arguments``, each once; a folder stands for every .h5 in it and below, sorted.

    UsageError for a folder without any. Other names are not checked.
    """
    found: dict[Path, str] = {}  # two processes must not write into one file
    for argument in arguments:
        path = Path(argument)
        inside = sorted(str(p) for p in path.rglob("*.h5") if p.is_file()) if path.is_dir() else [argument]
        if not inside:
            raise UsageError(f"{argument} holds no recording (.h5)")
        for name in inside:
            found.setdefault(Path(name).resolve(), name)
    return list(found.values())


def estimate(
    name: str,
    *,
    limits: _Rules | None,
    write: bool,
    model: ErrorModel | None = None,
    undeclared: tuple[frozenset[str] | None] | None = None,
) -> Estimated | OtherFile:
    """Calibrate the recording ``name`` and judge it, by the limits of its own bench file unless ``limits`` are given.

    ``model`` has effects to estimate with the states. ``undeclared`` holds one value, the effects that a file rules
    out, or None. With ``write`` the calibration is stored in the recording. Another file of the station gives an
    OtherFile.

    A recording that cannot be estimated gives a result without estimate if its run was aborted, in fault, failed or by
    hand; else EstimatorError, as with a model if the recording can be read. UsageError for limits that cannot be read;
    RecordingError if the file cannot be written to.
    """
    try:
        recording = read_recording(Path(name))
    except EstimatorError as error:
        found = file_format(Path(name))
        if found.startswith(_OURS) and found != FORMAT:
            return OtherFile(str(error))
        return _without_estimate(read_attributes(Path(name)), error)
    text, plugins = str(recording.attributes.get("bench", "")), recording.attributes.get("plugins", ())
    # An imported recording carries its mapping in place of a bench, with the same keys for excluded effects.
    declared = text or str(recording.attributes.get("mapping", ""))
    least, excluded = limits or (read_limits(text), read_excluded(declared, plugins))
    excluded = undeclared[0] if undeclared is not None else excluded
    ended = ended_of(recording.attributes)
    try:
        calibration = calibrate(recording, model=model, excluded=excluded)
    except EstimatorError as error:
        if model is not None:
            raise
        return _without_estimate(recording.attributes, error)
    attributes = {key: recording.attributes[key] for key in _KEPT if key in recording.attributes}
    verdict = judge_recorded(calibration, least, ended, own_rules=limits is None and model is None)
    if write:
        try:
            write_calibration(Path(name), calibration)
        except OSError as error:
            raise RecordingError(f"{name} cannot be written to: {error}") from None
    promised = {name: np.sqrt(data.prior.variances()) for name, data in recording.sources.items()}
    seen = max(float((gyro.sd / promised[gyro.source]).max()) for gyro in calibration.gyros)
    return Estimated(calibration, verdict, attributes, seen, least.units)


def _without_estimate(attributes: Mapping[str, Any], error: EstimatorError) -> Estimated:
    """Return the result of a run that ended before it could be estimated.

    ``error`` says why; it is raised if the outcome in ``attributes`` does not explain it: none, PASS or ESTIMATED. Its
    text is added to the recorded reason; that of a run by hand is always the same. Calibration and sigma are missing
    (see ``Estimated``); of the attributes only those of device, script, time and outcome stay.
    """
    ended = ended_of(attributes)
    if ended is None or ended.outcome in _ESTIMATED:
        raise error
    if ended.outcome is not Outcome.MANUAL:
        ended = replace(ended, reason=f"{ended.reason}; no estimate is possible: {error}")
    kept = {key: attributes[key] for key in _KEPT if key in attributes}
    return Estimated(None, judge_recorded(None, None, ended), kept, math.nan)


def _print_json(ends: Sequence[End]) -> int:
    """Print each result as a line of JSON, failures included; return the worst exit code.

    The last run of a device also carries its repeatability.
    """
    worst = 0
    series = {runs[-1][0]: runs for runs in _comparable(ends) if len(runs) > 1}
    for name, end in ends:
        if isinstance(end, str):
            worst = max(worst, printing.refuse(end, True, recording=name))
        else:
            result = printing.result_object(end.verdict, name, end.calibration)
            if name in series:  # the last run of a device carries how it repeats
                result["repeatability"] = repeatability_object(_repeats(series[name]))
            print(json.dumps(result))
            worst = max(worst, end.verdict.outcome.exit_code)
    return worst


def _print(ends: Sequence[End], *, in_lines: bool, details: bool) -> int:
    """Print the results, then repeatability and failures; return the worst exit code.

    Results are printed in full or, ``in_lines``, as an overview with the number of each outcome. Repeated runs are
    those of ``_comparable``; how many of several are compared with none is said, too. Failures go to stderr.
    """
    judged = [(name, end) for name, end in ends if isinstance(end, Estimated)]
    if in_lines:
        folder = os.path.commonpath([Path(name).absolute().parent for name, _ in ends])
        _print_overview(judged, folder)
        counts = Counter(str(end.verdict.outcome) for _, end in judged)
        counts["not estimated"] = len(ends) - len(judged)
        text = ", ".join(f"{count} {outcome}" for outcome, count in counts.items() if count)
        tell(f"{len(ends)} recordings: {text}")
    else:
        for name, end in judged:
            printing.print_result(end.verdict, end.calibration, Path(name), end.units, details=details)
    series = _comparable(ends)
    for runs in series:
        if len(runs) > 1:
            _, first = runs[0]
            device, script = (str(first.attributes.get(key, "")) for key in ("device_serial", "script"))
            print_repeatability(_repeats(runs), device, script, first.units)
    alone = len(judged) - sum(len(runs) for runs in series if len(runs) > 1)
    if alone and len(judged) > 1:
        tell_compared(alone, len(judged))
    worst = max((end.verdict.outcome.exit_code for _, end in judged), default=0)
    sys.stdout.flush()  # failures come last, wherever the two streams lead
    failed = [(name, reason) for name, reason in ends if isinstance(reason, str)]
    named = [reason if Path(name).name in reason else f"{name}: {reason}" for name, reason in failed]
    return max([worst, *(printing.refuse(reason, False) for reason in named)])


def _comparable(ends: Sequence[End]) -> list[list[tuple[str, Estimated]]]:
    """Return groups of runs that may be compared, by the rule of ``station history``; a group may be one run.

    Left out are failures, FAIL, runs without an estimate, and those that nothing may be compared with.
    """
    groups: dict[tuple[object, ...], list[tuple[str, Estimated]]] = {}
    for name, end in ends:
        if isinstance(end, str) or end.calibration is None or end.verdict.outcome is Outcome.FAIL:
            continue
        texts = {key: str(end.attributes.get(key, "")) for key in ("device_serial", "station", "script")}
        gyros = [(gyro.source, gyro.name) for gyro in end.calibration.gyros]
        series = series_of({**texts, "outcome": str(end.verdict.outcome)}, gyros)
        if series is not None:
            groups.setdefault(series, []).append((name, end))
    return list(groups.values())


def _repeats(runs: Sequence[tuple[str, Estimated]]) -> list[Repeatability]:
    return repeatability([end.calibration.gyros for _, end in runs if end.calibration is not None])


def _print_overview(judged: Sequence[tuple[str, Estimated]], folder: str) -> None:
    """Print one line per recording: device, verdict, quality; then the reasons, each with its recordings.

    Paths are relative to ``folder``.
    """
    rows = []
    reasons: dict[str, list[str]] = {}
    for name, end in judged:
        carried = [str(device).partition(" (")[0] for device in end.attributes.get("devices", ())]
        sources = dict.fromkeys(gyro.source for gyro in end.calibration.gyros) if end.calibration is not None else ()
        known = (str(end.attributes.get(key, "")) for key in ("device_serial", "device"))
        device = next(filter(None, known), ", ".join(carried or sources))
        file = os.path.relpath(name, folder)
        rows.append(
            OverviewRow(
                recording=file,
                device=device,
                script=str(end.attributes.get("script", "")),
                outcome=end.verdict.outcome,
                worst_share=end.seen,
                nis_mean=math.nan if end.calibration is None else end.calibration.nis_mean,
            )
        )
        for reason in _reasons(end.verdict):
            reasons.setdefault(reason, []).append(file)
    print_overview(folder, rows, reasons)


def _reasons(verdict: Verdict) -> list[str]:
    """Return why a recording ended as it did, each reason by itself; of limits that are broken how many, and one."""
    if verdict.broken:
        first, *others = (line.broken for line in verdict.broken)
        return [*verdict.because, f"{first}, and {len(others)} more limits exceeded" if others else first]
    reasons = verdict.reason.replace("; but ", "; ").split("; ")
    return reasons[1:] if verdict.outcome in _ESTIMATED else reasons  # the first line is that of every such run
