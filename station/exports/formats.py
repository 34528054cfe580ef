"""The forms that a calibration can be exported in."""

from collections.abc import Callable
from dataclasses import dataclass

from drivers.plugins import Registry, load_files
from station.exports.exported import Exported
from station.exports.forms.autopilots import write_ardupilot, write_px4
from station.exports.forms.c_header import write_c
from station.exports.forms.plain_data import write_csv, write_json, write_yaml
from station.exports.forms.python_module import write_python
from station.exports.forms.robotics import write_kalibr, write_ros
from station.exports.held import GROUP, HELD
from station.exports.written import Written


@dataclass(frozen=True, slots=True)
class Format:
    """A form by its ``name``; for people, what it ``holds`` of a calibration, and what it ``lacks``.

    ``write`` makes it from the gyros and the number of the autopilot's gyro; it may be ``of_one_device`` alone.
    """

    name: str
    write: Callable[[Exported, int], Written]
    holds: str = ""
    lacks: str = ""
    of_one_device: bool = True


def _own(name: str, write: Callable[[Exported, int], Written], of_one_device: bool = True) -> Format:
    return Format(name, write, *HELD[name], of_one_device)


FORMATS = Registry(
    Format,
    GROUP,
    {},
    [
        _own("json", lambda exported, _: write_json(exported), of_one_device=False),
        _own("yaml", lambda exported, _: write_yaml(exported), of_one_device=False),
        _own("csv", lambda exported, _: write_csv(exported), of_one_device=False),
        _own("c", lambda exported, _: write_c(exported)),
        _own("python", lambda exported, _: write_python(exported)),
        _own("ros", lambda exported, _: write_ros(exported)),
        _own("kalibr", lambda exported, _: write_kalibr(exported)),
        _own("px4", write_px4),
        _own("ardupilot", write_ardupilot),
    ],
)
"""Built in and installed ones, by name."""


def formats() -> Registry[Format]:
    """Return these, and what files that were given bring; PluginError for a file that cannot be used."""
    return FORMATS.beside(load_files(()))
