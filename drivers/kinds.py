"""The kinds of devices by the name of their section in the bench file, those of devices.toml first."""

from drivers.kind import DeviceKind
from drivers.packaged import packaged_toml
from drivers.plugins import Registry

KINDS = Registry(DeviceKind, "turntable_station.kinds", packaged_toml("drivers", "devices.toml")["kinds"])
"""Built in and installed ones; a bench file brings its own beside them."""
