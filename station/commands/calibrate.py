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
from typing import Any

import numpy as np

from estimator.calibration.calibration_file import write_calibration
from estimator.calibration.error_model import ErrorModel
from estimator.calibration.values import Calibration
from estimator.errors import EstimatorError, RecordingError
from estimator.estimation.calibrate import calibrate
from estimator.estimation.repeatability import Repeatability, repeatability, same_device
from estimator.recordings.reading import read_attributes, read_recording
from station.bench.bench import Limits, load_bench, read_excluded, read_limits
from station.campaigns.campaigns import run_all
from station.errors import UsageError
from station.render import printing
from station.render.terminal import print_rendered, stdout
from station.run.outcome import Outcome, Verdict, ended_of, judge_recorded

_IN_FULL = 5  # more recordings than this are printed a line each: a person compares them
_ESTIMATED = (Outcome.PASS, Outcome.ESTIMATED)  # of their runs there was an estimate
_KEPT = ("device", "devices", "script", "seed", "clock_zero_utc_s", "outcome", "reason")

_Rules = tuple[Limits, frozenset[str] | None]  # limits, and effects that are ruled out


@dataclass(frozen=True, slots=True, eq=False)
class Estimated:
    """What one recording says, without its samples.

    ``attributes`` are those of the recording that tell which device was measured, how and when. ``seen`` is the
    largest sigma of all states as a share of what the data sheet promises. ``calibration`` is None, and ``seen`` NaN,
    of a run that ended before there was enough to estimate from.
    """

    calibration: Calibration | None
    verdict: Verdict
    attributes: Mapping[str, Any]
    seen: float


def command_calibrate(arguments: argparse.Namespace) -> int:
    """Estimate the gyros of each recording; the worst exit code of all."""
    names = recordings_of(arguments.recordings)
    bench = load_bench(Path(arguments.bench)) if arguments.bench else None
    model = ErrorModel.read(Path(arguments.model)) if arguments.model else None
    results, failures = run_all(
        partial(estimate, limits=(bench.limits, bench.excluded) if bench else None, write=arguments.write, model=model),
        [str(Path(name).absolute()) for name in names] if arguments.scheduler else names,
        label="calibrating",
        scheduler=arguments.scheduler,
        workers=arguments.jobs,
        quiet=arguments.json or len(names) == 1,
    )
    reasons = iter(failure.reason for failure in failures)  # in the order of the recordings, as the gaps are
    ends = [(name, next(reasons) if found is None else found) for name, found in zip(names, results, strict=True)]
    return _print_json(ends) if arguments.json else _print(ends)


