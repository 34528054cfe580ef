"""station plan --improve: finds a script that reaches given sigmas sooner, or lower ones in a given time."""

import argparse
import json
import math
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.markup import escape

from drivers.types import Flags, Floats
from estimator.geometry.model import regressor_maps
from estimator.observations.rows import BLOCK_S
from estimator.planning.force_planning import PARAMETERS
from estimator.planning.planning import UNSEEN
from estimator.sensors.accelerometers import ACCELEROMETER
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
from station.scripts.prediction import accelerometer_rows, predict
from station.scripts.script import Script, check, is_possible
from station.scripts.script_family import ways_of
from station.scripts.script_search import LONGEST_S, FoundScript, Needs, Search, sds_of
from station.scripts.whole_imu.family import spanning, ways_within
from station.scripts.whole_imu.search import JointNeeds, WholeImuSearch
from station.views.figures import STATE_FIGURES
from station.views.improved import Improved, Wanted
from station.views.json_values import by_state, json_object

NAMES = {"k": (0,), "b": (1,), "sigma": (2, 3), "sigma_j": (2,), "sigma_k": (3,), "arm": (4, 5, 6)}
"""What --states may list: columns of the states, and of the places of accelerometers."""
DEFAULT_FILE = "improved.toml"
_MOST_NAMED = 4
_MOST_POSES = 24
_GYRO_WAYS = 2
_TABLE_LIMITS = "the uncertainty of the table ([table.uncertainty])"
_GRAVITY_LIMITS = "local gravity is known to 50 ppm by latitude and height. State a measured one ([site] gravity)"
_PARAMETER_NAMES = (*(state.symbol for state in ACCELEROMETER.states), *(f"place {axis}" for axis in "xyz"))
_DIRECTIONS = 3
_MARGINAL = 0.05  # logarithm of a sigma by which a script may miss the margin below its own sigmas
_DECIDES = 0.99  # share of its requirement from which on a sigma decides how long a script is
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

    def on_progress(text: str) -> None:
        say.print(f"[dim]{escape(text)}[/]", highlight=False)

    accelerometers = accelerometer_rows(bench)
    if accelerometers:
        whole = whole_imu_search(bench, wanted, on_progress)
        found = whole.best()
    else:
        search = search_of(bench, wanted, on_progress)
        found = search.least_time() if wanted.total_s is None else search.least_sigmas(wanted.total_s)
    gyros = tuple((imu.name, gyro) for imu in _used(bench) for gyro in imu.array.names)
    if found is None:
        reason = _whole_why_not(whole, bench) if accelerometers else _why_not(search, bench, wanted, gyros)
        return _refuse(reason, arguments.json)
    check(found.script, bench.table.limits)
    if accelerometers and (reason := _no_gain(whole, found, script, bench)):
        return _refuse(reason, arguments.json)
    improved = Improved(
        before=script,
        wanted=wanted,
        found=found,
        gyros=gyros,
        accelerometers=accelerometers,
        search_s=time.perf_counter() - began_s,
    )
    write_whole(path, script_text(found.script, _origin(improved, bench)))
    if arguments.json:
        print(json.dumps(improved_object(improved, path)))
    else:
        print_improved(improved, path, bench.units)
    return Outcome.PASS.exit_code


