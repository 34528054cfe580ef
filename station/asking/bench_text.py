"""A bench file made of answers: TOML with comments, as the built-in one has."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from station.bench_imu import ON_CAN
from station.bench_table import TWIN
from station.rendering import rendered

ADDRESS_KEYS: Mapping[str, str] = {"modbus": "unit_id", "galil": "letter", "acutrol": "number"}
"""What the address of an axis is called, by protocol; an Aerosmith's one axis has none."""
COUNTING = ("modbus", "galil")
"""Protocols that must be told the encoder counts a turn."""
_LINKS = {
    "modbus": "tcp://192.168.1.10:502 or serial:///dev/ttyUSB0?baud=115200&parity=E",
    "galil": "tcp://192.168.1.10 or serial:///dev/ttyUSB0?baud=115200",
    "acutrol": "tcp://192.168.1.10:9888",
    "aerosmith": "serial:///dev/ttyUSB0?baud=9600",
    "can": "can:socketcan:can0 or can:slcan:/dev/ttyACM0",
    "j1939": "can:socketcan:can0 or can:pcan:PCAN_USBBUS1?bitrate=250000",
    "stim300": "serial:///dev/ttyUSB0?baud=921600",
    "vectornav": "serial:///dev/ttyUSB0?baud=115200",
    "xsens": "serial:///dev/ttyUSB0?baud=921600",
}
"""What links to hardware look like, by protocol."""


@dataclass(frozen=True, slots=True)
class AxisAnswer:
    """One axis of the table; ``address`` and ``counts_per_turn`` are empty where the protocol needs none.

    ``travel`` is empty for an axis that turns without end, ``link`` for one that has none of its own.
    """

    address: str
    counts_per_turn: str
    max_rate: str
    max_acceleration: str
    travel: tuple[str, ...] = ()
    link: str = ""


@dataclass(frozen=True, slots=True)
class TableAnswer:
    """The table; axes by name, outermost first."""

    protocol: str
    link: str
    profile: str
    axes: Mapping[str, AxisAnswer]


@dataclass(frozen=True, slots=True)
class ImuAnswer:
    """A device under test.

    Its name is a bare key of TOML. ``geometry`` are the keys of its array, values as TOML. Of gyros on CAN: a mapping,
    or ``channels``, the signals of the rate and (empty for none) of the temperature of each gyro in the DBC, the
    built-in one if ``dbc`` is empty.
    """

    name: str
    protocol: str
    link: str
    geometry: Mapping[str, str]
    rate: str
    arw: str
    bias_instability: str
    mapping: str = ""
    dbc: str = ""
    channels: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True, slots=True)
class BenchAnswer:
    """A whole bench; ``latitude`` is empty if Earth rate is to be left out, patterns are empty for anything."""

    name: str
    table: TableAnswer
    imus: Sequence[ImuAnswer]
    latitude: str = ""
    heading: str = "0 deg"
    limits: Mapping[str, str] = field(default_factory=dict)
    operator_pattern: str = ""
    serial_pattern: str = ""


def bench_text(bench: BenchAnswer) -> str:
    """Return the whole file."""
    return _rendered("bench.toml", bench=bench, simulated=all(imu.link == TWIN for imu in bench.imus), on_can=ON_CAN)


def table_text(table: TableAnswer) -> str:
    """Return the section [table] and its axes."""
    return _rendered("table.toml", table=table)


def imu_text(imu: ImuAnswer) -> str:
    """Return the section [[imu]] of a device."""
    return _rendered("imu.toml", imu=imu)


def _rendered(name: str, **values: object) -> str:
    values |= {"quoted": _quoted, "link_comment": _link_comment, "address_keys": ADDRESS_KEYS}
    return rendered("station.asking", name, values)


def _quoted(value: str | Sequence[str]) -> str:
    return json.dumps(value, ensure_ascii=False)


def _link_comment(device: TableAnswer | ImuAnswer) -> str:
    return f"the twin; hardware: {_LINKS[device.protocol]}" if device.link == TWIN else ""
