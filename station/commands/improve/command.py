"""station plan --improve: finds a script that reaches given sigmas sooner, or lower ones in a given time."""

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape

from drivers.types import Floats
from estimator.sensors.accelerometers import ACCELEROMETER
from station.atomic_write import check_new_file, free_path, write_whole
from station.bench.bench import Bench
from station.commands.improve.goal import wanted_of
from station.commands.improve.reasons import no_gain_text, unreached_gyros_text, unreached_sensors_text
from station.commands.improve.script_file import origin_of, script_text
from station.commands.improve.searches import search_of, used_imus, whole_imu_search
from station.render.lines import tell
from station.render.plans.improved import print_improved
from station.run.outcome import Outcome
from station.scripts.prediction import accelerometer_rows
from station.scripts.script import Script, check
from station.views.improved import Improved
from station.views.json_values import by_state, json_object

DEFAULT_FILE = "improved.toml"


def improve(arguments: argparse.Namespace, bench: Bench, script: Script) -> int:
    """Search a better script than this one, write it to --output or a free file, print what it reaches; return 0.

    Return 1, with the reason, if there is none: the sigmas cannot be reached, or, on a bench with accelerometers, the
    given script is as good or better. UsageError for wrong options or an existing file, ScriptError if the found script
    exceeds the travel of an axis.
    """
    began_s = time.perf_counter()
    wanted = wanted_of(arguments, bench, script)
    path = Path(arguments.output) if arguments.output else free_path(Path(DEFAULT_FILE))
    check_new_file(path, "--output")
    say = Console(stderr=True, quiet=arguments.json)

    def on_progress(text: str) -> None:
        say.print(f"[dim]{escape(text)}[/]", highlight=False)

    accelerometers = accelerometer_rows(bench)
    if accelerometers:
        joint_search = whole_imu_search(bench, wanted, on_progress)
        found = joint_search.best()
    else:
        search = search_of(bench, wanted, on_progress)
        found = search.least_time() if wanted.total_s is None else search.least_sigmas(wanted.total_s)
    gyros = tuple((imu.name, gyro) for imu in used_imus(bench) for gyro in imu.array.names)
    if found is None:
        reason = (
            unreached_sensors_text(joint_search, bench)
            if accelerometers
            else unreached_gyros_text(search, bench, wanted, gyros)
        )
        return _refuse(reason, arguments.json)
    check(found.script, bench.table.limits)
    if accelerometers and (reason := no_gain_text(joint_search, found, script, bench)):
        return _refuse(reason, arguments.json)
    improved = Improved(
        before=script,
        wanted=wanted,
        found=found,
        gyros=gyros,
        accelerometers=accelerometers,
        search_s=time.perf_counter() - began_s,
    )
    write_whole(path, script_text(found.script, origin_of(improved, bench)))
    if arguments.json:
        print(json.dumps(improved_object(improved, path)))
    else:
        print_improved(improved, path, bench.units)
    return Outcome.PASS.exit_code


def _refuse(reason: str, as_json: bool) -> int:
    tell(f"station: {reason}", sys.stderr)
    if as_json:
        print(json.dumps({"reached": False, "reason": reason, "script": None}))
    return Outcome.FAIL.exit_code


def improved_object(improved: Improved, path: Path) -> dict[str, Any]:
    """Return the script found for --json, in SI: file, durations, steps, search, and sigmas required and reached.

    null where nothing was required. Accelerometers are left out for a bench that has none.
    """
    script, before, found, wanted = improved.found.script, improved.before, improved.found, improved.wanted
    result = {
        "reached": bool((found.sd <= wanted.sd).all() and (found.force_sd <= wanted.force_sd).all()),
        "script": str(path),
        "duration_s": script.least_s,
        "duration_with_sequencer_s": improved.with_sequencer_s,
        "before": {"script": before.name, "duration_s": before.least_s},
        "criterion": wanted.criterion,
        "compared": found.compared,
        "search_s": improved.search_s,
        "gyros": [
            {
                "device": device,
                "name": name,
                "required": by_state(needed),
                "sd": by_state(reached),
            }
            for (device, name), needed, reached in zip(improved.gyros, wanted.sd, found.sd, strict=True)
        ],
        "steps": [{"label": timed.step.label, "duration_s": timed.span.least_s} for timed in script.timeline()],
    }
    if improved.accelerometers:
        result["accelerometers"] = [
            _accelerometer_object(device, name, needed, reached)
            for (device, name), needed, reached in zip(
                improved.accelerometers, wanted.force_sd, found.force_sd, strict=True
            )
        ]
    return result


def _accelerometer_object(device: str, name: str, required: Floats, reached: Floats) -> dict[str, Any]:
    """Return the required and reached sigmas (7,) of states and place of an accelerometer for --json.

    Those of states are by key, those of the place lists of three, in m; None for an infinite one (not required).
    """
    return {
        "device": device,
        "name": name,
        "required": dict(zip(ACCELEROMETER.keys, json_object(required[:4]), strict=True)),
        "sd": dict(zip(ACCELEROMETER.keys, json_object(reached[:4]), strict=True)),
        "required_place_m": json_object(required[4:]),
        "place_sd_m": json_object(reached[4:]),
    }
