"""Rate gyros."""

from estimator.sensors.kind import SensorKind, State

GYRO = SensorKind(
    name="gyro",
    plural="gyros",
    input="body rate",
    unit="rad/s",
    white_unit="rad/s/rtHz",
    states=(
        State(key="k", symbol="k", meaning="scale factor error", unit="1"),
        State(key="b_rps", symbol="b", meaning="bias", unit="rad/s"),
        State(key="sigma_j_rad", symbol="sigma_j", meaning="misalignment", unit="rad"),
        State(key="sigma_k_rad", symbol="sigma_k", meaning="misalignment", unit="rad"),
    ),
)
