"""All kinds of sensor, by name."""

from estimator.sensors.accelerometers import ACCELEROMETER
from estimator.sensors.gyros import GYRO
from estimator.sensors.kind import SensorKind

KINDS: dict[str, SensorKind] = {kind.name: kind for kind in (GYRO, ACCELEROMETER)}
