"""Results in the terminal: the table of states, the verdict; and the JSON for machines."""

import json
import math
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from drivers.packaged import packaged_toml
from drivers.types import Floats
from estimator.calibration.gyro import GyroCalibration
from estimator.calibration.values import Calibration, GyroParity
from estimator.estimation.repeatability import Repeatability
from estimator.geometry.model import STATES
from estimator.observations.allan.sensor import SensorNoise
from estimator.observations.coverage import coverage_object, not_proved
from station.bench.units import Units
from station.errors import EXIT_USAGE
from station.render.forces_printed import print_forces
from station.render.lines import tell
from station.render.noise_printed import noise_table
from station.render.terminal import print_rendered, stdout
from station.run.outcome import Outcome, Verdict
from station.views.figures import OUTCOME_STYLES, StateUnit, state_figures
from station.views.forces import force_object
from station.views.json_values import budget_and_noise, by_state, json_object, named
from station.views.limits import worst_first

_MOST_DECIMALS = 9
MOST_BROKEN = 4
"""Limits that are broken of which a person sees without asking for details: the worst."""
_BUDGET_WORDS = packaged_toml("station.views", "budget.toml")["terminal"]


def print_result(
    verdict: Verdict,
    calibration: Calibration | None,
    recording: Path,
    units: Units,
    *,
    details: bool,
    sources: Sequence[Any] = (),
) -> None:
    """Print the result of a run or recording: the verdict, the states in these units, and the next steps.

    With ``details`` also every broken limit, the origin of the sigmas, the noise, notes, and for each of ``sources``
    its samples, losses and clock. ``calibration`` may be None.
    """
    print_verdict(verdict, details=details)
    if calibration is not None:
        print_calibration(calibration, verdict, units, details=details)
        print_forces(calibration.forces, details=details)
    if details:
        print_rendered(stdout(), "station.render", "sources.rich", {"sources": sources})
    more = not details and (calibration is not None or bool(sources))
    closing = {"next": next_steps(verdict, calibration, recording), "recording": recording, "more": more}
    print_rendered(stdout(), "station.render", "closing.rich", closing)


def print_calibration(calibration: Calibration, verdict: Verdict, units: Units, *, details: bool) -> None:
    """Print the states of every gyro with their sigmas, in these units; broken limits are red.

    With ``details`` also the origin of the sigmas.
    """
    found = [gyro.noise for gyro in calibration.gyros if gyro.noise is not None]
    noises = [(noise.mean.arw, 3600 * noise.instability_below, 3600 * 60 * noise.walk_below) for noise in found]
    values = {
        "calibration": calibration,
        "broken": {(line.row, line.state, line.of_u) for line in verdict.broken},
        "budget": _budget(calibration),
        "state_figures": fitted_figures(units, calibration),
        "size": _size,
        "undeclared": _undeclared(calibration, units),
        "noise": np.degrees(np.mean(noises, axis=0)).tolist() if noises else None,
        "rest": _rest([gyro.rest for gyro in calibration.gyros if gyro.rest is not None]),
        "noise_table": noise_table,
    }
    print_rendered(stdout(), "station.render", "calibration.rich", values)
    if details:
        print_rendered(stdout(), "station.render", "details.rich", values)


def _undeclared(calibration: Calibration, units: Units) -> list[tuple[str, ...]]:
    """Return a row for each state: its sigma with and without undeclared effects (rms), the main effects, what shows
    them.

    Empty if there are none.
    """
    if not calibration.undeclared or not calibration.gyros:
        return []
    whole = np.sqrt(np.mean([gyro.sd**2 for gyro in calibration.gyros], axis=0)).tolist()
    without = np.sqrt(np.mean([gyro.sd_declared**2 for gyro in calibration.gyros], axis=0)).tolist()
    rows: list[tuple[str, ...]] = []
    for figure, name, sd, left in zip(state_figures(units), STATES, whole, without, strict=True):
        own = [effect for effect in calibration.undeclared if effect.state == name]
        mostly = "; ".join(f"{effect.effect} {effect.share:.0%}" for effect in own)
        shown_by = "; ".join(dict.fromkeys(effect.shown_by for effect in own))
        label = f"{figure.name} ({figure.unit})"
        rows.append((label, _size(sd * figure.factor), _size(left * figure.factor), mostly, shown_by))
    return rows


def fitted_figures(units: Units, calibration: Calibration) -> tuple[StateUnit, ...]:
    """Return the states in these units, with the digits that the sigmas of a calibration deserve."""
    sds = zip(*(gyro.sd.tolist() for gyro in calibration.gyros), strict=True)
    return tuple(figure.fitted(own) for figure, own in zip(state_figures(units), sds, strict=True))


def _budget(calibration: Calibration) -> Mapping[str, Floats]:
    """Return the contributions to the sigmas (4,), rms over the gyros: noise, the table's uncertainty, and the
    combination.

    Empty if there is one contribution only, or gyros differ in them.
    """
    budgets = [{c.name: c.u for c in gyro.budget} for gyro in calibration.gyros]
    names = list(budgets[0]) if budgets else []
    if len(names) < 2 or any(list(budget) != names for budget in budgets):
        return {}
    lines = {_BUDGET_WORDS.get(name, name): [budget[name] for budget in budgets] for name in names}
    lines["combined"] = [gyro.sd for gyro in calibration.gyros]
    return {name: np.sqrt(np.mean(np.square(u), axis=0)) for name, u in lines.items()}


