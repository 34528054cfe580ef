"""Mapping files: which signals of a DBC are the channels of an IMU on CAN."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import drivers.imus.can.dbc
from drivers.imus.can.imu import CanChannel
from drivers.imus.signals import UNITS, plain_unit
from station.errors import UsageError
from station.schema.tables import Table

MAPPING_FOLDER = Path(drivers.imus.can.dbc.__path__[0])


class MappingError(UsageError):
    """A mapping file that is missing something or says something impossible; the message names file, line and key."""


@dataclass(frozen=True, slots=True)
class CanMapping:
    """An IMU on CAN: its DBC, and its sources in the order of the array's gyros.

    ``source_address`` is the J1939 address to listen to, if only one.
    """

    name: str
    dbc: Path
    sources: tuple[CanChannel, ...]
    source_address: int | None = None

    @property
    def gyros(self) -> int:
        """Number of gyros in all sources."""
        return sum(len(source.rates) for source in self.sources)


def load_mapping(name_or_path: str, folder: Path | None = None) -> CanMapping:
    """Return a mapping that ships with the station by name, or one from a .toml file by path; MappingError.

    A relative path counts from ``folder``, the path of a DBC in a mapping from the mapping's own.
    """
    path = Path(name_or_path)
    path = (folder or Path()) / path if path.suffix == ".toml" else MAPPING_FOLDER / f"{name_or_path}.toml"
    if not path.is_file():
        known = ", ".join(sorted(p.stem for p in MAPPING_FOLDER.glob("*.toml")))
        raise MappingError(f"no CAN mapping {name_or_path}: give one of {known}, or the path of a .toml")
    top = Table.load(path, MappingError)
    name, dbc, _ = top.string("name"), path.parent / top.string("dbc"), top.string("confidence", "")
    address = top.integer("source_address") if top.has("source_address") else None
    if address is not None and not 0 <= address <= 0xFD:
        raise top.fail("source_address", f"{address} is no J1939 address, 0 to 253")
    units = _units(top.table("units", optional=True))
    sources = tuple(_source(table, str(i), units) for i, table in enumerate(top.tables("sources"), 1))
    top.done()
    if not sources:
        raise top.fail(None, "needs one [[sources]] or more")
    return CanMapping(name, dbc, sources, address)


def channels_of(mapping: CanMapping, device: str, gyros: Sequence[str]) -> tuple[CanChannel, ...]:
    """Return the mapping's sources under their names on a bench whose array has these gyros; MappingError.

    A source that is the whole device has the device's name, a source of one gyro the gyro's, any other its own in
    the mapping after the device's.
    """
    if mapping.gyros != len(gyros):
        raise MappingError(
            f"{device}: the mapping {mapping.name} has {mapping.gyros} gyros, the array {len(gyros)}: "
            "give the array the axes of the mapping's rate signals, in their order"
        )
    named, first = [], 0
    for source in mapping.sources:
        name = f"{device}.{source.name}"
        if len(mapping.sources) == 1:
            name = device
        elif len(source.rates) == 1:
            name = gyros[first]
        first += len(source.rates)
        named.append(replace(source, name=name))
    return tuple(named)


def _source(table: Table, name: str, units: tuple[tuple[str, str], ...]) -> CanChannel:
    """Return one source; ``name`` is its own if it states none."""
    acceleration = table.strings("acceleration") if table.has("acceleration") else None
    if acceleration is not None and len(acceleration) != 3:
        raise table.fail("acceleration", f"names {len(acceleration)} signals, not x, y and z")
    single = {key: table.string(key) if table.has(key) else None for key in ("temperature", "counter", "time")}
    channel = CanChannel(
        table.string("name", name),
        table.strings("rate"),
        **single,
        acceleration=None if acceleration is None else (acceleration[0], acceleration[1], acceleration[2]),
        units=units,
    )
    table.done()
    return channel


def _units(table: Table) -> tuple[tuple[str, str], ...]:
    """Return the units that the DBC does not state, by quantity."""
    units = {quantity: table.string(quantity) for quantity in UNITS if table.has(quantity)}
    for quantity, unit in units.items():
        if plain_unit(unit) not in UNITS[quantity]:
            known = ", ".join(name for name in UNITS[quantity] if name)
            raise table.fail(quantity, f"{unit!r}: give one of {known}")
    table.done()
    return tuple(units.items())
