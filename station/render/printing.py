"""The result of a run or a calibration: in the terminal, and the JSON for machines."""

import json
import math
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from estimator.calibration.gyro import GyroCalibration
from estimator.calibration.values import Calibration, GyroParity
from estimator.observations.coverage import coverage_object
from station.bench.units import Units
from station.errors import EXIT_USAGE
from station.render.accelerometers.result import print_forces
from station.render.lines import tell
from station.render.results.calibration import calibration_shown
from station.render.results.details import details_shown, sources_shown
from station.render.results.verdict import closing_shown, next_steps, verdict_shown
from station.render.terminal import print_all, stdout
from station.run.outcome import Outcome, Verdict
from station.views.accelerometers.result import force_object
from station.views.json_values import budget_and_noise, by_state, json_object, named

if TYPE_CHECKING:  # acquisition also imports drivers
    from station.run.source_report import SourceReport


def print_result(
    verdict: Verdict,
    calibration: Calibration | None,
    recording: Path,
    units: Units,
    *,
    details: bool,
    sources: "Sequence[SourceReport]" = (),
) -> None:
    """Print the result of a run or recording: verdict, states in these units, accelerometers, next steps and its path.

    With ``details`` also every broken limit, all of ``details_shown``, more of the accelerometers, and for each of
    ``sources`` its samples, losses and clock. Without a ``calibration`` (None) there are no states.
    """
    print_verdict(verdict, details=details)
    if calibration is not None:
        print_calibration(calibration, verdict, units, details=details)
        print_forces(calibration.forces, details=details)
    if details:
        print_all(stdout(), sources_shown(sources))
    more = not details and (calibration is not None or bool(sources))
    print_all(stdout(), closing_shown(next_steps(verdict, calibration, recording), recording, more=more))


def print_verdict(verdict: Verdict, *, details: bool) -> None:
    """Print the outcome and its reasons; without ``details`` only the worst of the broken limits."""
    print_all(stdout(), verdict_shown(verdict, details=details))


def print_calibration(calibration: Calibration, verdict: Verdict, units: Units, *, details: bool) -> None:
    """Print what ``calibration_shown`` has: the states of every gyro with their sigmas in these units, NIS and noise.

    Broken limits of ``verdict`` are red. With ``details`` also what ``details_shown`` has. No accelerometers.
    """
    print_all(stdout(), calibration_shown(calibration, verdict, units))
    if details:
        print_all(stdout(), details_shown(calibration, units))


def refuse(reason: str, as_json: bool, outcome: Outcome | None = None, recording: str | None = None) -> int:
    """Print on stderr why there is no result, and with ``as_json`` an empty one on stdout; return the exit code.

    It is that of ``outcome``, without one that of wrong usage.
    """
    tell(f"station: {reason}", sys.stderr)
    if as_json:
        print(json.dumps(empty_object(reason, outcome and str(outcome), recording)))
    return outcome.exit_code if outcome else EXIT_USAGE


def empty_object(reason: str, outcome: str | None = None, recording: str | None = None) -> dict[str, Any]:
    """Return the object for --json if there is no result."""
    empty: dict[str, Any] = {"outcome": outcome, "reason": reason, "recording": recording}
    return {**empty, "gyros": [], "nis_mean": None, "samples": 0, "lost": 0}


def result_object(verdict: Verdict, recording: str, calibration: Calibration | None) -> dict[str, Any]:
    """Return the result for --json: verdict, recording, gyros as ``_gyro_object``, NIS, samples, notes and checks.

    Without a calibration its lists and texts are empty and its numbers null or 0. "accelerometers" is there only if
    there are sources of some, calibrated or not. States and sigmas are in SI.
    """
    found = calibration or Calibration(gyros=(), nis_mean=math.nan, samples=0, lost=0, notes=())
    return {
        "outcome": str(verdict.outcome),
        "reason": verdict.reason,
        "recording": recording,
        "gyros": list(map(_gyro_object, found.gyros)),
        "nis_mean": json_object(found.nis_mean),
        **named(found, ("samples", "lost", "holds_for")),
        "doubts": list(found.doubts),
        "notes": list(found.notes),
        "undeclared": [asdict(effect) for effect in found.undeclared],
        "constancy": [coverage_object(axis) for axis in found.constancy],
        "excluded": {e.name: e.reason for e in found.excluded},
        "parity": _parity_object(found.parity),
    } | ({"accelerometers": [force_object(one) for one in found.forces]} if found.forces else {})


def _parity_object(checks: Sequence[GyroParity]) -> dict[str, Any]:
    """Return the parity checks by gyro, with its source before its name where two have one name.

    Each has "rms_sigma" and "worst_sigma", deviations in sigmas, and whether the gyro is "suspect".
    """
    alike = Counter(check.name for check in checks)
    keys = [check.name if alike[check.name] == 1 else f"{check.source} {check.name}" for check in checks]
    values = [named(check, ("rms_sigma", "worst_sigma", "suspect")) for check in checks]
    return dict(zip(keys, values, strict=True))


def _gyro_object(gyro: GyroCalibration) -> dict[str, Any]:
    """Return a gyro for --json: name, source, states, sigmas ("sd", "sd_declared"), budget, noise and effects.

    ``effects`` has by effect and parameter a list of value, sd and unit; it is missing if there are none.
    """
    effects: dict[str, dict[str, list[float | str]]] = {}
    for value in gyro.effects:
        effects.setdefault(value.effect, {})[value.parameter] = [value.value, value.sd, value.unit]
    found = {
        "name": gyro.name,
        "source": gyro.source,
        **by_state(gyro.states),
        "sd": by_state(gyro.sd),
        "sd_declared": by_state(gyro.sd_declared),
        **budget_and_noise(gyro),
    }
    return found | ({"effects": effects} if effects else {})
