"""station plan --improve: finds a script that reaches given sigmas sooner, or lower ones in a given time."""

import argparse
import json
import math
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from drivers.types import Floats
from estimator.calibration.budget import table_budget
from estimator.geometry.kinematics import body_rate
from estimator.geometry.model import regressor_maps
from estimator.observations.rows import BLOCK_S
from estimator.planning.planning import UNSEEN, weighing
from station.atomic_write import check_new_file, free_path, write_whole
from station.bench.bench import Bench
from station.bench.imu import ImuConfig
from station.errors import UsageError, sentence
from station.render.lines import tell
from station.render.plans.improved import print_improved
from station.render.template import rendered
from station.run.outcome import Outcome
from station.schema.quantities import QuantityError, parse
from station.scripts.plan import make_plan
from station.scripts.planned import planned_motion
from station.scripts.script import Script, check
from station.scripts.script_family import ways_of
from station.scripts.script_search import LONGEST_S, Needs, Search, sds_of
from station.views.figures import STATE_FIGURES
from station.views.improved import Improved, Wanted
from station.views.json_values import by_state

NAMES = {"k": (0,), "b": (1,), "sigma": (2, 3), "sigma_j": (2,), "sigma_k": (3,)}
"""What --states may list: columns of the states."""
DEFAULT_FILE = "improved.toml"
_PERIOD_S = 0.05
_MOST_ROWS = 50_000
_MOST_NAMED = 4
_TABLE_LIMITS = "the uncertainty of the table ([table.uncertainty])"
_NOISE_LIMITS = "noise that does not average out (bias_instability, rate_random_walk of the data sheet)"


def improve(arguments: argparse.Namespace, bench: Bench, script: Script) -> int:
    """Search a better script than this one and write it; return 1 if the sigmas cannot be reached, else 0.

    UsageError for wrong options or an existing file, ScriptError if the found script exceeds the travel of an axis.
    """
    began_s = time.perf_counter()
    wanted = _wanted(arguments, bench, script)
    path = Path(arguments.output) if arguments.output else free_path(Path(DEFAULT_FILE))
    check_new_file(path, "--output")
    say = Console(stderr=True, quiet=arguments.json)
    search = search_of(bench, wanted, lambda text: say.print(f"[dim]{text}[/]", highlight=False))
    found = search.least_time() if wanted.total_s is None else search.least_sigmas(wanted.total_s)
    gyros = tuple((imu.name, gyro) for imu in _used(bench) for gyro in imu.array.names)
    if found is None:
        return _refuse(_why_not(search, bench, wanted, gyros), arguments.json)
    check(found.script, bench.table.limits)
    search_s = time.perf_counter() - began_s
    improved = Improved(before=script, wanted=wanted, found=found, gyros=gyros, search_s=search_s)
    write_whole(path, script_text(found.script, _origin(improved, bench)))
    notes = _notes(bench, path)
    if arguments.json:
        print(json.dumps({**improved_object(improved, path), "notes": notes}))
    else:
        print_improved(improved, path, bench.units)
        for note in notes:
            tell(note, sys.stdout)
    return Outcome.PASS.exit_code


def _notes(bench: Bench, path: Path) -> list[str]:
    """Return what the search did not look at."""
    if all(imu.force_sheet is None for imu in _used(bench)):
        return []
    return [sentence("script.improve_gyros_alone", path=path)]


def search_of(bench: Bench, wanted: Wanted, on_progress: Callable[[str], None]) -> Search:
    """Return the search for a script for the bench's used devices."""
    imus = _used(bench)
    needs = Needs(
        maps=np.vstack([regressor_maps(imu.array) for imu in imus]),
        arw=np.concatenate([np.full(len(imu.array), imu.noise.arw) for imu in imus]),
        prior=np.vstack([np.tile(imu.prior.variances(), (len(imu.array), 1)) for imu in imus]),
        sd=wanted.sd,
    )
    return Search(
        needs,
        bench.table.limits,
        bench.table.gimbals,
        wanted.rest_s,
        lambda script: predicted(script, bench),
        criterion=wanted.criterion,
        gentle_rps2=_gentle_rps2(bench),
        coloured=any(imu.noise.instability > 0 or imu.noise.walk > 0 for imu in imus),
        one_directional=wanted.one_way,
        on_progress=on_progress,
    )


