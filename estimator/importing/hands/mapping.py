"""A mapping file of kind poses: accelerometers, and gyros if there are any, that hands laid in many poses."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from estimator.errors import RecordingError
from estimator.geometry.kinematics import (
    GRAVITY_MPS2,
    UNKNOWN_GRAVITY,
    UNMEASURED_GRAVITY,
    Gravity,
    normal_gravity_mps2,
)
from estimator.importing.mapping.columns import KEYS, Columns
from estimator.importing.mapping.mapping import (
    FileFormat,
    GyroColumns,
    Protocols,
    Timing,
    read_accelerometer,
    read_format,
    read_gyro,
    read_timing,
)
from estimator.importing.mapping.reference import KnownSections, Pose, Turn, read_pose, read_sections, read_turn
from estimator.poses.known import Accuracy
from estimator.strict_toml import StrictTable
from estimator.untrusted import read_text

KIND = "poses"
"""``kind`` in [reference] of such a mapping."""


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class ImuColumns:
    """Columns of one of several IMUs on a board."""

    name: str
    accelerometer: Columns
    gyro: GyroColumns


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class PoseMapping:
    """The description of files of kind poses; ``text`` is that of the mapping file.

    ``timing`` is None if each row is the mean of one rest. ``scale_known`` is false for raw counts without a size.
    ``known`` are sections with stated poses and turns, of ``accuracy``, if there are any. ``imus`` are all IMUs of a
    board, the first of which is ``accelerometer`` and ``gyro``; empty for one device.
    """

    name: str
    text: str
    format: FileFormat
    timing: Timing | None
    accelerometer: Columns
    scale_known: bool
    gyro: GyroColumns | None
    gravity: Gravity
    least_s: float
    known: KnownSections | None
    accuracy: Accuracy
    imus: tuple[ImuColumns, ...]
    device: str
    licence: str
    source: str

    @property
    def names(self) -> list[str]:
        """Names of the columns of a data file, but for its time."""
        gyro = self.gyro.columns.names if self.gyro else ()
        others = [(*imu.accelerometer.names, *imu.gyro.columns.names) for imu in self.imus[1:]]
        return [*self.accelerometer.names, *gyro, *(name for own in others for name in own)]


def is_poses(path: Path) -> bool:
    """Return whether a mapping file is of kind poses; false for one that cannot be read, which its reader reports."""
    try:
        top = StrictTable.parse(read_text(path, RecordingError), path.name, RecordingError)
        section = top.table("reference")
    except RecordingError:
        return False
    return section.text_of("kind") == KIND


def read_pose_mapping(path: Path, protocols: Protocols | None = None) -> PoseMapping:
    """Return the mapping in a file of kind poses; captures of the ``protocols`` are formats besides the others.

    RecordingError with file, line and what to write if a table is missing, anything is unknown or wrong, or several
    IMUs on a board come with known poses or means.
    """
    text = read_text(path, RecordingError)
    top = StrictTable.parse(text, path.name, RecordingError)
    needed = ("device", "file", "reference") if top.has("imu") else ("device", "file", "accelerometer", "reference")
    for name in needed:
        if not top.has(name):
            raise RecordingError(f"{path.name} has no table [{name}]: add it")
    named = top.table("device").whole(lambda table: table.stated(KEYS["device"]))
    file_format = read_format(top.table("file"), protocols or {}, path.parent)
    reference = top.table("reference")
    reference.string("kind", one_of=(KIND,))
    stated = reference.stated(KEYS[KIND])
    timing = _timing(top, path.name, file_format, means=stated["means"])
    imus = tuple(table.whole(partial(_imu, file_format=file_format)) for table in top.tables("imu"))
    gyro: GyroColumns | None
    if imus:
        accelerometer, scale_known, gyro = imus[0].accelerometer, True, imus[0].gyro
    else:
        accelerometer, scale_known = _accelerometer(top.table("accelerometer"))
        gyro = top.table("gyro").whole(partial(read_gyro, file_format=file_format)) if top.has("gyro") else None
    site = top.table("site").whole(lambda table: table.stated(KEYS["site"])) if top.has("site") else None
    gravity = _gravity(reference, None if site is None else site["latitude_rad"])
    known = _known(reference, timing, scale_known=scale_known) if reference.has("sections") else None
    if imus and (known is not None or timing is None):
        raise reference.fail(None, "of several IMUs on a board needs samples with rests in unknown poses")
    accuracy = reference.stated(KEYS["known_poses"]) if known else {"pose_rad": 0.0, "angle_rad": 0.0}
    reference.done(also=KEYS["known_poses"])
    top.done(also=("time", "gyro", "site", "imu", "accelerometer"))
    return PoseMapping(
        name=path.name,
        text=text,
        format=file_format,
        timing=timing,
        accelerometer=accelerometer,
        scale_known=scale_known,
        gyro=gyro,
        gravity=gravity,
        least_s=stated["least_s"],
        known=known,
        accuracy=Accuracy(**accuracy),
        imus=imus,
        **named,
    )


def _timing(top: StrictTable, name: str, file_format: FileFormat, *, means: bool) -> Timing | None:
    """Return the timing of the mapping ``name``, None for files of ``means``, one row for each rest.

    The table's error if means come with times or gyros, RecordingError if samples have no table [time].
    """
    if not means:
        if not top.has("time"):
            raise RecordingError(
                f"{name} has no table [time]: add it, with column and unit of the stamps, or rate_hz if there are "
                'none; if each row is already the mean of one rest, write data = "means" in [reference]'
            )
        return read_timing(top.table("time"), file_format)
    if top.has("time"):
        raise top.table("time").fail(None, 'is not for data = "means", where each row is a rest: leave it out')
    if top.has("gyro"):
        raise top.table("gyro").fail(None, 'is not for data = "means", which holds no turns: leave it out')
    return None


def _imu(section: StrictTable, file_format: FileFormat) -> ImuColumns:
    """Return one IMU of a board; the section's error unless it states a name, accelerometers and three gyros."""
    name = section.string("name")
    accelerometer = section.table("accelerometer").whole(read_accelerometer)
    gyro = section.table("gyro").whole(partial(read_gyro, file_format=file_format))
    if len(gyro.array) != 3:
        raise section.fail("gyro", "needs three gyros")
    return ImuColumns(name=name, accelerometer=accelerometer, gyro=gyro)


