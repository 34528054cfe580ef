"""What a script will show of accelerometers, as --json prints it."""

from collections.abc import Mapping
from dataclasses import dataclass

from estimator.calibration.accelerometer import AccelerometerCalibration
from estimator.sensors.accelerometers import ACCELEROMETER
from station.bench.bench import ForceLimits
from station.opening.planned_forces import PlannedForces
from station.views.json_values import json_object

DETECTED = 4.2
"""Standard deviations of an effect that is detected in 95 % of runs at 1 % false alarms."""


@dataclass(kw_only=True, frozen=True, slots=True)
class PlannedAccelerometer:
    """Predicted standard deviations of the states of an accelerometer, by name, and of its place (x, y, z)."""

    name: str
    sd: Mapping[str, float | None]
    place_sd_m: tuple[float | None, ...]


@dataclass(kw_only=True, frozen=True, slots=True)
class PlannedForcesView:
    """The accelerometers of a device, and by effect the least size of each of its parameters that is detected.

    ``missed`` names the accelerometers, and the lever arm, that do not reach the required standard deviations.
    """

    device: str
    accelerometers: tuple[PlannedAccelerometer, ...]
    detected: Mapping[str, tuple[float | None, ...]]
    notes: tuple[str, ...]
    missed: tuple[str, ...] = ()


def planned_forces_view(planned: PlannedForces, limits: ForceLimits) -> PlannedForcesView:
    """Return the view of what a script shows of the accelerometers of a device, in SI; infinite numbers are None.

    ``limits`` are those of the bench.
    """
    return PlannedForcesView(
        device=planned.device,
        accelerometers=tuple(map(planned_accelerometer, planned.calibration.accelerometers)),
        detected={name: tuple(json_object(DETECTED * sd)) for name, sd in planned.effects.items()},
        notes=planned.notes,
        missed=planned.missed(limits),
    )


def planned_accelerometer(accelerometer: AccelerometerCalibration) -> PlannedAccelerometer:
    """Return the view of the predicted standard deviations of an accelerometer, in SI; infinite ones are None."""
    return PlannedAccelerometer(
        name=accelerometer.name,
        sd=dict(zip(ACCELEROMETER.keys, json_object(accelerometer.sd), strict=True)),
        place_sd_m=tuple(json_object(accelerometer.place_sd_m)),
    )
