"""The driver of each protocol that a bench file may name, put on its link."""

from __future__ import annotations

from collections.abc import Mapping

from drivers.protocols import ByteLink, Turntable
from drivers.tables.acutrol.table import AcutrolAxis, AcutrolTable
from drivers.tables.aerosmith.table import AerosmithTable
from drivers.tables.galil.table import GalilAxis, GalilTable
from drivers.tables.modbus.line import Address
from drivers.tables.modbus.table import DriveAxis, ModbusTable
from station.bench.table import TableConfig

BAUD = {"modbus": 19200, "galil": 115200, "acutrol": 115200, "aerosmith": 9600}
"""Bits a second of a serial link that states none."""
TCP_PORT = {"modbus": 502, "acutrol": 9888, "galil": 23}
"""TCP port of a link that states none."""


def modbus_table(config: TableConfig, address: Address, own: Mapping[str, Address], time_scale: float) -> Turntable:
    """Return the driver of drives on Modbus at an address; some axes have one of their ``own``."""
    assert config.profile is not None
    axes = {
        name: DriveAxis(int(axis.address), axis.counts_per_turn, axis.limits, own.get(name))
        for name, axis in config.axes.items()
    }
    return ModbusTable("table", address, config.profile, axes, config.timeout_s * time_scale)


def byte_table(config: TableConfig, link: ByteLink, time_scale: float) -> Turntable:
    """Return the driver of a controller that speaks lines of text."""
    timeout_s = config.timeout_s * time_scale
    if config.protocol == "galil":
        letters = {
            name: GalilAxis(str(axis.address), axis.counts_per_turn, axis.limits, axis.error_limit_rad)
            for name, axis in config.axes.items()
        }
        window_s = config.velocity_window_s
        return GalilTable("table", link, letters, timeout_s, homing=config.homing, velocity_window_s=window_s)
    if config.protocol == "acutrol":
        numbers = {name: AcutrolAxis(int(axis.address), axis.limits) for name, axis in config.axes.items()}
        return AcutrolTable("table", link, numbers, timeout_s, prefix_length=config.prefix)
    name, axis = next(iter(config.axes.items()))
    return AerosmithTable("table", link, name, axis.limits, timeout_s, fault_mask=config.fault_mask)