def _accelerometer(section: StrictTable) -> tuple[Columns, bool]:
    """Return the accelerometers of a section, and whether the size of their unit is known.

    It is not for raw counts without ``count``: these stay counts along x, y, z. The section's error if it is invalid.
    """
    unsized = section.text_of("unit") == "raw" and not section.has("count")
    if not unsized:
        return section.whole(read_accelerometer), True
    section.string("unit")
    names: Sequence[str] = section.strings("columns")
    offset = section.number("offset", 0.0)
    section.done(also=("count", "count_unit", "axes"))
    return Columns(names=tuple(names), raw=True, offset=offset, width=3, axes=np.eye(3)), False


def _known(reference: StrictTable, timing: Timing | None, *, scale_known: bool) -> KnownSections:
    """Return the stated sections: turns, which have ``angle_deg``, and else poses.

    The table's error if one states neither or a turn of 0 deg, and with given means or accelerometers without a known
    unit.
    """
    if timing is None:
        raise reference.fail("sections", 'cannot be combined with data = "means"')
    if not scale_known:
        raise reference.fail("sections", "needs accelerometers with a known unit: state count and count_unit")
    cuts, tables = read_sections(reference)
    sections: dict[str, Pose | Turn] = {}
    for name, table in tables.items():
        if table.has("angle_deg"):
            turn = table.whole(read_turn)
            if not turn.angle_rad:
                raise table.fail("angle_deg", 'is 0: state a section that does not turn as a rest, such as up = "x"')
            sections[name] = turn
            continue
        pose = table.whole(read_pose)
        if pose.up is None:
            raise table.fail(None, 'states nothing: write up = "x" for a rest, or axis and angle_deg for a turn')
        sections[name] = pose
    return KnownSections(cuts, sections)


def _gravity(section: StrictTable, latitude_rad: float | None) -> Gravity:
    """Return gravity as stated, that of the site, or the standard one if neither is known.

    Its uncertainty is ``gravity_ppm``, by default ``UNMEASURED_GRAVITY``; ``UNKNOWN_GRAVITY`` for the standard one. The
    section's error if it is stated beside a site or beyond 9.7 to 9.9 m/s2, or has an uncertainty or height without
    either.
    """
    if section.has("gravity_mps2"):
        if latitude_rad is not None:
            raise section.fail("gravity_mps2", "is stated beside a table [site]: leave one of them out")
        value = section.number("gravity_mps2", least=9.7, most=9.9)
        sd = section.number("gravity_ppm", UNMEASURED_GRAVITY * 1e6, least=0.0) * 1e-6
        return Gravity(value_mps2=value, sd=sd, source="stated")
    if latitude_rad is not None:
        height_m = section.number("height_m", 0.0)
        sd = section.number("gravity_ppm", UNMEASURED_GRAVITY * 1e6, least=0.0) * 1e-6
        return Gravity(value_mps2=normal_gravity_mps2(latitude_rad, height_m), sd=sd, source="of the site")
    for key in ("gravity_ppm", "height_m"):
        if section.has(key):
            raise section.fail(key, "needs gravity_mps2, or a table [site] with latitude_deg")
    return Gravity(value_mps2=GRAVITY_MPS2, sd=UNKNOWN_GRAVITY, source="standard, as no site is stated")
