"""The forms that a calibration can be exported in."""

from collections.abc import Callable
from dataclasses import dataclass

from station.exports.exported import Exported
from station.exports.forms.autopilots import write_ardupilot, write_px4
from station.exports.forms.plain_data import write_csv, write_json, write_yaml
from station.exports.forms.robotics import write_kalibr, write_ros
from station.exports.forms.source_code import write_c, write_python
from station.exports.written import Written


@dataclass(frozen=True, slots=True)
class Format:
    """A form: what writes it from the gyros and the number of the autopilot's gyro, and whether it is of one device."""

    write: Callable[[Exported, int], Written]
    of_one_device: bool = True


FORMATS: dict[str, Format] = {
    "json": Format(lambda exported, _: write_json(exported), of_one_device=False),
    "yaml": Format(lambda exported, _: write_yaml(exported), of_one_device=False),
    "csv": Format(lambda exported, _: write_csv(exported), of_one_device=False),
    "c": Format(lambda exported, _: write_c(exported)),
    "python": Format(lambda exported, _: write_python(exported)),
    "ros": Format(lambda exported, _: write_ros(exported)),
    "kalibr": Format(lambda exported, _: write_kalibr(exported)),
    "px4": Format(write_px4),
    "ardupilot": Format(write_ardupilot),
}
"""By name; what each holds is in ``station.exports.HELD``."""