def search_of(bench: Bench, wanted: Wanted, on_progress: Callable[[str], None]) -> Search:
    """Return the search for a script for the gyros of the bench's used devices.

    ``on_progress`` gets a line of text now and then.
    """
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
        lambda script: predict(script, bench).gyros,
        criterion=wanted.criterion,
        gentle_rps2=_gentle_rps2(bench),
        coloured=any(imu.noise.instability > 0 or imu.noise.walk > 0 for imu in imus),
        one_directional=wanted.one_way,
        on_progress=on_progress,
    )


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
    """Return the goal of the options: the sigmas to reach, by state, and the limits of the search.

    UsageError if an option is out of range, no sigma is required that the script shows, or ``--one-way`` meets
    accelerometers.
    """
    margin, rest_s = quantity(arguments, "margin", "ratio"), quantity(arguments, "rest", "time")
    if not 0 <= margin < 1 or not 1 <= rest_s <= LONGEST_S / 4:
        raise UsageError('--margin must be from "0 %" to below "100 %", --rest "1 s" or more')
    if not 0 <= arguments.poses <= _MOST_POSES:
        raise UsageError(f"--poses must be from 0 to {_MOST_POSES}")
    columns = _columns(arguments.states)
    sd, force_sd = _bench_sds(bench) if arguments.sigmas == "bench" else _script_sds(bench, script)
    sd = np.where(np.isin(np.arange(4), columns), sd, np.inf)
    force_sd = np.where(np.isin(np.arange(PARAMETERS), columns), force_sd, np.inf)
    if not np.isfinite(sd).any() and not np.isfinite(force_sd).any():
        raise UsageError(
            "nothing to reach: the bench requires none of these sigmas ([limits], sd_...)"
            if arguments.sigmas == "bench"
            else f"nothing to reach: {script.name} shows none of these states"
        )
    if arguments.one_way and len(force_sd):
        raise UsageError("--one-way is for gyros alone. Leave it out, as this bench has accelerometers")
    total_s = None if arguments.time_given is None else quantity(arguments, "time_given", "time")
    if total_s is not None and not 0 < total_s <= LONGEST_S:
        raise UsageError(f"--for {arguments.time_given}: give a time above 0 s and up to {LONGEST_S / 3600:g} h")
    wanted = Wanted(
        sd=sd,
        force_sd=force_sd,
        total_s=total_s,
        rest_s=rest_s,
        poses=arguments.poses,
        criterion=arguments.criterion,
        one_way=arguments.one_way,
    )
    if arguments.sigmas == "script" and len(force_sd):
        return _below_script(wanted, bench, margin)
    return replace(wanted, sd=sd * (1 - margin), force_sd=force_sd * (1 - margin))


def _bench_sds(bench: Bench) -> tuple[Floats, Floats]:
    """Return the sigmas that the bench requires: of gyros (n, 4), and of accelerometers (m, 7), no places."""
    gyros = np.tile(bench.limits.sds, (sum(len(imu.array) for imu in _used(bench)), 1))
    states = [bench.limits.forces.of_state(state)[2] for state in range(4)]
    return gyros, np.tile([*states, *[np.inf] * 3], (len(accelerometer_rows(bench)), 1))


def _script_sds(bench: Bench, script: Script) -> tuple[Floats, Floats]:
    """Return the sigmas that a script reaches: of gyros (n, 4) and of accelerometers (m, 7), infinite if not shown."""
    prediction = predict(check(script, bench.table.limits), bench)
    gyro_prior = [np.tile(np.sqrt(imu.prior.variances()), (len(imu.array), 1)) for imu in _used(bench)]
    force_prior = [
        np.tile([*np.sqrt(prior.variances()), *[math.hypot(prior.arm_m, prior.apart_m)] * 3], (3, 1))
        for prior in (imu.force_sheet.prior for imu in _used(bench) if imu.force_sheet is not None)
    ]
    forces = np.vstack([np.zeros((0, PARAMETERS)), *force_prior])
    return _shown(prediction.gyro_sd, np.vstack(gyro_prior)), _shown(prediction.accelerometer_sd, forces)


def _shown(sd: Floats, promised: Floats) -> Floats:
    """Return the sigmas, infinite where a script hardly betters what is promised: that state is not to be reached."""
    return np.asarray(np.where(sd > UNSEEN * promised, np.inf, sd))


