"""An [[imu]] section of a bench file: a device under test, its link, its data sheet."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from drivers.imus.can.imu import BUILT_IN_DBC, CanChannel, CanSource
from drivers.imus.described.imu import Description
from drivers.imus.kind import SPEC as IMU
from drivers.imus.registry import IMUS
from drivers.kind import DeviceKind
from drivers.plugins import Registry
from drivers.specs import ImuSpec
from estimator.errors import GeometryError
from estimator.geometry.array import SensorArray, cone, dodecahedron, sensor_array, tetrahedron, triad
from estimator.geometry.kinematics import AXES
from estimator.geometry.model import ForcePrior, Prior
from estimator.geometry.noise import NoiseModel
from estimator.recordings.recording import ForceSheet, Mounting
from estimator.types import Floats
from station.bench.can_mappings import channels_of, load_mapping
from station.bench.descriptions import load_description
from station.errors import sentence
from station.schema.tables import Table, keys_of, known_in

_ARRAYS = {"triad": triad, "tetrahedron": tetrahedron, "dodecahedron": dodecahedron}
_VARIANTS = ("bench.array", "bench.cone", "bench.axes", "bench.mapped", "bench.listed", "bench.described")
NOT_NAMES = ("table", "seed", "watchdog", "start", "fault", "faults", "hidden", "started", "wires")


@dataclass(frozen=True, slots=True, eq=False)
class ImuConfig:
    """A device under test: its link, its array, its data sheet.

    ``can`` has the signals where a DBC or a description defines them; ``options`` are the values of the protocol's
    keys. ``force_sheet`` is the data sheet of its accelerometers, None if they are not calibrated. ``array`` has the
    axes as the device lies on the table, by ``mounting``.
    """

    name: str
    spec: ImuSpec
    link: str
    array_name: str
    array: SensorArray
    rate_hz: float
    can: CanSource | None
    noise: NoiseModel
    prior: Prior
    used: bool
    force_sheet: ForceSheet | None = None
    mounting: Mounting = field(default_factory=Mounting)
    options: Mapping[str, Any] = field(default_factory=dict)

    @property
    def attributes(self) -> dict[str, Any]:
        """What a recording states of it beside its gyros: the data sheet of its accelerometers, and its mounting."""
        sheet = {} if self.force_sheet is None else self.force_sheet.attributes
        return sheet | self.mounting.attributes

    @property
    def own_array(self) -> SensorArray:
        """The array in the axes of the device."""
        return self.array.turned(self.mounting.axes.T)

    @property
    def kind(self) -> DeviceKind:
        """Its kind."""
        return IMU

    @property
    def links(self) -> tuple[str, ...]:
        """Its link."""
        return (self.link,)

    @property
    def settings(self) -> Mapping[str, Any]:
        """Nothing: its section is read by the station."""
        return {}

    @property
    def protocol(self) -> str:
        """Name of its protocol."""
        return self.spec.name

    @property
    def knows_temperature(self) -> bool:
        """Whether every source of the device reports its temperature."""
        if self.can is not None:
            return all(channel.temperature is not None for channel in self.can.channels)
        return self.spec.temperature

    def gyros_of(self, sources: Sequence[str]) -> dict[str, list[int]]:
        """Return by source the numbers, from 0, of the array's gyros that it carries, ``sources`` being in order."""
        counts = [len(channel.rates) for channel in self.can.channels] if self.can is not None else [len(self.array)]
        starts = np.cumsum([0, *counts])
        return {name: list(range(starts[i], starts[i + 1])) for i, name in enumerate(sources)}


