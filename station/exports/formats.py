"""The forms that a calibration can be exported in."""

from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import EntryPoint
from typing import Any

from drivers.packaged import packaged_toml
from drivers.plugins import Registry
from station.exports import GROUP
from station.exports.exported import Exported
from station.exports.written import Written


@dataclass(frozen=True, slots=True)
class Format:
    """An export format: the function that makes it (or UsageError), what it holds and lacks, whether per device.

    ``suffix`` is that of its files where the station names them.
    """

    name: str
    write: Callable[[Exported], Written]
    holds: str = ""
    lacks: str = ""
    of_one_device: bool = True
    suffix: str = ".txt"


def _built_in(name: str, write: str, **fields: Any) -> Format:
    """Return a form of the station's own; ``write`` names its function as an entry point does."""
    return Format(name=name, write=EntryPoint(name, write, GROUP).load(), **fields)


_OWN = packaged_toml("station.exports", "held.toml")
FORMATS = Registry(Format, GROUP, {name: _built_in(name, **said) for name, said in _OWN.items()})
"""Built in and installed ones, by name."""
