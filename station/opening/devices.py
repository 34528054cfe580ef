"""The driver of each protocol that a bench file may name, put on its link."""

from __future__ import annotations

from collections.abc import Mapping

from drivers.imus.aceinna.codec import Settings
from drivers.imus.aceinna.imu import AceinnaImu
from drivers.imus.can.imu import CanImu
from drivers.imus.stim300.imu import Stim300Imu
from drivers.imus.vectornav.imu import VectorNavImu
from drivers.imus.xsens.imu import XsensImu
from drivers.protocols import ByteLink, FrameLink, ImuSource, Turntable
from drivers.tables.acutrol.table import AcutrolAxis, AcutrolTable
from drivers.tables.aerosmith.table import AerosmithTable
from drivers.tables.galil.table import GalilAxis, GalilTable
from drivers.tables.modbus.line import Address
from drivers.tables.modbus.table import DriveAxis, ModbusTable
from station.bench.imu import ImuConfig
from station.bench.table import TableConfig

_ANSWER_S = 0.25  # one try of a question to a sensor, of which there are two: silence is known after half a second

BAUD = {"modbus": 19200, "galil": 115200, "acutrol": 115200, "aerosmith": 9600}
BAUD |= {"stim300": 921600, "vectornav": 115200, "xsens": 921600}
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


def byte_imu(config: ImuConfig, link: ByteLink, time_scale: float) -> ImuSource:
    """Return the driver of an IMU on a byte link."""
    name, options, answer_s = config.name, config.options, _ANSWER_S * time_scale
    if config.protocol == "stim300":
        unit, most = options.get("gyro_unit"), options.get("accel_range")
        rate_hz = round(config.rate_hz)
        return Stim300Imu(name, link, rate_hz, gyro_unit=unit, accel_range_g=most, timeout_s=answer_s)
    if config.protocol == "xsens":
        return XsensImu(name, link, config.rate_hz, configure=options["configure"], timeout_s=answer_s)
    return VectorNavImu(name, link, config.rate_hz, output=options["output"], timeout_s=answer_s)


def frame_imu(config: ImuConfig, link: FrameLink) -> ImuSource:
    """Return the driver of an IMU on a CAN bus."""
    if config.can is not None:
        can = config.can
        return CanImu(config.name, link, can.dbc, can.channels, config.rate_hz, source_address=can.source_address)
    return AceinnaImu(
        config.name,
        link,
        config.rate_hz,
        model=config.options["model"],
        axis_order=config.options.get("axis_order"),
        address=config.options["address"],
        settings=Settings(rate_hz=config.rate_hz, packets=("ari", "accs")) if config.options["configure"] else None,
    )
