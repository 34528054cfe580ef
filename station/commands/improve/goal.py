"""What a script is to reach: the sigmas of the bench, or those of another script less a margin."""

import argparse
import math
from dataclasses import replace

import numpy as np

from drivers.types import Floats
from estimator.planning.force_planning import PARAMETERS
from estimator.planning.planning import UNSEEN
from station.bench.bench import Bench
from station.commands.improve.searches import used_imus, whole_imu_search
from station.errors import UsageError
from station.schema.quantities import QuantityError, parse
from station.scripts.prediction import accelerometer_rows, predict
from station.scripts.script import Script, check
from station.scripts.script_search import LONGEST_S
from station.views.improved import Wanted

NAMES = {"k": (0,), "b": (1,), "sigma": (2, 3), "sigma_j": (2,), "sigma_k": (3,), "arm": (4, 5, 6)}
"""What --states may list: columns of the states, and of the places of accelerometers."""
_MOST_POSES = 24


def wanted_of(arguments: argparse.Namespace, bench: Bench, script: Script) -> Wanted:
    """Return the goal of the options: the sigmas to reach, by state, and the limits of the search.

    The sigmas are those of the bench or of ``script``, less a margin, and infinite for states that need not be reached.
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
    """Return the sigmas that the bench requires: of gyros (n, 4), and of accelerometers with their places (m, 7).

    They are infinite where none is required. Places as certain as the lever arm has to be make it at least as certain:
    it is their mean.
    """
    gyros = np.tile(bench.limits.sds, (sum(len(imu.array) for imu in used_imus(bench)), 1))
    limits = bench.limits.forces
    return gyros, np.tile([*limits.sds, *[limits.sd_arm_m] * 3], (len(accelerometer_rows(bench)), 1))


def _script_sds(bench: Bench, script: Script) -> tuple[Floats, Floats]:
    """Return the sigmas that a script reaches: of gyros (n, 4) and of accelerometers (m, 7).

    They are infinite where the script hardly betters the data sheet. ScriptError if the table cannot do it.
    """
    prediction = predict(check(script, bench.table.limits), bench)
    gyro_prior = [np.tile(np.sqrt(imu.prior.variances()), (len(imu.array), 1)) for imu in used_imus(bench)]
    force_prior = [
        np.tile([*np.sqrt(prior.variances()), *[math.hypot(prior.arm_m, prior.apart_m)] * 3], (3, 1))
        for prior in (imu.force_sheet.prior for imu in used_imus(bench) if imu.force_sheet is not None)
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
