"""The searches for a script for the used devices of a bench: for gyros alone, or with accelerometers."""

import math
from collections.abc import Callable

import numpy as np

from estimator.geometry.model import regressor_maps
from estimator.observations.rows import BLOCK_S
from station.bench.bench import Bench
from station.bench.imu import ImuConfig
from station.errors import UsageError
from station.scripts.prediction import predict
from station.scripts.script_family import ways_of
from station.scripts.script_search import Needs, Search
from station.scripts.whole_imu.family import spanning, ways_within
from station.scripts.whole_imu.search import JointNeeds, WholeImuSearch
from station.views.improved import Wanted

_GYRO_WAYS = 2


def search_of(bench: Bench, wanted: Wanted, on_progress: Callable[[str], None]) -> Search:
    """Return the search for a script for the gyros of the bench's used devices; UsageError if none is used.

    ``on_progress`` gets a line of text now and then.
    """
    imus = used_imus(bench)
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


def whole_imu_search(bench: Bench, wanted: Wanted, on_progress: Callable[[str], None]) -> WholeImuSearch:
    """Return the search for a script for gyros and accelerometers of the bench's used devices.

    It tries one set of turns, about as many directions as the table has, and, if sigmas of gyros are wanted, the two
    sets best for gyros alone. Turns beyond the travel of an axis are left out. ``on_progress`` gets a line of text now
    and then.
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


def _gentle_rps2(bench: Bench) -> float:
    """Return the acceleration at which the corners of a ramp, missed between two readings, are lost in the noise.

    A rate interpolated over a corner at a share f of the time h between readings misses an angle a h^2 f (1 - f) / 2,
    in the mean square over f a h^2 / sqrt(120); the noise is that of one block of the live filter.
    """
    noise_rad = min(imu.noise.arw for imu in used_imus(bench)) * math.sqrt(BLOCK_S)
    return noise_rad * math.sqrt(120) * bench.table.poll_rate_hz**2


def used_imus(bench: Bench) -> list[ImuConfig]:
    used = [imu for imu in bench.imus if imu.used]
    if not used:
        raise UsageError("the bench file uses no device. Set used = true, or name one with --device")
    return used
