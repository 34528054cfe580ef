"""The protocols of tables, by the name that a bench file gives them: one line each."""

from drivers.plugins import Registry
from drivers.specs import TableSpec

TABLES = Registry(
    TableSpec,
    "turntable_station.tables",
    {
        "modbus": "drivers.tables.modbus.spec",
        "galil": "drivers.tables.galil.table",
        "acutrol": "drivers.tables.acutrol.table",
        "aerosmith": "drivers.tables.aerosmith.table",
    },
)
"""Built in and installed ones; a bench file brings its own beside them."""

USUAL_TABLE = "modbus"
"""What is meant where nothing is said."""
