"""station calibrate --join: one calibration of a device that was mounted otherwise in each of several recordings."""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from estimator.errors import EstimatorError
from estimator.estimation.mountings.join import JoinedCalibration
from estimator.recordings.reading import read_recording
from estimator.untrusted import harmless
from station.bench.bench import excluded_by_file, load_bench, read_limits
from station.errors import UsageError, sentence
from station.render import printing
from station.render.accelerometers.result import print_forces
from station.render.lines import tell
from station.render.results.joined import print_mountings
from station.run.joining import joined_of
from station.run.outcome import judge_recorded
from station.views.json_values import json_object


def command_join(arguments: argparse.Namespace, names: Sequence[str]) -> int:
    """Calibrate the one device of all recordings together, print result and mounting errors; return its exit code.

    It is judged by the limits of --bench, else those of the first recording. Recordings that cannot be joined are
    refused with a message; UsageError for those of two devices, of a run that did not end, or one given twice, and for
    options that a joined calibration does not have.
    """
    for option in ("write", "model", "scheduler"):
        if getattr(arguments, option):
            raise UsageError(sentence("calibrate.not_joined", option=option))
    try:
        recordings = [read_recording(Path(name)) for name in names]
        undeclared = (excluded_by_file(Path(arguments.undeclared)),) if arguments.undeclared else None
        found = joined_of(recordings, undeclared)
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


def _joined_object(names: Sequence[str], joined: JoinedCalibration) -> list[dict[str, object]]:
    """Return the recordings with the mounting error in each, in SI."""
    return [
        {"recording": str(name), "mounting_error_rad": one.error_rad, "sd_rad": one.sd_rad}
        for name, one in zip(names, joined.mountings, strict=True)
    ]
