"""station calibrate --join: one calibration of a device that was mounted otherwise in each of several recordings."""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from estimator.errors import EstimatorError
from estimator.estimation.mountings.join import JoinedCalibration, join_mountings
from estimator.recordings.reading import read_recording
from estimator.recordings.recording import Recording
from estimator.untrusted import harmless
from station.bench.bench import excluded_by_file, load_bench, read_excluded, read_limits
from station.errors import UsageError, sentence
from station.render import printing
from station.render.accelerometers.result import print_forces
from station.render.lines import tell
from station.render.results.joined import print_mountings
from station.run.outcome import Outcome, ended_of, judge_recorded
from station.views.json_values import json_object

_UNFINISHED = (Outcome.ABORTED, Outcome.FAULT, Outcome.MANUAL)


def command_join(arguments: argparse.Namespace, names: Sequence[str]) -> int:
    """Calibrate the one device of all recordings together, print the result, and return its exit code.

    UsageError for options that a joined calibration does not have.
    """
    for option in ("write", "model", "scheduler"):
        if getattr(arguments, option):
            raise UsageError(sentence("calibrate.not_joined", option=option))
    try:
        recordings = [read_recording(Path(name)) for name in names]
        _check(recordings)
        if arguments.undeclared:
            excluded = [excluded_by_file(Path(arguments.undeclared))] * len(recordings)
        else:
            excluded = [_excluded(recording) for recording in recordings]
        found = join_mountings(recordings, excluded=excluded)
    except EstimatorError as error:
        return printing.refuse(str(error), arguments.json)
    if arguments.bench:
        limits = load_bench(Path(arguments.bench)).limits
    else:
        limits = read_limits(str(recordings[0].attributes.get("bench", "")))
    verdict = judge_recorded(found.calibration, limits, None)
    if arguments.json:
        result = printing.result_object(verdict, str(names[0]), found.calibration)
        result["joined"] = json_object(_joined_object(names, found))
        print(json.dumps(result))
    else:
        printing.print_verdict(verdict, details=arguments.details)
        printing.print_calibration(found.calibration, verdict, limits.units, details=arguments.details)
        print_forces(found.calibration.forces, details=arguments.details)
        print_mountings(found.mountings)
        for doubt in found.calibration.doubts if not arguments.details else ():
            tell(harmless(f"note: {doubt}"), sys.stdout)
    return verdict.outcome.exit_code


def _check(recordings: Sequence[Recording]) -> None:
    """Raise UsageError for recordings of devices with different serial numbers, or of a run that did not end."""
    first = recordings[0]
    serial = ""
    for recording in recordings:
        own = str(recording.attributes.get("device_serial", ""))
        if own and serial and own != serial:
            raise UsageError(
                sentence("calibrate.other_serial", first=first.name, serial=serial, second=recording.name, other=own)
            )
        serial = serial or own
        ended = ended_of(recording.attributes)
        if ended is not None and ended.outcome in _UNFINISHED:
            raise UsageError(sentence("calibrate.unfinished", recording=recording.name, outcome=str(ended.outcome)))


def _excluded(recording: Recording) -> frozenset[str] | None:
    """Return the effects that the bench file or the mapping in a recording rules out."""
    declared = str(recording.attributes.get("bench", "")) or str(recording.attributes.get("mapping", ""))
    return read_excluded(declared, recording.attributes.get("plugins", ()))


def _joined_object(names: Sequence[str], found: JoinedCalibration) -> list[dict[str, object]]:
    """Return the recordings with the mounting error in each, in SI."""
    return [
        {"recording": str(name), "mounting_error_rad": one.error_rad, "sd_rad": one.sd_rad}
        for name, one in zip(names, found.mountings, strict=True)
    ]
