"""Keys of a bench file common to all devices: kind, protocol, link."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from drivers.kind import DeviceKind
from drivers.plugins import Registry
from drivers.specs import DeviceSpec
from station.schema.tables import Table, known_in

_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]*")  # it is the name of a group of the recording


class AnyDevice(Protocol):
    """The attributes that the configurations of all kinds of devices share."""

    @property
    def name(self) -> str:
        """Its name on the bench; that of the table is table."""

    @property
    def kind(self) -> DeviceKind:
        """Its kind."""

    @property
    def spec(self) -> DeviceSpec:
        """Its protocol."""

    @property
    def settings(self) -> Mapping[str, Any]:
        """Values of the keys of its kind."""

    @property
    def used(self) -> bool:
        """Whether a run drives it."""

    @property
    def links(self) -> tuple[str, ...]:
        """Its links, each once."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class DeviceConfig:
    """A device of a kind that is known to the station by its record only.

    ``options`` are the values of the protocol's keys, ``settings`` those of the kind's.
    """

    name: str
    kind: DeviceKind
    spec: DeviceSpec
    link: str
    timeout_s: float
    used: bool = True
    options: Mapping[str, Any] = field(default_factory=dict)
    settings: Mapping[str, Any] = field(default_factory=dict)

    @property
    def links(self) -> tuple[str, ...]:
        """Its link."""
        return (self.link,)


def read_device(table: Table, folder: Path, kind: DeviceKind, known: Registry[Any]) -> DeviceConfig:
    """Return the device of a section of kind ``kind``; the table's error with line and key if it is invalid.

    Its protocol is one of ``known``; its name defaults to the kind's. Paths count from ``folder``.
    """
    own = table.read("bench.device", folder, protocol=known_in(known))
    name = own.pop("name") or kind.name
    if not _NAME.fullmatch(name):
        raise table.fail("name", f"{name!r}: begin with a letter, then letters, digits, _ and -")
    options = table.options(own["spec"].keys, folder)
    settings = table.options(kind.keys, folder)
    table.done()
    return DeviceConfig(name=name, kind=kind, options=options, settings=settings, **own)