def _below_script(wanted: Wanted, bench: Bench, margin: float) -> Wanted:
    """Return the goal, the sigmas of a script, each lowered by the margin.

    What gravity, the table and noise that does not average out add is in the sigmas of every script: no sigma has to be
    nearer than the margin to that of the longest script.
    """
    floor = predict(whole_imu_search(bench, wanted, lambda text: None).longest(), bench)
    return replace(
        wanted,
        sd=_lowered(wanted.sd, floor.gyro_sd, margin),
        force_sd=_lowered(wanted.force_sd, floor.accelerometer_sd, margin),
    )


def _lowered(sd: Floats, floor: Floats, margin: float) -> Floats:
    """Return the sigmas lowered by the margin, but not to less than the margin above the floor."""
    lowered = np.maximum(sd * (1 - margin), floor * (1 + margin))
    return np.asarray(np.where(np.isfinite(sd), lowered, np.inf))


def whole_imu_search(bench: Bench, wanted: Wanted, on_progress: Callable[[str], None]) -> WholeImuSearch:
    """Return the search for a script for gyros and accelerometers of the bench's used devices.

    It tries the first turns about as many directions as the table has and, if sigmas of gyros are wanted, those best
    for gyros alone. ``on_progress`` gets a line of text now and then.
    """
    gimbals = bench.table.gimbals
    turns = [spanning(ways_within(ways_of(gimbals, (0.0, math.pi / 2)), bench.table.limits))]
    if np.isfinite(wanted.sd).any():
        for ways in search_of(bench, wanted, lambda text: None).ways(wanted.total_s, _GYRO_WAYS):
            if len(ways_within(ways, bench.table.limits)) == len(ways) and set(ways) not in map(set, turns):
                turns.append(ways)
    return WholeImuSearch(
        needs=JointNeeds(gyro_sd=wanted.sd, force_sd=wanted.force_sd),
        ways=turns,
        limits=bench.table.limits,
        gimbals=gimbals,
        rest_s=wanted.rest_s,
        poses=wanted.poses,
        predict=lambda script, coarse: predict(script, bench, coarse=coarse),
        total_s=wanted.total_s,
        criterion=wanted.criterion,
        gentle_rps2=_gentle_rps2(bench),
        on_progress=on_progress,
    )


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
    """Return why no script was found: the time is too short, or which sigmas cannot be reached and what limits them.

    ``gyros`` are device and name of each; the cause is the motion, the table or the noise.
    """
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
    return _cannot(_listed(names), cause)


def _whole_why_not(search: WholeImuSearch, bench: Bench) -> str:
    """Return why no script was found: the time is too short, or which sigmas cannot be reached and what limits them.

    Checked in turn are the axes of the table, local gravity that is not measured, then noise or table. If the longest
    script would reach all, no family of scripts was found.
    """
    if search.total_s is not None:
        return f"{search.total_s:g} s is too short for the rests, the poses and a turn about each axis. Allow more time"
    longest = search.longest()
    reached = predict(longest, bench)
    needs = search.needs
    names = _names(reached.gyro_sd > needs.gyro_sd, reached.accelerometer_sd > needs.force_sd, bench)
    if not names:
        return sentence("script.improve_no_family", hours=LONGEST_S / 3600)
    if len(search.ways[0]) < _DIRECTIONS:
        return _cannot(names, _limit_of_motion(bench))
    if bench.site is not None and _reaches_with_known_gravity(longest, bench, needs):
        return _cannot(names, _GRAVITY_LIMITS)
    return _cannot(names, f"{_NOISE_LIMITS}, or {_TABLE_LIMITS}")


