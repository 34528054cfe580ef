"""An [[imu]] section of a bench file: a device under test, how it is reached, what its data sheet says."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from drivers.imus.aceinna import codec as aceinna
from drivers.imus.can.imu import BUILT_IN_DBC, CanChannel
from drivers.imus.stim300.special import RATES_HZ as STIM300_RATES_HZ
from drivers.imus.stim300.units import ACCEL_LSB_G, UNITS
from drivers.imus.vectornav import codec as vectornav
from drivers.imus.xsens.imu import HIGHEST_RATE_HZ as XSENS_HIGHEST_RATE_HZ
from estimator.errors import GeometryError
from estimator.geometry.array import SensorArray, cone, dodecahedron, sensor_array, tetrahedron, triad
from estimator.geometry.model import Prior
from estimator.geometry.noise import NoiseModel
from station.bench.can_mappings import MappingError, channels_of, load_mapping
from station.bench.table import TWIN
from station.schema.tables import Table

PROTOCOLS = ("can", "j1939", "stim300", "vectornav", "xsens")
ON_CAN = ("can", "j1939")
_NOT_NAMES = ("table", "seed", "watchdog", "start", "fault", "faults", "hidden", "started", "wires")


@dataclass(frozen=True, slots=True)
class CanSource:
    """What on a CAN bus is a device: its DBC, the signals of its sources, the J1939 address if only one is meant."""

    dbc: Path
    channels: tuple[CanChannel, ...]
    source_address: int | None = None


@dataclass(frozen=True, slots=True, eq=False)
class ImuConfig:
    """A device under test: how to reach it, what it is made of, what its data sheet says.

    ``can`` for protocol can; ``options`` are the protocol's own keys.
    """

    name: str
    protocol: str
    link: str
    array_name: str
    array: SensorArray
    rate_hz: float
    can: CanSource | None
    noise: NoiseModel
    prior: Prior
    used: bool
    options: Mapping[str, Any] = field(default_factory=dict)

    @property
    def knows_temperature(self) -> bool:
        """Whether every source of the device tells its temperature."""
        if self.can is not None:
            return all(channel.temperature is not None for channel in self.can.channels)
        return self.protocol != "j1939"

    def gyros_of(self, sources: Sequence[str]) -> dict[str, list[int]]:
        """Return which of the array's gyros each source of the device carries."""
        counts = [len(channel.rates) for channel in self.can.channels] if self.can is not None else [len(self.array)]
        starts = np.cumsum([0, *counts])
        return {name: list(range(starts[i], starts[i + 1])) for i, name in enumerate(sources)}


def read_imu(table: Table, folder: Path) -> ImuConfig:
    """Read a section; the table's error with line and key for what is wrong."""
    name = table.string("name")
    if name in _NOT_NAMES:
        raise table.fail("name", f"{name!r} means something else on a bench: take another name")
    protocol = table.string("protocol", one_of=PROTOCOLS)
    array_name, array = _array(table, name)
    rate_hz = table.quantity("rate", "frequency", bound="above_zero")
    if protocol != "can" and len(array) != 3:
        raise table.fail("array", f"protocol {protocol} has three gyros, this array {len(array)}")
    can = _can(table, folder, name, array) if protocol == "can" else None
    options = _options(table, protocol)
    _check_rate(table, protocol, rate_hz, options.get("output", ""))
    noise, prior = _datasheet(table.table("datasheet"))
    config = ImuConfig(
        name,
        protocol,
        table.link("link", TWIN),
        array_name,
        array,
        rate_hz,
        can,
        noise,
        prior,
        table.flag("used", True),
        options,
    )
    table.done()
    return config


