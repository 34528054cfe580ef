"""What a person sees in the terminal: the table of states, the verdict; and the JSON for machines."""

import json
import math
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from drivers.packaged import packaged_toml
from drivers.types import Floats
from estimator.calibration.gyro import GyroCalibration
from estimator.calibration.values import Calibration, GyroParity
from estimator.estimation.repeatability import Repeatability
from estimator.observations.coverage import coverage_object
from estimator.observations.rests import RestNoise
from station.errors import EXIT_USAGE
from station.render.terminal import print_rendered, stdout
from station.run.outcome import Outcome, Verdict
from station.views.figures import OUTCOME_STYLES
from station.views.json_values import budget_and_noise, by_state, json_object, named

_BUDGET_WORDS = packaged_toml("station.views", "budget.toml")["terminal"]


def print_calibration(calibration: Calibration, verdict: Verdict) -> None:
    """Print the states of every gyro with their sigmas, in the units people use, and where the sigmas come from.

    What breaks a limit is red.
    """
    found = [gyro.noise for gyro in calibration.gyros if gyro.noise is not None]
    noises = [(noise.mean.arw, 3600 * noise.instability_below, 3600 * 60 * noise.walk_below) for noise in found]
    values = {
        "calibration": calibration,
        "broken": {(line.row, line.state, line.of_u) for line in verdict.broken},
        "budget": _budget(calibration),
        "size": _size,
        "noise": np.degrees(np.mean(noises, axis=0)).tolist() if noises else None,
        "rest": _rest([gyro.rest for gyro in calibration.gyros if gyro.rest is not None]),
    }
    print_rendered(stdout(), "station.render", "calibration.rich", values)


def _budget(calibration: Calibration) -> Mapping[str, Floats]:
    """Return where the sigmas come from, (4,) each: noise and the table's own uncertainty, rms over the gyros."""
    budgets = [{c.name: c.u for c in gyro.budget} for gyro in calibration.gyros]
    names = list(budgets[0]) if budgets else []
    if len(names) < 2 or any(list(budget) != names for budget in budgets):
        return {}
    lines = {_BUDGET_WORDS.get(name, name): [budget[name] for budget in budgets] for name in names}
    lines["combined"] = [gyro.sd for gyro in calibration.gyros]
    return {name: np.sqrt(np.mean(np.square(u), axis=0)) for name, u in lines.items()}


def _rest(rests: Sequence[RestNoise]) -> Mapping[str, str] | None:
    """Return the mean noise of the gyros at rest alone, with where their mean Allan deviation is least."""
    if not rests:
        return None
    shortest = min(rests, key=lambda rest: len(rest.tau_s))
    mean = np.mean([rest.deviation_rps[: len(shortest.tau_s)] for rest in rests], axis=0)
    least = int(np.argmin(mean))
    return {
        "span_s": f"{np.mean([rest.span_s for rest in rests]):.0f}",
        "arw": f"{math.degrees(np.mean([rest.noise.arw for rest in rests])):.3g}",
        "lowest": f"{math.degrees(mean[least]) * 3600:.2g} deg/h at {shortest.tau_s[least]:.0f} s",
    }


def print_repeatability(repeats: Sequence[Repeatability], device: str) -> None:
    """Print how the states of a device scatter over its runs, beside the scatter that their sigmas promise."""
    if not repeats:
        return
    values = {"repeats": repeats, "device": device, "size": _size}
    print_rendered(stdout(), "station.render", "repeatability.rich", values)


def repeatability_object(repeats: Sequence[Repeatability]) -> list[dict[str, Any]]:
    """Return the repeatability as what --json prints: by gyro the runs and, by state, the figures in SI."""
    return [
        {
            "name": gyro.name,
            "runs": gyro.runs,
            **{key: by_state(getattr(gyro, key)) for key in ("mean", "scatter", "expected", "between", "differs")},
        }
        for gyro in repeats
    ]


def _size(value: float) -> str:
    return "< 0.01" if value < 0.01 else f"{value:.2g}" if value < 10 else f"{value:.0f}"


def print_verdict(verdict: Verdict, recording: Path) -> None:
    """Print how it ended, why, and where the recording is; causes before what is broken, which is a table."""
    values = {"verdict": verdict, "style": OUTCOME_STYLES[verdict.outcome], "recording": recording}
    print_rendered(stdout(), "station.render", "verdict.rich", values)


def refuse(reason: str, as_json: bool, outcome: Outcome | None = None, recording: str | None = None) -> int:
    """Say on stderr why there is no result, and as JSON an empty one; return the exit code."""
    print(f"station: {reason}", file=sys.stderr)
    if as_json:
        print(json.dumps(empty_object(reason, outcome and str(outcome), recording)))
    return outcome.exit_code if outcome else EXIT_USAGE


def empty_object(reason: str, outcome: str | None = None, recording: str | None = None) -> dict[str, Any]:
    """Return what --json prints when there is no result."""
    empty: dict[str, Any] = {"outcome": outcome, "reason": reason, "recording": recording}
    return {**empty, "gyros": [], "nis_mean": None, "samples": 0, "lost": 0}


def result_object(verdict: Verdict, recording: str, calibration: Calibration | None) -> dict[str, Any]:
    """Return the result as what --json prints."""
    found = calibration or Calibration((), math.nan, 0, 0, ())
    return {
        "outcome": str(verdict.outcome),
        "reason": verdict.reason,
        "recording": recording,
        "gyros": list(map(_gyro_object, found.gyros)),
        "nis_mean": json_object(found.nis_mean),
        **named(found, ("samples", "lost", "holds_for")),
        "doubts": list(found.doubts),
        "constancy": [coverage_object(axis) for axis in found.constancy],
        "excluded": {e.name: e.reason for e in found.excluded},
        "parity": _parity_object(found.parity),
    }


def _parity_object(checks: Sequence[GyroParity]) -> dict[str, Any]:
    """Return the parity checks by gyro, with its source before its name where two have one name."""
    alike = Counter(check.name for check in checks)
    keys = [check.name if alike[check.name] == 1 else f"{check.source} {check.name}" for check in checks]
    values = [named(check, ("rms_sigma", "worst_sigma", "suspect")) for check in checks]
    return dict(zip(keys, values, strict=True))


def _gyro_object(gyro: GyroCalibration) -> dict[str, Any]:
    """Return a gyro: its states and sigmas, and by effect and parameter the value, its standard deviation, its unit."""
    effects: dict[str, dict[str, list[float | str]]] = {}
    for value in gyro.effects:
        effects.setdefault(value.effect, {})[value.parameter] = [value.value, value.sd, value.unit]
    found = {
        "name": gyro.name,
        "source": gyro.source,
        **by_state(gyro.states),
        "sd": by_state(gyro.sd),
        **budget_and_noise(gyro),
    }
    return found | ({"effects": effects} if effects else {})
