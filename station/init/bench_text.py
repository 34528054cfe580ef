"""A bench file made of answers: TOML with comments, as the built-in one has."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from drivers.packaged import packaged_toml
from station.bench.imu import ON_CAN
from station.bench.table import TWIN
from station.render.template import rendered

TABLES: Mapping[str, Mapping[str, Any]] = packaged_toml("station.init", "devices.toml")["tables"]
"""What is known of controllers, by protocol."""
IMUS: Mapping[str, Mapping[str, Any]] = packaged_toml("station.init", "devices.toml")["imus"]
"""What is known of devices under test, by protocol."""


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
    values |= {"quoted": _quoted, "link_comment": _link_comment, "tables": TABLES}
    return rendered("station.init", name, values)


def _quoted(value: str | Sequence[str]) -> str:
    return json.dumps(value, ensure_ascii=False)


def _link_comment(device: TableAnswer | ImuAnswer) -> str:
    known = TABLES[device.protocol] if isinstance(device, TableAnswer) else IMUS[device.protocol]
    return f"the twin; hardware: {known['link']}" if device.link == TWIN else ""
