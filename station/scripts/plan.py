"""The prediction of what a script shows on a bench, before anything moves."""

from dataclasses import dataclass

import numpy as np

from drivers.types import Flags, Floats
from estimator.calibration.budget import table_budget
from estimator.effects.catalogue import catalogue
from estimator.effects.conditions import REFERENCE_C
from estimator.effects.effect import Effect
from estimator.observations.coverage import AxisCoverage
from estimator.planning.planning import Forecast, PlannedDevice, forecast
from station.bench.bench import Bench
from station.scripts.early_late import planned_constancy
from station.scripts.planned import PlannedMotion, planned_motion
from station.scripts.script import Script, check, rounded

TEMPERATURE_RISE_K = 8.0
WARMING_TIME_S = 1200.0
"""Time constant of the assumed warming: of a table's chamber and its electronics, over after an hour."""
_PERIOD_S = 0.05
_MOST_ROWS = 72_000  # an hour of them; longer scripts use coarser steps


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class Plan:
    """A script on a bench, its motion and its forecast.

    ``table_sd`` (gyros, 4) is the contribution of the table's stated uncertainty to the sigmas of the states,
    ``required`` (4,) the sigmas that the bench requires, infinite where none. ``temperature_rise_k`` is assumed.
    ``rounded`` has a sentence on accelerations that the controller rounds down.
    """

    script: Script
    bench: Bench
    motion: PlannedMotion
    forecast: Forecast
    table_sd: Floats
    required: Floats
    temperature_rise_k: float
    rounded: tuple[str, ...] = ()

    @property
    def sd(self) -> Floats:
        """Predicted sigmas of the states (gyros, 4), the table's uncertainty included."""
        return np.asarray(np.hypot(np.array([gyro.sd for gyro in self.forecast.gyros]), self.table_sd))

    @property
    def constancy(self) -> tuple[AxisCoverage, ...]:
        """Time over which a run can prove constancy, by axis."""
        return planned_constancy(self.script, self.bench.table.gimbals)

    @property
    def proves_constancy(self) -> bool:
        """Whether every axis is turned far apart in time; also true for a script without turns."""
        return all(axis.proved for axis in self.constancy)

    @property
    def reached(self) -> Flags:
        """Whether each sigma (gyros, 4) is within the bench's requirement."""
        return np.asarray(self.sd <= self.required)


def make_plan(
    script: Script,
    bench: Bench,
    *,
    temperature_rise_k: float = TEMPERATURE_RISE_K,
    effects: tuple[Effect, ...] | None = None,
) -> Plan:
    """Return the plan for the used devices of a bench: the motion, and what it will show of their gyros.

    ``effects`` are those to forecast, by default all of the catalogue. The temperature is taken to rise by
    ``temperature_rise_k`` exponentially. The script is planned as the controller carries it out; ScriptError if the
    table cannot do it.
    """
    asked, script = script, check(script, bench.table.limits)
    motion = planned_motion(script, bench.table.gimbals, max(_PERIOD_S, script.least_s / _MOST_ROWS))
    temperature_c = REFERENCE_C - temperature_rise_k * np.expm1(-motion.t_s / WARMING_TIME_S)
    conditions = motion.conditions(temperature_c, bench.site)
    devices = [PlannedDevice(imu.name, imu.array, imu.noise, imu.prior) for imu in bench.imus if imu.used]
    if effects is None:
        effects = catalogue(motion.gimbals, script.least_s)
    return Plan(
        script=script,
        bench=bench,
        motion=motion,
        forecast=forecast(conditions, devices, effects),
        table_sd=_table_sd(motion, bench, devices),
        required=np.array(bench.limits.sds),
        temperature_rise_k=temperature_rise_k,
        rounded=tuple(rounded(asked, script)),
    )


def _table_sd(motion: PlannedMotion, bench: Bench, devices: list[PlannedDevice]) -> Floats:
    """Return the sigmas of the states (gyros, 4) that come from the table's stated uncertainty; 0 if none is stated."""
    readings = motion.readings(bench.table.uncertainty)
    variances = [
        np.sum([np.diag(part.covariance) for part in parts], axis=0) if parts else np.zeros(4)
        for device in devices
        for parts in table_budget(
            readings, bench.site, device.array, device.prior, np.full(len(device.array), device.noise.arw)
        )
    ]
    return np.asarray(np.sqrt(np.array(variances)))
