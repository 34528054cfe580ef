"""An [[imu]] section of a bench file: a device under test, how it is reached, what its data sheet says."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from drivers.imus.can.imu import BUILT_IN_DBC, CanChannel, CanSource
from drivers.imus.described.imu import Description
from drivers.imus.registry import IMUS
from drivers.plugins import Registry
from drivers.specs import ImuSpec
from estimator.errors import GeometryError
from estimator.geometry.array import SensorArray, cone, dodecahedron, sensor_array, tetrahedron, triad
from estimator.geometry.model import Prior
from estimator.geometry.noise import NoiseModel
from station.bench.can_mappings import MappingError, channels_of, load_mapping
from station.bench.descriptions import DescriptionError, load_description
from station.bench.table import TWIN
from station.schema.tables import Table

_NOT_NAMES = ("table", "seed", "watchdog", "start", "fault", "faults", "hidden", "started", "wires")


@dataclass(frozen=True, slots=True, eq=False)
class ImuConfig:
    """A device under test: how to reach it, what it is made of, what its data sheet says.

    ``can`` where signals of a DBC are mapped, or a file describes them; ``options`` are the protocol's own keys.
    """

    name: str
    spec: ImuSpec
    link: str
    array_name: str
    array: SensorArray
    rate_hz: float
    can: CanSource | Description | None
    noise: NoiseModel
    prior: Prior
    used: bool
    options: Mapping[str, Any] = field(default_factory=dict)

    @property
    def protocol(self) -> str:
        """Name of its protocol."""
        return self.spec.name

    @property
    def knows_temperature(self) -> bool:
        """Whether every source of the device tells its temperature."""
        if self.can is not None:
            return all(channel.temperature is not None for channel in self.can.channels)
        return self.spec.temperature

    def gyros_of(self, sources: Sequence[str]) -> dict[str, list[int]]:
        """Return which of the array's gyros each source of the device carries."""
        counts = [len(channel.rates) for channel in self.can.channels] if self.can is not None else [len(self.array)]
        starts = np.cumsum([0, *counts])
        return {name: list(range(starts[i], starts[i + 1])) for i, name in enumerate(sources)}


def read_imu(table: Table, folder: Path, known: Registry[ImuSpec] = IMUS) -> ImuConfig:
    """Read a section; the table's error with line and key for what is wrong."""
    name = table.string("name")
    if name in _NOT_NAMES:
        raise table.fail("name", f"{name!r} means something else on a bench: take another name")
    spec = table.record("protocol", known)
    array_name, array = _array(table, name)
    rate_hz = table.quantity("rate", "frequency", bound="above_zero")
    if spec.gyros not in (None, len(array)):
        raise table.fail("array", f"protocol {spec.name} has {spec.gyros} gyros, this array {len(array)}")
    can: CanSource | Description | None = _can(table, folder, name, array) if spec.signals_of_dbc else None
    if spec.described:
        can = _described(table, folder, name, array)
    options = table.options(spec.keys, folder)
    if refused := spec.refused_rate(rate_hz, options):
        raise table.fail("rate", refused)
    noise, prior = _datasheet(table.table("datasheet"))
    config = ImuConfig(
        name,
        spec,
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


def _described(table: Table, folder: Path, device: str, array: SensorArray) -> Description:
    """Return the description that the section names, which must have the gyros of the array."""
    try:
        description = load_description(table.string("description"), folder, device)
    except DescriptionError as error:
        raise table.fail("description", str(error)) from None
    if (gyros := len(description.channels[0].rates)) != len(array):
        raise table.fail("array", f"the description has {gyros} gyros, this array {len(array)}")
    return description


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
