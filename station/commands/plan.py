"""station plan: what a script will show, computed before anything moves."""

import argparse
import json
import sys
from pathlib import Path

from station.atomic_write import check_new_file, free_path, write_whole
from station.bench.bench import load_bench
from station.commands.improve.command import improve
from station.commands.improve.goal import quantity
from station.commands.improve.script_file import script_text
from station.errors import UsageError, sentence
from station.opening import with_links
from station.opening.planned_forces import planned_forces
from station.opening.planned_mountings import planned_mountings
from station.render.accelerometers.planned import print_planned_forces
from station.render.lines import tell
from station.render.plan_printed import print_plan
from station.render.plans.early_late import print_early_late
from station.render.plans.mountings import print_planned_mountings
from station.render.template import rendered
from station.render.terminal import stdout
from station.run.outcome import Outcome
from station.scripts.early_late import early_and_late
from station.scripts.plan import TEMPERATURE_RISE_K, Plan, make_plan
from station.scripts.script import load_script, paper_script
from station.views.answers.plan import early_late_view, plan_view, planned_gyros
from station.views.json_values import json_object

EARLY_LATE_FILE = "early-late.toml"


def command_plan(arguments: argparse.Namespace) -> int:
    """Print what a script will show on a bench; return 1 if it misses the sigmas that the bench requires, else 0.

    With --improve or --early-late write a better script instead, and return 1 if there is none. UsageError for both
    together.
    """
    bench = load_bench(Path(arguments.bench) if arguments.bench else None)
    bench = with_links(bench, {}, arguments.device)
    script = paper_script()
    if arguments.script:
        script = load_script(Path(arguments.script), bench.plugin_files, bench.table.gimbals[0])
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
    of_mountings = planned_mountings(plan.script, bench)
    missed = [name for one in of_forces for name in one.missed(bench.limits.forces)]
    if arguments.json:
        print(json.dumps(json_object(plan_view(plan, early_late=early_late, forces=of_forces, mountings=of_mountings))))
    else:
        print_plan(plan, stdout(), early_late, missed)
        print_planned_forces(of_forces, plan.bench.limits.forces)
        print_planned_mountings(of_mountings, bench.units)
    return (Outcome.PASS if plan.reached.all() and not missed else Outcome.FAIL).exit_code


def early_late_plan(plan: Plan) -> Plan | None:
    """Return the plan, without effects, of a script as long as this one that turns each axis early and late, if any."""
    script = early_and_late(plan.script, plan.bench.table.limits, plan.bench.table.gimbals)
    return None if script is None else make_plan(script, plan.bench, effects=())


def _write_early_late(arguments: argparse.Namespace, plan: Plan) -> int:
    """Write the script that turns each axis early and late, and print its sigmas; return 0.

    Return 1, with the reason, if there is none. UsageError if the file exists.
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
        before = {"script": plan.script.name, "gyros": planned_gyros(plan)}
        written = {"reached": True, "before": before, **json_object(early_late_view(offered)), "script": str(path)}
        print(json.dumps(json_object(written)))
    else:
        print_early_late(plan, offered, path, stdout())
    return Outcome.PASS.exit_code