def read_imu(table: Table, folder: Path, known: Registry[ImuSpec] = IMUS) -> ImuConfig:
    """Return the device of a section [[imu]]; the table's error with line and key if it is invalid.

    Its protocol is one of ``known``; paths count from ``folder``. The array must have as many gyros as the protocol,
    the mapping or the description; it is returned as mounted, its axes in the body that the table turns.
    """
    own = table.read("bench.imu", folder, protocol=known_in(known))
    name, spec, sheet = own["name"], own["spec"], own.pop("datasheet")
    forces = own.pop("accelerometers")
    if name in NOT_NAMES:
        raise table.fail("name", f"{name!r} is reserved on a bench. Use another name")
    mounting = Mounting(axes=_mounting(table, own.pop("mounting")), sd_rad=own.pop("mounting_sd_rad") or math.nan)
    array_name, array = _array(table, name)
    if spec.gyros not in (None, len(array)):
        raise table.fail("array", f"protocol {spec.name} has {spec.gyros} gyros, but this array has {len(array)}")
    can: CanSource | None = None
    if spec.signals_of_dbc:
        can = _can(table, folder, name, array)
    elif spec.described:
        can = _described(table, folder, name, array)
    options = table.options(spec.keys, folder)
    if refused := spec.refused_rate(own["rate_hz"], options):
        raise table.fail("rate", refused)
    prior, noise = Prior(**sheet.read("bench.prior")), NoiseModel(**sheet.read_all("bench.noise"))
    table.done(also={key.name for section in _VARIANTS for key in keys_of(section)}.intersection(table.remaining()))
    return ImuConfig(
        array_name=array_name,
        array=array.turned(mounting.axes),
        mounting=mounting,
        can=can,
        noise=noise,
        prior=prior,
        options=options,
        force_sheet=_force_sheet(forces) if forces else None,
        **own,
    )


def _mounting(table: Table, along: Sequence[str]) -> Floats:
    """Return the axes x, y, z of a device as rows (3, 3) in the body that the table turns.

    ``along`` says for each along which axis of that body it lies: "x", "-y" and so on. The table's error if these are
    not three at right angles, right-handed.
    """
    signs = [-1.0 if name.startswith("-") else 1.0 for name in along]
    rows = [sign * np.eye(3)[AXES.index(name[-1])] for sign, name in zip(signs, along, strict=True)]
    if len(rows) != 3 or np.linalg.det(np.array(rows)) < 0.5:
        raise table.fail("mounting", sentence("bench.mounting", mounting=", ".join(along)))
    return np.array(rows)


def _force_sheet(table: Table) -> ForceSheet:
    """Return the data sheet of a section [imu.accelerometers]; the table's error if it is invalid."""
    prior = ForcePrior(**table.read("bench.force_prior"))
    return ForceSheet(prior=prior, noise=NoiseModel(**table.read_all("bench.force_noise")))


def _described(table: Table, folder: Path, device: str, array: SensorArray) -> Description:
    """Return the description named by the section; its source is named ``device``.

    The table's error unless it has as many gyros as the array, and for a description that is missing or invalid.
    """
    description: Description = table.read(
        "bench.described", folder, description=lambda name, folder: load_description(name, folder, device)
    )["description"]
    if (gyros := len(description.channels[0].rates)) != len(array):
        raise table.fail("array", f"the description has {gyros} gyros, but this array has {len(array)}")
    return description


def _array(table: Table, device: str) -> tuple[str, SensorArray]:
    """Return the name of the array and the array: a known kind, a cone, or "explicit" for stated axes.

    The table's error if it cannot be made; ``device`` is for its message.
    """
    explicit = table.has("p")
    try:
        if explicit:
            own = table.read("bench.axes")
            names = [f"gyro{i + 1}" for i in range(len(own["p"]) if isinstance(own["p"], list) else 0)]
            return "explicit", sensor_array(**own, names=names)
        kind = table.read("bench.array")["array"]
        return kind, cone(**table.read("bench.cone")) if kind == "cone" else _ARRAYS[kind]()
    except GeometryError as error:
        raise table.fail("p" if explicit else "array", f"{device}: {error}") from None


def _can(table: Table, folder: Path, device: str, array: SensorArray) -> CanSource:
    """Return the signals: those of a mapping file, or one channel per gyro as listed in the section.

    Of a listed one the DBC defaults to the built-in one. The table's error, or MappingError, if their number is not
    that of the gyros of ``array``.
    """

    def mapped(name: str, folder: Path) -> CanSource:
        mapping = load_mapping(name, folder)
        return replace(mapping, channels=channels_of(mapping, device, array.names))

    if table.has("mapping"):
        return table.read("bench.mapped", folder, mapping=mapped)["mapping"]  # type: ignore[no-any-return]
    own = table.read("bench.listed", folder)
    if len(own["channels"]) != len(array):
        raise table.fail("channels", f"{len(own['channels'])} channels for an array of {len(array)} gyros")
    channels = (CanChannel(n, **c.read_all("bench.channel")) for n, c in zip(array.names, own["channels"], strict=True))
    return CanSource(own["dbc"] or BUILT_IN_DBC, tuple(channels))
