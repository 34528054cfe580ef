"""The protocols of devices under test, by their name in bench files, those of devices.toml first."""

from drivers.packaged import packaged_toml
from drivers.plugins import Registry
from drivers.specs import ImuSpec

IMUS = Registry(ImuSpec, "turntable_station.imus", packaged_toml("drivers", "devices.toml")["imus"])
"""Built in and installed ones; a bench file brings its own beside them."""

USUAL_IMU = "stim300"
"""What is meant where nothing is said."""