def _no_gain(search: WholeImuSearch, found: FoundScript, script: Script, bench: Bench) -> str:
    """Return the text that says that the given script is better than the one found; "" if it is not.

    Also "" if the table cannot drive the given script. With a stated time it has to be within that and of lower cost;
    else it has to be shorter and reach all sigmas, but for a margin.
    """
    if not is_possible(script, bench.table.limits):
        return ""
    given = predict(check(script, bench.table.limits), bench)
    needs = search.needs
    if search.total_s is None:
        if found.script.least_s < script.least_s or needs.excess(given).max() > _MARGINAL:
            return ""
        names = _names(found.sd > _DECIDES * needs.gyro_sd, found.force_sd > _DECIDES * needs.force_sd, bench)
        return sentence(
            "script.improve_no_gain",
            script=script.name,
            length_s=script.least_s,
            found_s=found.script.least_s,
            names=names or "the rests and poses that are left (--rest, --poses)",
        )
    reached = predict(check(found.script, bench.table.limits), bench)
    if script.least_s > search.total_s or needs.cost(given, search.criterion) > needs.cost(reached, search.criterion):
        return ""
    return sentence("script.improve_no_better", script=script.name, length_s=search.total_s)


def _names(gyros: Flags, accelerometers: Flags, bench: Bench) -> str:
    """Return the names of the flagged states of gyros (n, 4), and states and places of accelerometers (m, 7).

    Of each kind only the first few are named, then how many more there are.
    """
    own = [name for imu in _used(bench) for name in imu.array.names]
    rows = accelerometer_rows(bench)
    kinds = (
        [f"{own[row]} {STATE_FIGURES[state].name}" for row, state in np.argwhere(gyros)],
        [f"{rows[row][1]} {_PARAMETER_NAMES[column]}" for row, column in np.argwhere(accelerometers)],
    )
    return ", ".join(_listed(names) for names in kinds if names)


def _reaches_with_known_gravity(script: Script, bench: Bench, needs: JointNeeds) -> bool:
    """Return whether a script would reach all sigmas if gravity had been measured."""
    assert bench.site is not None
    site = replace(bench.site, gravity_mps2=bench.site.local_gravity_mps2)
    return bool(needs.excess(predict(script, replace(bench, site=site))).max() <= 0)


def _cannot(names: str, cause: str) -> str:
    """Return the text that these sigmas cannot be reached."""
    return f"cannot be reached: sigma of {names}. Cause: {cause}"


def _listed(names: Sequence[str]) -> str:
    """Return the first of some names, and how many more there are."""
    others = len(names) - _MOST_NAMED
    more = f" and {others} more" if others > 0 else ""
    return f"{', '.join(names[:_MOST_NAMED])}{more}"


def _limit_of_motion(bench: Bench) -> str:
    """Return why no motion of a table without errors reaches the sigmas."""
    axes = bench.table.gimbals
    directions = np.array([way.direction for way in ways_of(axes, (0.0, math.pi / 2))])
    if np.linalg.matrix_rank(directions) < 3:
        return f"the table turns the body about too few axes (it has axis {', '.join(axes)})"
    return f"the rate limits of the axes and the white noise, even in {LONGEST_S / 3600:g} h"


def _origin(improved: Improved, bench: Bench) -> str:
    """Return the comment at the top of the script: for which bench and goal it was found, its length and its rests."""
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
    """Return the script found for --json, in SI; null where nothing was required.

    Accelerometers are left out for a bench that has none.
    """
    script, before, found, wanted = improved.found.script, improved.before, improved.found, improved.wanted
    told = {
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
        told["accelerometers"] = [
            _accelerometer_object(device, name, needed, reached)
            for (device, name), needed, reached in zip(
                improved.accelerometers, wanted.force_sd, found.force_sd, strict=True
            )
        ]
    return told


def _accelerometer_object(device: str, name: str, required: Floats, reached: Floats) -> dict[str, Any]:
    """Return the required and reached sigmas (7,) of states and place of an accelerometer."""
    return {
        "device": device,
        "name": name,
        "required": dict(zip(ACCELEROMETER.keys, json_object(required[:4]), strict=True)),
        "sd": dict(zip(ACCELEROMETER.keys, json_object(reached[:4]), strict=True)),
        "required_place_m": json_object(required[4:]),
        "place_sd_m": json_object(reached[4:]),
    }
