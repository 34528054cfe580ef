"""The forms that a calibration can be exported in."""

from collections.abc import Callable
from dataclasses import dataclass

from drivers.packaged import packaged_toml
from drivers.plugins import Registry
from station.exports import GROUP
from station.exports.exported import Exported
from station.exports.forms.autopilots import write_ardupilot, write_px4
from station.exports.forms.devices import write_stim300, write_vectornav
from station.exports.forms.plain_data import write_csv, write_json, write_matlab, write_yaml
from station.exports.forms.robotics import write_kalibr, write_openvins, write_ros
from station.exports.forms.source_code import write_c, write_c_float, write_python
from station.exports.written import Written


@dataclass(frozen=True, slots=True)
class Format:
    """A form: what writes it (or UsageError), what it holds and lacks, for people, whether it is of one device."""

    name: str
    write: Callable[[Exported], Written]
    holds: str = ""
    lacks: str = ""
    of_one_device: bool = True


_HELD = packaged_toml("station.exports", "held.toml")
_WRITERS = {
    "json": write_json,
    "yaml": write_yaml,
    "matlab": write_matlab,
    "csv": write_csv,
    "c": write_c,
    "c-float": write_c_float,
    "python": write_python,
    "ros": write_ros,
    "kalibr": write_kalibr,
    "openvins": write_openvins,
    "vectornav-84": write_vectornav,
    "stim300-trim": write_stim300,
    "px4": write_px4,
    "ardupilot": write_ardupilot,
}
FORMATS = Registry(Format, GROUP, {name: Format(name, write, *_HELD[name]) for name, write in _WRITERS.items()})
"""Built in and installed ones, by name."""
