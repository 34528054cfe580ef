"""CiA 402 drives on Modbus, as a table of the station."""

from pathlib import Path
from typing import Any

from drivers.protocols import Turntable
from drivers.specs import AxisSetup, TableSetup, TableSpec, described
from drivers.tables.modbus.registers import DriveProfile, load_profile

_DIRECT_IDS = (0, 255)  # of a device that is at its address itself (Modbus Messaging on TCP/IP V1.0b, 4.4.1.2)


def _make(setup: TableSetup, address: Any) -> Turntable:
    from drivers.tables.modbus.table import ModbusTable  # with pymodbus, half a second

    return ModbusTable(setup, address)


def _profile(name: str, folder: Path) -> DriveProfile:
    return load_profile(str(folder / name) if name.endswith(".toml") else name)


def _refused(axis: AxisSetup, link: str) -> str:
    direct = axis.address in _DIRECT_IDS and not link.startswith(("tcp:", "twin:"))
    return f"unit id {axis.address} is for a drive with a TCP address: give 1 to 247 on {link}" if direct else ""


_KEYS = {"profile": {"read": _profile}, "unit_id": {"one_of": (*range(1, 248), *_DIRECT_IDS)}}
SPEC = described(TableSpec, __package__, _KEYS, make=_make, refused=_refused)
