"""station plan: what a script will show, before anything moves."""

import argparse
import json
from pathlib import Path
from typing import Any

from estimator.planning.planning import EffectForecast, Forecast
from station.bench.bench import load_bench
from station.commands.improve import improve, quantity
from station.opening import with_links
from station.render.plan_printed import print_plan
from station.render.terminal import stdout
from station.run.outcome import Outcome
from station.scripts.plan import TEMPERATURE_RISE_K, WARMING_TIME_S, Plan, make_plan
from station.scripts.script import load_script, paper_script
from station.views.json_values import by_state, json_object


def command_plan(arguments: argparse.Namespace) -> int:
    """Print what a script will show on a bench; 1 if it does not reach the sigmas that the bench requires."""
    bench = load_bench(Path(arguments.bench) if arguments.bench else None)
    bench = with_links(bench, {}, arguments.device)
    script = load_script(Path(arguments.script)) if arguments.script else paper_script()
    if arguments.improve:
        return improve(arguments, bench, script)
    rise_k = TEMPERATURE_RISE_K
    if arguments.temperature_rise is not None:
        rise_k = quantity(arguments, "temperature_rise", "temperature")
    plan = make_plan(script, bench, temperature_rise_k=rise_k)
    if arguments.json:
        print(json.dumps(plan_object(plan)))
    else:
        print_plan(plan, stdout())
    return (Outcome.PASS if plan.reached.all() else Outcome.FAIL).exit_code


def plan_object(plan: Plan) -> dict[str, Any]:
    """Return the plan as what --json prints, in SI; null for what is infinite."""
    found = plan.forecast
    return {
        "script": plan.script.name,
        "duration_s": plan.script.duration_s,
        "steps": [
            {"label": timed.step.label, "duration_s": timed.duration_s}
            | {key: getattr(timed.step, key, None) for key in ("axis", "rate_rps")}  # None of a rest
            for timed in plan.script.timeline()
        ],
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
