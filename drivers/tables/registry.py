"""The protocols of tables, by their name in bench files, those of devices.toml first."""

from drivers.packaged import packaged_toml
from drivers.plugins import Registry
from drivers.specs import TableSpec

TABLES = Registry(TableSpec, "turntable_station.tables", packaged_toml("drivers", "devices.toml")["tables"])
"""Built in and installed ones; a bench file brings its own beside them."""

USUAL_TABLE = "modbus"
"""What is meant where nothing is said."""
