"""station plan: what a script will show, computed before anything moves."""

import argparse
import json
import math
import sys
from pathlib import Path
from typing import Any

from estimator.observations.coverage import coverage_object
from estimator.planning.planning import EffectForecast, Forecast
from station.atomic_write import check_new_file, free_path, write_whole
from station.bench.bench import load_bench
from station.commands.improve import improve, quantity, script_text
from station.errors import UsageError, sentence
from station.opening import with_links
from station.opening.planned_forces import planned_forces
from station.render.accelerometers.planned import print_planned_forces
from station.render.lines import tell
from station.render.plan_printed import print_plan
from station.render.plans.early_late import print_early_late
from station.render.template import rendered
from station.render.terminal import stdout
from station.run.outcome import Outcome
from station.scripts.early_late import early_and_late
from station.scripts.plan import TEMPERATURE_RISE_K, WARMING_TIME_S, Plan, make_plan
from station.scripts.script import Timed, load_script, paper_script
from station.scripts.steps.kind import Span
from station.views.accelerometers.planned import planned_object
from station.views.json_values import by_state, json_object

EARLY_LATE_FILE = "early-late.toml"


def command_plan(arguments: argparse.Namespace) -> int:
    """Print what a script will show on a bench; return 1 if it misses the sigmas that the bench requires, else 0.

    With --improve or --early-late write a better script instead. UsageError for both together.
    """
    bench = load_bench(Path(arguments.bench) if arguments.bench else None)
    bench = with_links(bench, {}, arguments.device)
    script = load_script(Path(arguments.script), bench.plugin_files) if arguments.script else paper_script()
    if arguments.improve and arguments.early_late:
        raise UsageError("--improve and --early-late each write a script: give one of them")
    if arguments.improve:
        return improve(arguments, bench, script)
    rise_k = TEMPERATURE_RISE_K
    if arguments.temperature_rise is not None:
        rise_k = quantity(arguments, "temperature_rise", "temperature")
    if arguments.early_late:
        return _write_early_late(arguments, make_plan(script, bench, effects=()))
    plan = make_plan(script, bench, temperature_rise_k=rise_k)
    early_late = None if plan.proves_constancy else early_late_plan(plan)
    of_forces = planned_forces(plan.script, bench)
    if arguments.json:
        forces = {"accelerometers": [planned_object(one) for one in of_forces]} if of_forces else {}
        print(json.dumps(plan_object(plan) | {"early_late": early_late and _early_late_object(early_late)} | forces))
    else:
        print_plan(plan, stdout(), early_late)
        print_planned_forces(of_forces)
    return (Outcome.PASS if plan.reached.all() else Outcome.FAIL).exit_code


def early_late_plan(plan: Plan) -> Plan | None:
    """Return the plan, without effects, of a script as long as this one that turns each axis early and late, if any."""
    script = early_and_late(plan.script, plan.bench.table.limits, plan.bench.table.gimbals)
    return None if script is None else make_plan(script, plan.bench, effects=())


def _write_early_late(arguments: argparse.Namespace, plan: Plan) -> int:
    """Write the script that turns each axis early and late, and print its sigmas; return 1 if there is none.

    UsageError if the file exists.
    """
    path = Path(arguments.output) if arguments.output else free_path(Path(EARLY_LATE_FILE))
    check_new_file(path, "--output")
    offered = early_late_plan(plan)
    if offered is None:
        reason = sentence("script.no_early_late", script=plan.script.name, length_s=plan.script.least_s)
        tell(f"station: {reason}", sys.stderr)
        if arguments.json:
            print(json.dumps({"reached": False, "reason": reason, "script": None}))
        return Outcome.FAIL.exit_code
    origin = rendered("station.commands", "early_late_origin.txt", {"asked": plan, "offered": offered})
    write_whole(path, script_text(offered.script, origin))
    if arguments.json:
        asked = {"script": plan.script.name, "gyros": _sigmas(plan)}
        print(json.dumps({"reached": True, "before": asked, **_early_late_object(offered), "script": str(path)}))
    else:
        print_early_late(plan, offered, path, stdout())
    return Outcome.PASS.exit_code


