"""What a script will show of gyros and accelerometers under all of the noise, fast enough for a search."""

from dataclasses import dataclass

import numpy as np

from drivers.types import Floats
from estimator.calibration.budget import table_budget
from estimator.estimation.accelerometers.laws import counted_angles_law
from estimator.geometry.array import accelerometer_array, accelerometer_axes, accelerometer_names
from estimator.geometry.kinematics import body_rate
from estimator.geometry.model import regressor_maps
from estimator.planning.force_planning import PlannedAccelerometers, force_covariances
from estimator.planning.planning import weighing
from station.bench.bench import Bench
from station.bench.imu import ImuConfig
from station.scripts.planned import PlannedMotion, planned_motion
from station.scripts.script import Script

_PERIOD_S, _COARSE_S = 0.05, 0.1
_MOST_ROWS = 50_000


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Prediction:
    """Covariances of the states of n gyros (n, 4, 4), and of [states, place] of m accelerometers (m, 7, 7)."""

    gyros: Floats
    accelerometers: Floats

    @property
    def gyro_sd(self) -> Floats:
        """The sigmas (n, 4) of the states of the gyros."""
        return np.asarray(np.sqrt(np.diagonal(self.gyros, axis1=1, axis2=2)))

    @property
    def accelerometer_sd(self) -> Floats:
        """The sigmas (m, 7) of states and places of the accelerometers."""
        return np.asarray(np.sqrt(np.diagonal(self.accelerometers, axis1=1, axis2=2)))


def predict(script: Script, bench: Bench, *, coarse: bool = False) -> Prediction:
    """Return the covariances predicted for a run of the script on the used devices of a bench: noise and table.

    The script is taken as it is, without a look at the limits of the table.

    Covariances of gyros equal those of ``station.scripts.plan.make_plan`` without the effects that it adds.
    Accelerometers are only those of devices that state a data sheet for them. ``coarse``: in longer steps, and without
    what the resolution of encoders adds.
    """
    step_s = max(_COARSE_S if coarse else _PERIOD_S, script.least_s / _MOST_ROWS)
    motion = planned_motion(script, bench.table.gimbals, step_s)
    used = [imu for imu in bench.imus if imu.used]
    gyros = [_gyro_covariances(motion, bench, imu, step_s) for imu in used]
    forces = [_force_covariances(motion, bench, imu, step_s, coarse) for imu in used if imu.force_sheet is not None]
    return Prediction(
        gyros=np.concatenate(gyros), accelerometers=np.concatenate(forces) if forces else np.zeros((0, 7, 7))
    )


def _gyro_covariances(motion: PlannedMotion, bench: Bench, imu: ImuConfig, period_s: float) -> Floats:
    """Return the covariances (g, 4, 4) of the states of the gyros of a device: noise and table.

    ``period_s`` is that of the motion's instants.
    """
    w = body_rate(motion.angle_rad, motion.rate_rps, motion.gimbals, bench.site)
    columns = np.column_stack([np.ones(len(w)), w])
    maps = regressor_maps(imu.array)
    arw = np.full(len(imu.array), imu.noise.arw)
    seen = weighing(motion.t_s, period_s, imu.noise)(columns)
    own = np.linalg.inv(maps @ seen @ maps.transpose(0, 2, 1) + np.diag(1 / imu.prior.variances()))
    readings = motion.readings(bench.table.uncertainty)
    budget = table_budget(readings, bench.site, imu.array, imu.prior, arw)
    return np.array(
        [covariance + sum(part.covariance for part in parts) for covariance, parts in zip(own, budget, strict=True)]
    )


def _force_covariances(motion: PlannedMotion, bench: Bench, imu: ImuConfig, period_s: float, coarse: bool) -> Floats:
    """Return the covariances (a, 7, 7) of states and places of the accelerometers of a device.

    ``period_s`` is that of the motion's instants. ``coarse`` leaves out the rounding of angles to counts, which takes
    long.
    """
    sheet = imu.force_sheet
    assert sheet is not None
    device = PlannedAccelerometers(
        array=accelerometer_array(accelerometer_axes(imu.array, imu.mounting.axes), imu.array),
        prior=sheet.prior,
        table=bench.table.uncertainty,
    )
    conditions = motion.conditions(None, bench.site)
    resolutions = [bench.table.limits[axis].resolution_rad for axis in motion.gimbals]
    counts_rad = np.array([resolution_rad or np.inf for resolution_rad in resolutions])
    law = None if coarse else counted_angles_law(motion.readings(bench.table.uncertainty), counts_rad)
    return force_covariances(conditions, device, weighing(motion.t_s, period_s, sheet.noise), law)


def accelerometer_rows(bench: Bench) -> tuple[tuple[str, str], ...]:
    """Return (device, accelerometer) of each accelerometer that ``predict`` looks at, in its order."""
    return tuple(
        (imu.name, name)
        for imu in bench.imus
        if imu.used and imu.force_sheet is not None
        for name in accelerometer_names(3)
    )
