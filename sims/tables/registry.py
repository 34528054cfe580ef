"""The twins of tables, by the protocol that they speak: one entry each."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from drivers.specs import TableSpec
from drivers.tables.modbus.line import SerialPort
from sims.physics.table import TableModel
from sims.tables.acutrol_controller import AcutrolController
from sims.tables.aerosmith_controller import AerosmithController
from sims.tables.galil_controller import GalilController
from sims.tables.modbus import ModbusRtu, drives_by_unit
from sims.wires.wires import ByteDevice, Write


@dataclass(frozen=True, slots=True)
class Seat:
    """A controller as it stands before the simulated table.

    ``addresses`` are those of its axes, outermost first, ``options`` the protocol's keys in the bench file.
    ``watchdog_s`` of silence stops the axes (0: never).
    """

    table: TableModel
    addresses: Mapping[str, Any]
    options: Mapping[str, Any]
    watchdog_s: float


def _modbus(seat: Seat, write: Write) -> ByteDevice:
    drives = drives_by_unit(seat.table, seat.options["profile"], seat.addresses, seat.watchdog_s)
    return ModbusRtu(drives, SerialPort("").silence_s, write)


def _galil(seat: Seat, write: Write) -> ByteDevice:
    window_s, watchdog_s = seat.options["velocity_window"], seat.watchdog_s
    return GalilController(seat.table, write, seat.addresses, watchdog_s=watchdog_s, velocity_window_s=window_s)


def _acutrol(seat: Seat, write: Write) -> ByteDevice:
    prefix, watchdog_s = seat.options["reply_prefix"], seat.watchdog_s
    return AcutrolController(seat.table, write, seat.addresses, watchdog_s=watchdog_s, prefix_length=prefix)


def _aerosmith(seat: Seat, write: Write) -> ByteDevice:
    return AerosmithController(seat.table, write, next(iter(seat.addresses)), watchdog_s=seat.watchdog_s)


TWINS = {"modbus": _modbus, "galil": _galil, "acutrol": _acutrol, "aerosmith": _aerosmith}
"""What makes the controller on a wire, given how it writes bytes."""


def twin_of(spec: TableSpec) -> Callable[[Seat, Write], ByteDevice]:
    """Return what makes the twin of a controller."""
    return spec.twin or TWINS[spec.name]
