"""Mapping files: which signals of a DBC are the channels of an IMU."""

import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from drivers.can_imu import CanChannel
from drivers.can_signals import UNITS, plain_unit

MAPPING_FOLDER = Path(__file__).with_name("dbc")

_SOURCE_KEYS = ("name", "rate", "temperature", "counter", "time", "acceleration")
_KEYS = ("name", "dbc", "source_address", "confidence", "units", "sources")


class MappingError(Exception):
    """A mapping file that is missing something or says something impossible."""


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
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        known = ", ".join(sorted(p.stem for p in MAPPING_FOLDER.glob("*.toml")))
        raise MappingError(f"no CAN mapping {name_or_path}: give one of {known}, or the path of a .toml") from None
    except (OSError, ValueError) as error:
        raise MappingError(f"CAN mapping {path} cannot be read: {error}") from None
    return _Reader(path).mapping(data)


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


class _Reader:
    """Reads one file and names it in every complaint."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def mapping(self, data: dict[str, Any]) -> CanMapping:
        self._only(data, _KEYS, "")
        sources = data.get("sources")
        if not isinstance(sources, list) or not sources or not all(isinstance(source, dict) for source in sources):
            raise self._fail("needs one [[sources]] or more")
        units = self._units(data.get("units", {}))
        address = data.get("source_address")
        if address is not None and not (isinstance(address, int) and 0 <= address <= 0xFD):
            raise self._fail(f"source_address = {address!r} is no J1939 address, 0 to 253")
        return CanMapping(
            self._text(data, "name", ""),
            self._path.parent / self._text(data, "dbc", ""),
            tuple(self._source(source, i, units) for i, source in enumerate(sources)),
            address,
        )

    def _source(self, data: dict[str, Any], index: int, units: tuple[tuple[str, str], ...]) -> CanChannel:
        where = f"sources[{index}]."
        self._only(data, _SOURCE_KEYS, where)
        acceleration = self._names(data, "acceleration", where) if "acceleration" in data else None
        if acceleration is not None and len(acceleration) != 3:
            raise self._fail(f"{where}acceleration names {len(acceleration)} signals, not x, y and z")
        single = {key: self._text(data, key, where) if key in data else None for key in _SOURCE_KEYS[2:5]}
        return CanChannel(
            str(data.get("name", index + 1)),
            self._names(data, "rate", where),
            **single,
            acceleration=None if acceleration is None else (acceleration[0], acceleration[1], acceleration[2]),
            units=units,
        )

    def _units(self, data: Any) -> tuple[tuple[str, str], ...]:
        if not isinstance(data, dict):
            raise self._fail("units is a table: write [units]")
        self._only(data, tuple(UNITS), "units.")
        for quantity in data:
            unit = self._text(data, quantity, "units.")
            if plain_unit(unit) not in UNITS[quantity]:
                known = ", ".join(name for name in UNITS[quantity] if name)
                raise self._fail(f"units.{quantity} = {unit!r}: give one of {known}")
        return tuple(data.items())

    def _names(self, data: dict[str, Any], key: str, where: str) -> tuple[str, ...]:
        names = data.get(key)
        names = [names] if isinstance(names, str) else names
        if not isinstance(names, list) or not names or not all(isinstance(name, str) for name in names):
            raise self._fail(f"{where}{key} needs the names of signals, as MESSAGE.Signal")
        return tuple(names)

    def _text(self, data: dict[str, Any], key: str, where: str) -> str:
        if not isinstance(data.get(key), str) or not data[key]:
            raise self._fail(f"{where}{key} is missing or no text")
        return str(data[key])

    def _only(self, data: dict[str, Any], known: tuple[str, ...], where: str) -> None:
        unknown = sorted(set(data) - set(known))
        if unknown:
            raise self._fail(f"does not know {where}{unknown[0]}: it reads {', '.join(known)}")

    def _fail(self, text: str) -> MappingError:
        return MappingError(f"CAN mapping {self._path}: {text}")
