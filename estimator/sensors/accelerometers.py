"""Accelerometers."""

from estimator.sensors.kind import SensorKind, State

ACCELEROMETER = SensorKind(
    name="accelerometer",
    plural="accelerometers",
    input="specific force",
    unit="m/s2",
    white_unit="m/s2/rtHz",
    states=(
        State(key="k", symbol="k", meaning="scale factor error", unit="1"),
        State(key="b_mps2", symbol="b", meaning="bias", unit="m/s2"),
        State(key="sigma_j_rad", symbol="sigma_j", meaning="misalignment", unit="rad"),
        State(key="sigma_k_rad", symbol="sigma_k", meaning="misalignment", unit="rad"),
    ),
)
