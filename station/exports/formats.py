"""The forms that a calibration can be exported in."""

from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import EntryPoint

from drivers.packaged import packaged_toml
from drivers.plugins import Registry
from station.exports import GROUP
from station.exports.exported import Exported
from station.exports.written import Written


@dataclass(frozen=True, slots=True)
class Format:
    """A form: what writes it (or UsageError), what it holds and lacks, for people, whether it is of one device."""

    name: str
    write: Callable[[Exported], Written]
    holds: str = ""
    lacks: str = ""
    of_one_device: bool = True


_OWN = packaged_toml("station.exports", "held.toml").items()
FORMATS = Registry(
    Format, GROUP, {name: Format(name, EntryPoint(name, w, GROUP).load(), *said) for name, (w, *said) in _OWN}
)
"""Built in and installed ones, by name."""