def _check_rate(table: Table, protocol: str, rate_hz: float, output: str) -> None:
    """See that the device has such a rate, before it is asked for it; ``output`` is what a VectorNav sends."""
    if protocol == "xsens" and (rate_hz != round(rate_hz) or rate_hz > XSENS_HIGHEST_RATE_HZ):
        raise table.fail("rate", f"an Xsens MTi sends at a whole number of Hz, up to {XSENS_HIGHEST_RATE_HZ}")
    legal: Mapping[str, Sequence[float]] = {
        "stim300": STIM300_RATES_HZ,
        "j1939": sorted(aceinna.RATES_HZ),
        "vectornav": vectornav.RATES_HZ.get(output, ()),
    }
    if protocol in legal and rate_hz not in legal[protocol]:
        said = f"protocol {protocol} sends{f' {output}' if output else ''} at"
        raise table.fail("rate", f"{said} {', '.join(f'{legal_hz:g}' for legal_hz in legal[protocol])} Hz")


def _options(table: Table, protocol: str) -> dict[str, Any]:
    options: dict[str, Any] = {}
    if protocol in ("xsens", "j1939"):
        options["configure"] = table.flag("configure", True)
    if protocol == "vectornav":
        options["output"] = table.string("output", "binary", one_of=vectornav.RATES_HZ)
    elif protocol == "j1939":
        options["model"] = table.string("model", "openimu300ri", one_of=aceinna.AXIS_ORDERS)
        if table.has("axis_order"):
            options["axis_order"] = table.string("axis_order", one_of=("xyz", "sae"))
        options["address"] = table.integer("address", aceinna.DEFAULT_ADDRESS)
        if not 0 <= options["address"] <= 0xFD:
            raise table.fail("address", f"{options['address']} is no J1939 address: give 0 to 253")
    elif protocol == "stim300":
        if table.has("gyro_unit"):
            options["gyro_unit"] = table.string("gyro_unit", one_of=UNITS.values())
        if table.has("accel_range"):
            options["accel_range"] = table.integer("accel_range")
            if options["accel_range"] not in ACCEL_LSB_G:
                raise table.fail("accel_range", f"is one of {', '.join(map(str, ACCEL_LSB_G))} g")
    return options


def _datasheet(sheet: Table) -> tuple[NoiseModel, Prior]:
    prior, noise = Prior(**sheet.declared("prior")), NoiseModel(**sheet.declared("noise"))
    sheet.done()
    return noise, prior


def _array(table: Table, device: str) -> tuple[str, SensorArray]:
    explicit = table.has("p")
    try:
        if explicit:
            p, j, k = table.value("p"), table.value("j"), table.value("k")
            names = [f"gyro{i + 1}" for i in range(len(p) if isinstance(p, list) else 0)]
            return "explicit", sensor_array(p, j, k, names=names)
        kind = table.string("array", one_of=("triad", "tetrahedron", "dodecahedron", "cone"))
        if kind == "cone":
            return kind, cone(table.integer("gyros"), table.quantity("half_angle", "angle"))
        return kind, {"triad": triad, "tetrahedron": tetrahedron, "dodecahedron": dodecahedron}[kind]()
    except GeometryError as error:
        raise table.fail("p" if explicit else "array", f"{device}: {error}") from None


def _can(table: Table, folder: Path, device: str, array: SensorArray) -> CanSource:
    """Return the signals: those of a mapping file, or one channel a gyro as the bench file lists them."""
    if table.has("mapping"):
        try:
            mapping = load_mapping(table.string("mapping"), folder)
            return CanSource(mapping.dbc, channels_of(mapping, device, array.names), mapping.source_address)
        except MappingError as error:
            raise table.fail("mapping", str(error)) from None
    dbc = folder / table.string("dbc") if table.has("dbc") else BUILT_IN_DBC
    listed = table.tables("channels")
    if len(listed) != len(array):
        raise table.fail("channels", f"{len(listed)} channels for an array of {len(array)} gyros")
    channels = []
    for name, channel in zip(array.names, listed, strict=True):
        temperature, counter, time = (
            channel.string(key) if channel.has(key) else None for key in ("temperature", "counter", "time")
        )
        channels.append(CanChannel(name, channel.string("rate"), temperature, counter, time))
        channel.done()
    return CanSource(dbc, tuple(channels))