def _rest(rests: Sequence[SensorNoise]) -> Mapping[str, Any] | None:
    """Return the noise of each gyro at rest, with the minimum of their mean Allan deviation; None without rest."""
    if not rests:
        return None
    shortest = min((rest.curve for rest in rests), key=lambda curve: len(curve.tau_s))
    mean = np.mean([rest.curve.deviation[: len(shortest.tau_s)] for rest in rests], axis=0)
    least = int(np.argmin(mean))
    return {
        "span_s": f"{np.mean([rest.span_s for rest in rests]):.0f}",
        "noises": rests,
        "lowest": f"{math.degrees(mean[least]) * 3600:.2g} deg/h at {shortest.tau_s[least]:.0f} s",
    }


def print_repeatability(repeats: Sequence[Repeatability], device: str, script: str, units: Units) -> None:
    """Print the scatter of a device's states over its runs of a script, beside that expected from their sigmas.

    Nothing is printed if ``repeats`` is empty.
    """
    if not repeats:
        return
    values = {
        "repeats": repeats,
        "device": device,
        "script": script,
        "size": _size,
        "state_figures": state_figures(units),
    }
    print_rendered(stdout(), "station.render", "repeatability.rich", values)


def repeatability_object(repeats: Sequence[Repeatability]) -> list[dict[str, Any]]:
    """Return the repeatability for --json: by gyro the number of runs and, by state, the figures in SI."""
    return [
        {
            "name": gyro.name,
            "runs": gyro.runs,
            **{key: by_state(getattr(gyro, key)) for key in ("mean", "scatter", "expected", "between", "differs")},
        }
        for gyro in repeats
    ]


def _size(value: float) -> str:
    """Return a size with two digits that count, without an exponent."""
    if value >= 10 or value == 0 or not math.isfinite(value):
        return f"{value:.0f}"
    return f"{value:.{min(1 - math.floor(math.log10(value)), _MOST_DECIMALS)}f}"


def print_verdict(verdict: Verdict, *, details: bool) -> None:
    """Print the outcome and its reasons: causes first, then broken limits as a table; without ``details`` the worst."""
    broken = list(verdict.broken) if details else worst_first(verdict.broken)[:MOST_BROKEN]
    values = {"verdict": verdict, "style": OUTCOME_STYLES[verdict.outcome], "broken": broken}
    print_rendered(stdout(), "station.render", "verdict.rich", values)


def next_steps(verdict: Verdict, calibration: Calibration | None, recording: Path) -> list[str]:
    """Return sentences, with commands, on what to do next after a verdict.

    They depend on its outcome: repeat an aborted run, remedy broken limits or else investigate, write the report of a
    run that passed. A passed run whose calibration does not prove constancy gets a plan for that, too.
    """
    if verdict.outcome in (Outcome.ABORTED, Outcome.FAULT):
        return ["`station check` tests every device; then repeat the run"]
    if verdict.outcome is Outcome.MANUAL:
        return ["nothing was judged. `station run` runs a script and calibrates"]
    remedies = list(dict.fromkeys(line.remedy for line in verdict.broken if line.remedy))
    if verdict.outcome is Outcome.FAIL:
        return remedies or [f"`station investigate {recording}` looks for errors that the model misses"]
    steps = [f"`station report {recording}` writes the certificate or report"]
    if calibration is not None and not_proved(calibration.constancy):
        steps.append("`station plan --early-late` writes a script that proves constancy")
    return steps


def next_after_report(verdict: Verdict | None, recording: Path) -> list[str]:
    """Return sentences on what to do after a report; for a run that passed, how to export the calibration."""
    if verdict is not None and verdict.outcome not in (Outcome.PASS, Outcome.ESTIMATED):
        return next_steps(verdict, None, recording)
    return [f"`station export {recording} --all FOLDER` writes the calibration for firmware and tools"]


def refuse(reason: str, as_json: bool, outcome: Outcome | None = None, recording: str | None = None) -> int:
    """Print on stderr why there is no result, and as JSON an empty one; return the exit code."""
    tell(f"station: {reason}", sys.stderr)
    if as_json:
        print(json.dumps(empty_object(reason, outcome and str(outcome), recording)))
    return outcome.exit_code if outcome else EXIT_USAGE


def empty_object(reason: str, outcome: str | None = None, recording: str | None = None) -> dict[str, Any]:
    """Return the object for --json if there is no result."""
    empty: dict[str, Any] = {"outcome": outcome, "reason": reason, "recording": recording}
    return {**empty, "gyros": [], "nis_mean": None, "samples": 0, "lost": 0}


def result_object(verdict: Verdict, recording: str, calibration: Calibration | None) -> dict[str, Any]:
    """Return the result for --json; without a calibration its lists are empty and its numbers null or 0."""
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
    """Return the parity checks by gyro, with its source before its name where two have one name."""
    alike = Counter(check.name for check in checks)
    keys = [check.name if alike[check.name] == 1 else f"{check.source} {check.name}" for check in checks]
    values = [named(check, ("rms_sigma", "worst_sigma", "suspect")) for check in checks]
    return dict(zip(keys, values, strict=True))


def _gyro_object(gyro: GyroCalibration) -> dict[str, Any]:
    """Return a gyro for --json: states, sigmas, budget, noise, and by effect and parameter the value, its sd and its
    unit.
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