def recordings_of(arguments: Sequence[str]) -> list[str]:
    """Return the recordings that are meant, each once: a folder means every .h5 in it and below, by name.

    Raises UsageError for a folder without any.
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


def estimate(name: str, *, limits: _Rules | None, write: bool, model: ErrorModel | None = None) -> Estimated:
    """Estimate the gyros of one recording and judge them, by the rules of its own bench file unless some are given.

    ``model``: effects to estimate beside the states.

    Raises EstimatorError or UsageError for a recording that cannot be used, or not be written into.
    """
    try:
        recording = read_recording(Path(name))
    except EstimatorError as error:
        return _without_estimate(read_attributes(Path(name)), error)
    text, plugins = str(recording.attributes.get("bench", "")), recording.attributes.get("plugins", ())
    least, excluded = limits or (read_limits(text), read_excluded(text, plugins))
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
            raise RecordingError(f"{name} cannot be written into: {error}") from None
    promised = {name: np.sqrt(data.prior.variances()) for name, data in recording.sources.items()}
    seen = max(float((gyro.sd / promised[gyro.source]).max()) for gyro in calibration.gyros)
    return Estimated(calibration, verdict, attributes, seen)


def _without_estimate(attributes: Mapping[str, Any], error: EstimatorError) -> Estimated:
    """Return how the run of a recording ended that cannot be estimated; raise the error if that does not explain it."""
    ended = ended_of(attributes)
    if ended is None or ended.outcome in _ESTIMATED:
        raise error
    if ended.outcome is not Outcome.MANUAL:
        ended = replace(ended, reason=f"{ended.reason}; it cannot be estimated: {error}")
    kept = {key: attributes[key] for key in _KEPT if key in attributes}
    return Estimated(None, judge_recorded(None, None, ended), kept, math.nan)


def _print_json(ends: Sequence[tuple[str, Estimated | str]]) -> int:
    worst = 0
    devices = {runs[-1][0]: runs for runs in _devices(ends) if len(runs) > 1}
    for name, end in ends:
        if isinstance(end, str):
            worst = max(worst, printing.refuse(end, True, recording=name))
        else:
            result = printing.result_object(end.verdict, name, end.calibration)
            if name in devices:  # the last run of a device carries how it repeats
                result["repeatability"] = printing.repeatability_object(_repeats(devices[name]))
            print(json.dumps(result))
            worst = max(worst, end.verdict.outcome.exit_code)
    return worst


def _print(ends: Sequence[tuple[str, Estimated | str]]) -> int:
    judged = [(name, end) for name, end in ends if isinstance(end, Estimated)]
    if len(ends) > _IN_FULL:
        folder = os.path.commonpath([Path(name).absolute().parent for name, _ in ends])
        _print_overview(judged, folder)
        counts = Counter(str(end.verdict.outcome) for _, end in judged)
        counts["not estimated"] = len(ends) - len(judged)
        print(f"{len(ends)} recordings: " + ", ".join(f"{count} {what}" for what, count in counts.items() if count))
    else:
        for name, end in judged:
            printing.print_calibration(end.calibration, end.verdict)
            printing.print_verdict(end.verdict, Path(name))
    devices = _devices(ends)
    for runs in devices:
        if len(runs) > 1:
            printing.print_repeatability(_repeats(runs), runs[0][1].calibration.gyros[0].device)
    if len(devices) > 1:
        kinds = "; ".join(", ".join(g.name for g in runs[0][1].calibration.gyros) for runs in devices)
        print(f"note: {len(devices)} different devices or arrays ({kinds}): runs are compared within each only")
    worst = max((end.verdict.outcome.exit_code for _, end in judged), default=0)
    sys.stdout.flush()  # what failed comes last, wherever the two streams lead
    failed = [(name, reason) for name, reason in ends if isinstance(reason, str)]
    named = [reason if Path(name).name in reason else f"{name}: {reason}" for name, reason in failed]
    return max([worst, *(printing.refuse(reason, False) for reason in named)])


def _devices(ends: Sequence[tuple[str, Estimated | str]]) -> list[list[tuple[str, Estimated]]]:
    """Return the estimated recordings by device: the same name if it has one, the same gyros along the same axes."""
    groups: list[list[tuple[str, Estimated]]] = []
    for name, end in ends:
        if isinstance(end, str):
            continue
        gyros = end.calibration.gyros
        for group in groups:
            other = group[0][1].calibration.gyros
            if other[0].device == gyros[0].device and same_device(other, gyros):
                group.append((name, end))
                break
        else:
            groups.append([(name, end)])
    return groups


def _repeats(runs: Sequence[tuple[str, Estimated]]) -> list[Repeatability]:
    return repeatability([end.calibration.gyros for _, end in runs])


def _print_overview(judged: Sequence[tuple[str, Estimated]], folder: str) -> None:
    """Print one line a recording: what it is of, how it was judged, how well it shows its states, how true it is."""
    lines = []
    for name, end in judged:
        carried = [str(device).partition(" (")[0] for device in end.attributes.get("devices", ())]
        sources = dict.fromkeys(gyro.source for gyro in end.calibration.gyros)
        device = str(end.attributes.get("device", "")) or ", ".join(carried or sources)
        lines.append((os.path.relpath(name, folder), device, str(end.attributes.get("script", "")), end))
    print_rendered(stdout(), "station.render", "overview.rich", {"lines": lines, "folder": folder})
