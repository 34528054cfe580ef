"""The twins of tables, by the protocol that they speak: one entry each."""

from collections.abc import Callable

from drivers.plugins import PluginError
from drivers.specs import TableSpec
from drivers.tables.modbus.line import SerialPort
from sims.tables.acutrol_controller import AcutrolController
from sims.tables.aerosmith_controller import AerosmithController
from sims.tables.galil_controller import GalilController
from sims.tables.modbus import ModbusRtu, drives_by_unit
from sims.wires.line_controller import TableTwinSetup as TableTwinSetup
from sims.wires.wires import ByteDevice, Write

Seat = TableTwinSetup  # the name until 0.5.0, which plug-ins may import

TWINS: dict[str, Callable[[TableTwinSetup, Write], ByteDevice]] = {
    "modbus": lambda seat, write: ModbusRtu(drives_by_unit(seat), SerialPort("").silence_s, write),
    "galil": GalilController,
    "acutrol": AcutrolController,
    "aerosmith": AerosmithController,
}
"""What makes the controller on a wire, given how it writes bytes."""


def twin_of(spec: TableSpec) -> Callable[[TableTwinSetup, Write], ByteDevice]:
    """Return the maker of a controller's twin; PluginError if there is none."""
    if (twin := spec.twin or TWINS.get(spec.name)) is None:
        raise PluginError(f"{spec.name} has no twin: its SPEC needs one, or the bench file a link")
    return twin
