"""The protocols of devices under test, by the name that a bench file gives them: one line each."""

from drivers.plugins import Registry
from drivers.specs import ImuSpec

IMUS = Registry(
    ImuSpec,
    "turntable_station.imus",
    {
        "can": "drivers.imus.can.imu",
        "described": "drivers.imus.described.imu",
        "j1939": "drivers.imus.aceinna.imu",
        "stim300": "drivers.imus.stim300.imu",
        "vectornav": "drivers.imus.vectornav.imu",
        "xsens": "drivers.imus.xsens.imu",
    },
)
"""Built in and installed ones; a bench file brings its own beside them."""

USUAL_IMU = "stim300"
"""What is meant where nothing is said."""
