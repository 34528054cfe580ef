"""What a script will show of accelerometers, for JSON."""

from typing import Any

from estimator.sensors.accelerometers import ACCELEROMETER
from station.opening.planned_forces import PlannedForces
from station.views.json_values import json_object

DETECTED = 4.2
"""Standard deviations of an effect that is detected in 95 % of runs at 1 % false alarms."""


def planned_object(one: PlannedForces) -> dict[str, Any]:
    """Return the predicted sigmas of the accelerometers of a device, and the least size of each effect, in SI."""
    found: dict[str, Any] = json_object(
        {
            "device": one.device,
            "accelerometers": [
                {
                    "name": a.name,
                    "sd": dict(zip(ACCELEROMETER.keys, a.sd.tolist(), strict=True)),
                    "place_sd_m": a.place_sd_m,
                }
                for a in one.found.accelerometers
            ],
            "detected": {name: DETECTED * sd for name, sd in one.effects.items()},
            "notes": one.notes,
        }
    )
    return found