def predicted(script: Script, bench: Bench) -> Floats:
    """Return the covariances (n, 4, 4) of the states predicted for a run of the script: noise and table.

    They equal those of ``station.scripts.plan.make_plan`` without the effects that it adds.
    """
    period_s = max(_PERIOD_S, script.least_s / _MOST_ROWS)
    motion = planned_motion(script, bench.table.gimbals, period_s)
    w = body_rate(motion.angle_rad, motion.rate_rps, motion.gimbals, bench.site)
    columns = np.column_stack([np.ones(len(w)), w])
    readings = motion.readings(bench.table.uncertainty)
    covariances = []
    for imu in _used(bench):
        maps, arw = regressor_maps(imu.array), np.full(len(imu.array), imu.noise.arw)
        seen = weighing(motion.t_s, period_s, imu.noise)(columns)
        own = np.linalg.inv(maps @ seen @ maps.transpose(0, 2, 1) + np.diag(1 / imu.prior.variances()))
        for covariance, parts in zip(own, table_budget(readings, bench.site, imu.array, imu.prior, arw), strict=True):
            covariances.append(covariance + sum(part.covariance for part in parts))
    return np.array(covariances)


def _gentle_rps2(bench: Bench) -> float:
    """Return the acceleration at which the corners of a ramp, missed between two readings, are lost in the noise.

    A rate interpolated over a corner at a share f of the time h between readings misses an angle a h^2 f (1 - f) / 2,
    in the mean square over f a h^2 / sqrt(120); the noise is that of one block of the live filter.
    """
    noise_rad = min(imu.noise.arw for imu in _used(bench)) * math.sqrt(BLOCK_S)
    return noise_rad * math.sqrt(120) * bench.table.poll_rate_hz**2


def _used(bench: Bench) -> list[ImuConfig]:
    used = [imu for imu in bench.imus if imu.used]
    if not used:
        raise UsageError("the bench file uses no device. Set used = true, or name one with --device")
    return used


def _wanted(arguments: argparse.Namespace, bench: Bench, script: Script) -> Wanted:
    """Return the goal of the options; UsageError if one is out of range, or no sigma is required that the script
    shows.
    """
    margin, rest_s = quantity(arguments, "margin", "ratio"), quantity(arguments, "rest", "time")
    if not 0 <= margin < 1 or not 1 <= rest_s <= LONGEST_S / 4:
        raise UsageError('--margin must be from "0 %" to below "100 %", --rest "1 s" or more')
    columns = _columns(arguments.states)
    if arguments.sigmas == "bench":
        sd = np.tile(bench.limits.sds, (sum(len(imu.array) for imu in _used(bench)), 1))
    else:
        plan = make_plan(script, bench, effects=())
        promised = np.array([gyro.prior_sd for gyro in plan.forecast.gyros])
        sd = np.where(plan.sd > UNSEEN * promised, np.inf, plan.sd)  # a state that is not shown is not reached
    sd = np.where(np.isin(np.arange(4), columns), sd * (1 - margin), np.inf)
    if not np.isfinite(sd).any():
        raise UsageError(
            "nothing to reach: the bench requires none of these sigmas ([limits], sd_...)"
            if arguments.sigmas == "bench"
            else f"nothing to reach: {script.name} shows none of these states"
        )
    total_s = None if arguments.time_given is None else quantity(arguments, "time_given", "time")
    if total_s is not None and not 0 < total_s <= LONGEST_S:
        raise UsageError(f"--for {arguments.time_given}: give a time above 0 s and up to {LONGEST_S / 3600:g} h")
    return Wanted(sd=sd, total_s=total_s, rest_s=rest_s, criterion=arguments.criterion, one_way=arguments.one_way)


def quantity(arguments: argparse.Namespace, option: str, kind: str) -> float:
    """Return the value of an option in SI; UsageError if it is not a quantity of that kind."""
    try:
        return parse(getattr(arguments, option), kind)
    except QuantityError as error:
        name = "for" if option == "time_given" else option.replace("_", "-")
        raise UsageError(f"--{name} {error}") from None


