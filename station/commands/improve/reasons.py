"""Why no better script was found, in words."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from drivers.types import Flags
from estimator.sensors.accelerometers import ACCELEROMETER
from station.bench.bench import Bench
from station.commands.improve.searches import used_imus
from station.errors import sentence
from station.scripts.plan import make_plan
from station.scripts.prediction import accelerometer_rows, predict
from station.scripts.script import Script, check, is_possible
from station.scripts.script_family import ways_of
from station.scripts.script_search import LONGEST_S, FoundScript, Search, sds_of
from station.scripts.whole_imu.search import JointNeeds, WholeImuSearch
from station.views.figures import STATE_FIGURES
from station.views.improved import Wanted

_MOST_NAMED = 4
_TABLE_LIMITS = "the uncertainty of the table ([table.uncertainty])"
_GRAVITY_LIMITS = "local gravity is known to 50 ppm by latitude and height. State a measured one ([site] gravity)"
_NOISE_LIMITS = "noise that does not average out (bias_instability, rate_random_walk of the data sheet)"
_PARAMETER_NAMES = (*(state.symbol for state in ACCELEROMETER.states), *(f"place {axis}" for axis in "xyz"))
_DIRECTIONS = 3
_MARGINAL = 0.05  # logarithm of a sigma by which a script may miss the margin below its own sigmas
_DECIDES = 0.99  # share of its requirement from which on a sigma decides how long a script is


def unreached_gyros_text(search: Search, bench: Bench, wanted: Wanted, gyros: tuple[tuple[str, str], ...]) -> str:
    """Return why no script was found: the time is too short, or which sigmas cannot be reached and what limits them.

    It is always the time if one is given. ``gyros`` are device and name of each, of which names are used; the cause is
    the motion, the table or the noise.
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


def unreached_sensors_text(search: WholeImuSearch, bench: Bench) -> str:
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


def no_gain_text(search: WholeImuSearch, found: FoundScript, script: Script, bench: Bench) -> str:
    """Return the text that says that the given script is as good as the one found, or better; "" if it is not.

    Also "" if the table cannot drive the given script. With a stated time it has to be within that and of no higher
    cost; else it has to be no longer and reach all sigmas, but for a margin.
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

    They are separated by commas; "" if none is flagged. Of each kind only the first few are named, then how many more
    there are.
    """
    gyro_names = [name for imu in used_imus(bench) for name in imu.array.names]
    rows = accelerometer_rows(bench)
    kinds = (
        [f"{gyro_names[row]} {STATE_FIGURES[state].name}" for row, state in np.argwhere(gyros)],
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
