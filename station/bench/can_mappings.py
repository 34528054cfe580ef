"""Mapping files: which signals of a DBC are the channels of an IMU on CAN."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import drivers.imus.can.dbc
from drivers.imus.can.imu import CanChannel, CanSource
from drivers.imus.signals import UNITS, plain_unit
from station.errors import UsageError, sentence
from station.schema.tables import Table

MAPPING_FOLDER = Path(drivers.imus.can.dbc.__path__[0])


class MappingError(UsageError):
    """An invalid mapping file; the message names file, line and key."""


@dataclass(frozen=True, slots=True)
class CanMapping(CanSource):
    """An IMU on CAN, with its sources in the order of the array's gyros."""

    name: str = ""

    @property
    def gyros(self) -> int:
        """Number of gyros in all sources."""
        return sum(len(source.rates) for source in self.channels)


def load_mapping(name_or_path: str, folder: Path | None = None) -> CanMapping:
    """Return a mapping by name, of those in the package, or by the path of a .toml file.

    A relative path counts from ``folder``, by default the working folder; the path of a DBC in a mapping from the
    mapping's folder. MappingError if it is missing or invalid.
    """
    path = shipped_or_own(name_or_path, folder, MAPPING_FOLDER, "CAN mapping", MappingError)
    top = Table.load(path, MappingError)
    own = top.read_all("can_mapping.can_mapping", path.parent)
    units = read_units(own["units"])
    sources = tuple(read_source(table, units, str(i)) for i, table in enumerate(own["sources"], 1))
    for table in own["sources"]:
        table.done()
    if not sources:
        raise top.fail(None, "needs at least one [[sources]]")
    return CanMapping(own["dbc"], sources, own["source_address"], name=own["name"])


def shipped_or_own(
    name_or_path: str, folder: Path | None, shipped: Path, file_kind: str, error: type[UsageError]
) -> Path:
    """Return the path of the file ``name_or_path``.toml in ``shipped``, or, if that ends in .toml, at that path.

    A relative path counts from ``folder``, by default the working folder. ``error`` is raised if there is no such file;
    ``file_kind`` is the kind of file for its message.
    """
    path = Path(name_or_path)
    path = (folder or Path()) / path if path.suffix == ".toml" else shipped / f"{name_or_path}.toml"
    if not path.is_file():
        known = ", ".join(sorted(p.stem for p in shipped.glob("*.toml")))
        raise error(f"no {file_kind} {name_or_path}: give one of {known}, or the path of a .toml")
    return path


def channels_of(mapping: CanMapping, device: str, gyros: Sequence[str]) -> tuple[CanChannel, ...]:
    """Return the mapping's sources with their names on a bench whose device has these gyros.

    The only source is named as the device, a source of one gyro as the gyro, any other DEVICE.SOURCE. MappingError if
    the mapping has another number of gyros.
    """
    if mapping.gyros != len(gyros):
        raise MappingError(
            sentence("bench.other_gyros", device=device, name=mapping.name, held=mapping.gyros, gyros=len(gyros))
        )
    named, first = [], 0
    for source in mapping.channels:
        name = f"{device}.{source.name}"
        if len(mapping.channels) == 1:
            name = device
        elif len(source.rates) == 1:
            name = gyros[first]
        first += len(source.rates)
        named.append(replace(source, name=name))
    return tuple(named)


def read_source(table: Table, units: tuple[tuple[str, str], ...], name: str) -> CanChannel:
    """Take one source out of a table; ``name`` is its own if it states none."""
    own = table.read("can_mapping.source")
    if own["acceleration"] and len(own["acceleration"]) != 3:
        raise table.fail("acceleration", f"names {len(own['acceleration'])} signals, not x, y and z")
    return CanChannel(units=units, **{**own, "name": own["name"] or name})


def read_units(table: Table) -> tuple[tuple[str, str], ...]:
    """Return the stated (quantity, unit) of a mapping, for quantities whose units the DBC lacks.

    Unstated ones are left out. The table's error for an unknown unit.
    """
    units = {quantity: unit for quantity, unit in table.read_all("can_mapping.units").items() if unit is not None}
    for quantity, unit in units.items():
        if plain_unit(unit) not in UNITS[quantity]:
            known = ", ".join(name for name in UNITS[quantity] if name)
            raise table.fail(quantity, f"{unit!r}: give one of {known}")
    return tuple(units.items())