def _columns(text: str) -> list[int]:
    names = [name.strip() for name in text.split(",")]
    wrong = [name for name in names if name not in NAMES]
    if wrong:
        raise UsageError(f"--states {text}: {wrong[0]!r} is not one of {', '.join(NAMES)}")
    return sorted({column for name in names for column in NAMES[name]})


def _why_not(search: Search, bench: Bench, wanted: Wanted, gyros: tuple[tuple[str, str], ...]) -> str:
    """Return the text that says which sigmas cannot be reached, and what limits them."""
    if wanted.total_s is not None:
        return f"{wanted.total_s:g} s is too short for the rests and a turn about each axis. Allow more time"
    missed = search.unreachable()
    if missed.any():
        cause = _limit_of_motion(bench)
    else:
        longest = search.longest()
        missed = sds_of(search.predict(longest)) > wanted.sd
        table_sd = make_plan(longest, bench, effects=()).table_sd
        cause = _TABLE_LIMITS if bool((table_sd > wanted.sd).any()) else _NOISE_LIMITS
    names = [f"{gyros[row][1]} {STATE_FIGURES[state].name}" for row, state in np.argwhere(missed)]
    others = len(names) - _MOST_NAMED
    more = f" and {others} more" if others > 0 else ""
    return f"cannot be reached: sigma of {', '.join(names[:_MOST_NAMED])}{more}. Cause: {cause}"


def _limit_of_motion(bench: Bench) -> str:
    """Return why no motion of a table without errors reaches the sigmas."""
    axes = bench.table.gimbals
    directions = np.array([way.direction for way in ways_of(axes, (0.0, math.pi / 2))])
    if np.linalg.matrix_rank(directions) < 3:
        return f"the table turns the body about too few axes (it has axis {', '.join(axes)})"
    return f"the rate limits of the axes and the white noise, even in {LONGEST_S / 3600:g} h"


def _origin(improved: Improved, bench: Bench) -> str:
    """Return the comment at the top of the script found: what it was found for, and how long it lasts."""
    wanted = improved.wanted
    aim = "shortest time to its sigmas"
    if wanted.total_s is not None:
        aim = f"smallest sigmas in {wanted.total_s:g} s"
    lines = [
        f"Found by station plan --improve for the bench {bench.name!r}, criterion {wanted.criterion}: {aim}.",
        f"{improved.found.script.least_s:.1f} s; {improved.before.name} takes {improved.before.least_s:.1f} s.",
        f"It rests {wanted.rest_s:g} s at both ends, to separate noise from motion.",
    ]
    return "\n".join(lines)


def _refuse(reason: str, as_json: bool) -> int:
    tell(f"station: {reason}", sys.stderr)
    if as_json:
        print(json.dumps({"reached": False, "reason": reason, "script": None}))
    return Outcome.FAIL.exit_code


def script_text(script: Script, origin: str) -> str:
    """Return a script as TOML that ``station.scripts.script.load_script`` reads; ``origin`` is its first comment."""
    steps = []
    for timed in script.timeline():
        lines = (*timed.step.written(timed.span.least_s), f"label = {_quoted(timed.step.label)}")
        steps.append("\n".join(("[[step]]", *lines)))
    values = {"origin": origin.splitlines(), "name": _quoted(script.name), "steps": steps}
    return rendered("station.commands", "script.toml", values)


def _quoted(text: str) -> str:
    """Return a text as a TOML string: that of JSON, with one more character escaped."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def improved_object(improved: Improved, path: Path) -> dict[str, Any]:
    """Return the script found for --json, in SI; null where nothing was required."""
    script, before = improved.found.script, improved.before
    return {
        "reached": bool((improved.found.sd <= improved.wanted.sd).all()),
        "script": str(path),
        "duration_s": script.least_s,
        "duration_with_sequencer_s": improved.with_sequencer_s,
        "before": {"script": before.name, "duration_s": before.least_s},
        "criterion": improved.wanted.criterion,
        "compared": improved.found.compared,
        "search_s": improved.search_s,
        "gyros": [
            {
                "device": device,
                "name": name,
                "required": by_state(needed),
                "sd": by_state(reached),
            }
            for (device, name), needed, reached in zip(
                improved.gyros, improved.wanted.sd, improved.found.sd, strict=True
            )
        ],
        "steps": [{"label": timed.step.label, "duration_s": timed.span.least_s} for timed in script.timeline()],
    }
