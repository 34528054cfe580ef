"""The twin of drives on Modbus behind a stock server, on TCP or a serial line."""

from __future__ import annotations

from functools import partial
from typing import Any

from pymodbus.server import ModbusSerialServer

from drivers.tables.modbus.line import Address, SerialPort
from sims.tables import modbus
from sims.wires.line_controller import TableTwinSetup


def modbus_server(setup: TableTwinSetup, address: Address) -> Any:
    """Return a server, not yet listening, with one unit id an axis."""
    if not isinstance(address, SerialPort):
        return modbus.modbus_server(setup, address)
    server = ModbusSerialServer(
        modbus.NOBODY,
        port=address.port,
        baudrate=address.baud,
        parity=address.parity,
        stopbits=address.stop_bits,
    )
    make = partial(modbus.ModbusRtu, modbus.drives_by_unit(setup), address.silence_s)
    server.callback_new_connection = partial(modbus.Connection, server, make)  # type: ignore[method-assign]
    return server