def _early_late_object(offered: Plan) -> dict[str, Any]:
    """Return a script that turns each axis early and late for --json, in SI."""
    return {
        "script": offered.script.name,
        "duration_s": offered.script.least_s,
        "steps": _steps(offered),
        "gyros": _sigmas(offered),
        "constancy": [coverage_object(axis) for axis in offered.constancy],
    }


def _sigmas(plan: Plan) -> list[dict[str, Any]]:
    return [
        {"device": gyro.source, "name": gyro.name, "sd": by_state(sd)}
        for gyro, sd in zip(plan.forecast.gyros, plan.sd, strict=True)
    ]


def _steps(plan: Plan) -> list[dict[str, Any]]:
    return [_step_object(timed) for timed in plan.script.timeline()]


def _step_object(timed: Timed) -> dict[str, Any]:
    """Return a step for --json, with axis and rate of its last turn, and ``longest_s`` if its duration is not fixed."""
    turn = timed.last_turn
    return {
        "label": timed.step.label,
        **_duration(timed.span),
        "axis": None if turn is None else turn.axis,
        "rate_rps": None if turn is None else turn.rate_rps,
    }


def _duration(span: Span) -> dict[str, float | None]:
    """Return a duration in s; where it is not known the least one, and the longest, null for no limit."""
    if span.is_exact:
        return {"duration_s": span.least_s}
    return {"duration_s": span.least_s, "longest_s": span.most_s if math.isfinite(span.most_s) else None}


def plan_object(plan: Plan) -> dict[str, Any]:
    """Return the plan for --json, in SI; null for infinite numbers."""
    found = plan.forecast
    return {
        "script": plan.script.name,
        **_duration(plan.script.span),
        "steps": _steps(plan),
        "reached": bool(plan.reached.all()),
        "required": by_state(plan.required),
        "gyros": [
            {
                "device": gyro.source,
                "name": gyro.name,
                "sd": by_state(sd),
                "sd_table": by_state(table),
                "reached": bool(reached.all()),
                "unseen": [by_state(direction) for direction in gyro.unseen],
            }
            for gyro, sd, table, reached in zip(found.gyros, plan.sd, plan.table_sd, plan.reached, strict=True)
        ],
        "steady_conditions": found.steady_conditions,
        "saturated": found.saturated,
        "constancy": [coverage_object(axis) for axis in plan.constancy],
        "effects": [_effect(forecast, found) for forecast in found.effects],
        "alike": [
            {
                "effects": [pair.first, pair.second],
                "correlation": pair.correlation,
                "parameter": pair.parameter,
                "gyro": None if pair.gyro is None else found.gyros[pair.gyro].name,
            }
            for pair in found.pairs
        ],
        "assumed": {"temperature_rise_k": plan.temperature_rise_k, "warming_time_s": WARMING_TIME_S},
    }


def _effect(forecast: EffectForecast, found: Forecast) -> dict[str, Any]:
    """Return an effect for --json: by parameter its smallest visible size, and the shift of the states at its largest
    size.
    """
    names = ["all"] if forecast.effect.shared else [gyro.name for gyro in found.gyros]
    return {
        "name": forecast.effect.name,
        "shared": forecast.effect.shared,
        "shown_by": forecast.effect.record.shown_by,
        "parameters": [
            {
                "name": parameter.name,
                "unit": parameter.unit,
                "largest": parameter.largest,
                "smallest": dict(zip(names, json_object(forecast.smallest[i]), strict=True)),
                "seen": bool(forecast.seen[i].all()),
                "shift_of_largest": [
                    {"gyro": gyro.name, **by_state(shift), "sigmas": by_state(sigmas)}
                    for gyro, shift, sigmas in zip(
                        found.gyros, forecast.shift[i], forecast.shift_sigmas[i], strict=True
                    )
                ],
            }
            for i, parameter in enumerate(forecast.effect.parameters)
        ],
    }
