"""What runs of a script in three mountings show together on a table of one axis."""

from dataclasses import dataclass, replace

import numpy as np

from estimator.calibration.values import Calibration
from estimator.effects.catalogue import records
from estimator.errors import EstimatorError
from estimator.estimation.mountings.join import join_mountings
from station.bench.bench import Bench
from station.bench.imu import ImuConfig
from station.opening.planned_forces import simulated_run
from station.scripts.script import Script


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlannedMountings:
    """The joined calibration of a device that has the sigmas of three runs; its values are those without errors."""

    device: str
    calibration: Calibration


def planned_mountings(script: Script, bench: Bench) -> list[PlannedMountings]:
    """Return what a script shows of each used device with x, then y, then z along the axis of a table that has one.

    Empty for tables of more axes. Left out are devices that state no data sheet for their accelerometers, and those for
    which the script is too short.
    """
    if len(bench.table.gimbals) > 1:
        return []
    planned = []
    for imu in bench.imus:
        if not imu.used or imu.force_sheet is None:
            continue
        try:
            planned.append(_planned(script, bench, imu))
        except EstimatorError:  # too short: the plan of one mounting says so
            continue
    return planned


def _planned(script: Script, bench: Bench, imu: ImuConfig) -> PlannedMountings:
    """Return what a script shows of one device; EstimatorError if it is too short.

    The three mountings follow from the stated one by cyclic exchange of the axes.
    """
    recordings = []
    for number in range(3):
        axes = np.roll(np.eye(3), number, axis=0) @ imu.mounting.axes
        mounting = replace(imu.mounting, axes=axes)
        turned = replace(imu, array=imu.own_array.turned(axes), mounting=mounting)
        run = simulated_run(script, bench, turned)
        sources = {name: replace(data, mounting=mounting) for name, data in run.sources.items()}
        recordings.append(replace(run, sources=sources))
    excluded = frozenset(record.name for record in records())  # as in the plan of one mounting
    joined = join_mountings(recordings, excluded=[excluded] * len(recordings), innovations=False)
    return PlannedMountings(device=imu.name, calibration=joined.calibration)
