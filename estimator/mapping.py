"""The mapping file: what the columns of a foreign recording mean. TOML, read strictly; see the package README.

Units are those of the foreign file here and only here; what leaves this module is SI.
"""

from __future__ import annotations

import math
import tomllib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from estimator.array import SensorArray, sensor_array
from estimator.errors import GeometryError, RecordingError
from estimator.kinematics import Site
from estimator.mapping_columns import (
    ACCEL_UNITS,
    RATE_UNITS,
    TEMPERATURE_UNITS,
    TIME_UNITS,
    Columns,
    Vector,
    body_axis,
    stated_columns,
)
from estimator.mapping_reference import (
    AngleColumn,
    FileTurns,
    ForeignReference,
    Rests,
    SectionTurns,
    read_reference,
)
from estimator.strict_toml import StrictTable


@dataclass(frozen=True, slots=True)
class FileFormat:
    """``kind`` is csv or mat; text is split at ``delimiter`` (empty: at blanks), its numbers have a ``decimal`` mark.

    ``columns`` names the columns of a text file without a heading.
    """

    kind: str
    delimiter: str = ","
    decimal: str = "."
    columns: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Extent:
    """The part of a file that is read: data rows (the first is 0), and of these seconds from the first."""

    from_row: int = 0
    until_row: float = math.inf
    from_s: float = 0.0
    until_s: float = math.inf

    def rows(self, number: NDArray[np.int64]) -> NDArray[np.intp]:
        """Return where ``number`` (rows,), the numbers of data rows, is within the rows that are read."""
        return np.flatnonzero((number >= self.from_row) & (number < self.until_row))

    def within(self, t_s: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return which instants (rows,) are within the seconds that are read."""
        return np.asarray((t_s >= self.from_s) & (t_s <= self.until_s))


@dataclass(frozen=True, slots=True)
class Timing:
    """Either a fixed rate, or a variable that holds it, or a column of stamps (``scale`` makes seconds)."""

    rate_hz: float | None = None
    rate_variable: str | None = None
    stamps: Columns | None = None


@dataclass(frozen=True, slots=True, eq=False)
class GyroColumns:
    """Gyros with their nominal axes, and whether sign and scale of each are to be taken from the data."""

    columns: Columns
    array: SensorArray
    sign_from_data: bool
    scale_from_data: bool


@dataclass(frozen=True, slots=True)
class Accelerometer:
    """Specific force; column i is along body axis ``axes[i]``."""

    columns: Columns
    axes: tuple[Vector, Vector, Vector]


@dataclass(frozen=True, slots=True, eq=False)
class Mapping:
    """What is in foreign files; ``text`` is the mapping file itself, kept in the recording."""

    name: str
    text: str
    device: str
    licence: str
    source: str
    format: FileFormat
    extent: Extent
    timing: Timing
    gyro: GyroColumns
    accelerometer: Accelerometer | None
    temperature: Columns | None
    reference: ForeignReference
    site: Site | None


def read_mapping(path: Path) -> Mapping:
    """Read a mapping file; RecordingError with file, line and what to write for anything unknown or wrong."""
    try:
        text = path.read_text(encoding="utf-8")
        values = tomllib.loads(text)
    except OSError as error:
        raise RecordingError(f"{path} cannot be read: {error.strerror}; give the path of a mapping (.toml)") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise RecordingError(f"{path} is not TOML: {error}") from None
    top = StrictTable(values, (), text, path.name, RecordingError)
    for name in ("device", "file", "time", "gyro", "reference"):
        if not top.has(name):
            raise RecordingError(f"{path.name} has no table [{name}]: add it")
    device = top.table("device")
    named = (device.string("name"), device.string("licence", ""), device.string("source", ""))
    device.done()
    file_section = top.table("file")
    extent, file_format = _extent(file_section), _format(file_section)
    timing = _timing(top.table("time"), file_format)
    gyro = _gyro(top.table("gyro"), file_format)
    accelerometer = _accelerometer(top.table("accelerometer")) if top.has("accelerometer") else None
    temperature = _temperature(top.table("temperature")) if top.has("temperature") else None
    site = _site(top.table("site")) if top.has("site") else None
    section = top.table("reference")
    reference = read_reference(section)
    top.done(also=("accelerometer", "temperature", "site"))
    mapping = Mapping(
        path.name, text, *named, file_format, extent, timing, gyro, accelerometer, temperature, reference, site
    )
    _check(mapping, section)
    return mapping


def _check(mapping: Mapping, section: StrictTable) -> None:
    """Refuse tables that do not go together."""
    reference = mapping.reference
    if isinstance(reference, (SectionTurns, Rests)) and reference.cuts.column and mapping.format.kind == "mat":
        raise section.fail("section_column", "is for text files: write section_list, or start_s and end_s in sections")
    if isinstance(reference, (Rests, FileTurns, SectionTurns)):
        for key, asked in (("sign", mapping.gyro.sign_from_data), ("scale", mapping.gyro.scale_from_data)):
            if asked:
                raise RecordingError(
                    f'{mapping.name}: {key} = "from data" in [gyro] needs a rate, an angle or an attitude beside the '
                    "samples; against turns or rests state axes, unit and count"
                )
    if not isinstance(reference, (AngleColumn, Rests)) or not reference.earth_rate:
        return
    if mapping.site is None:
        raise section.fail("earth_rate", "needs the latitude: add a table [site] with latitude_deg")
    if isinstance(reference, Rests) and mapping.accelerometer is None:
        poses = [reference.pose, *reference.files.values()] if not reference.sections else reference.sections.values()
        if any(pose.up is None for pose in poses) and not (reference.files and reference.pose.up is None):
            raise section.fail(
                "earth_rate", 'needs to know what points up: add up = "z" (the body axis) or an [accelerometer]'
            )


def _extent(section: StrictTable) -> Extent:
    """Take the limits of what is read."""
    from_row, from_s = section.integer("from_row", 0), section.number("from_s", 0.0, least=0.0)
    until_row, until_s = section.value("until_row", math.inf), section.value("until_s", math.inf)
    for key, start, end in (("until_row", from_row, until_row), ("until_s", from_s, until_s)):
        if not isinstance(end, (int, float)) or not end > start >= 0:
            raise section.fail(key, f"{end!r} is not after {key.replace('until', 'from')} {start:g}")
    return Extent(from_row, until_row, from_s, until_s)


def _format(section: StrictTable) -> FileFormat:
    kind = section.string("format", one_of=("csv", "tsv", "mat"))
    if kind == "mat":
        section.done()
        return FileFormat("mat")
    delimiter = section.string("delimiter", "\t" if kind == "tsv" else ",")
    delimiter = {"tab": "\t", "space": " "}.get(delimiter, delimiter)
    decimal = section.string("decimal", ".", one_of=(".", ","))
    if len(delimiter) != 1 or delimiter == decimal:
        raise section.fail("delimiter", f"{delimiter!r}: write one character that is not the decimal mark")
    columns = section.strings("columns") if section.has("columns") else ()
    section.done(also=("columns",))
    return FileFormat("csv", delimiter.strip(" "), decimal, columns)


def _timing(section: StrictTable, file_format: FileFormat) -> Timing:
    given = [key for key in ("rate_hz", "rate_variable", "column") if section.has(key)]
    if len(given) != 1:
        raise section.fail(given[0] if given else None, "give one of rate_hz, rate_variable, column")
    timing: Timing
    if given[0] == "column":
        unit = section.string("unit", one_of=tuple(TIME_UNITS))
        timing = Timing(stamps=Columns((section.string("column"),), TIME_UNITS[unit]))
    elif given[0] == "rate_variable":
        if file_format.kind != "mat":
            raise section.fail("rate_variable", "is for .mat files: write rate_hz or column")
        timing = Timing(rate_variable=section.string("rate_variable"))
    else:
        timing = Timing(rate_hz=section.number("rate_hz", positive=True))
    section.done(also=("rate_hz", "rate_variable", "column", "unit"))
    return timing


def _gyro(section: StrictTable, file_format: FileFormat) -> GyroColumns:
    sign = section.string("sign", "stated", one_of=("stated", "from data")) == "from data"
    scale = section.string("scale", "stated", one_of=("stated", "from data")) == "from data"
    columns = stated_columns(section, RATE_UNITS, count_needed=not scale)
    where = "axes" if section.has("axes") else "columns"
    axes = section.value("axes", ("x", "y", "z"))
    if isinstance(axes, str):
        axes = [axes]
    if not isinstance(axes, (list, tuple)):
        raise section.fail("axes", 'must be a list: ["x", "-y", "z"] or one row of three numbers for each gyro')
    p = [body_axis(section, "axes", axis) for axis in axes]
    if file_format.kind != "mat" and len(columns.names) != len(axes):
        raise section.fail(
            where,
            f"does not fit: there are {len(columns.names)} columns and {len(axes)} axes (x, y, z if none are stated); "
            'state the sense axis of each column, for instance axes = ["z"] for one gyro',
        )
    fallback = [a.lstrip("+-") if isinstance(a, str) else f"gyro{i + 1}" for i, a in enumerate(axes)]
    if len(set(fallback)) < len(fallback):
        fallback = [f"gyro{i + 1}" for i in range(len(axes))]
    names = section.strings("names", tuple(fallback))
    try:
        array = sensor_array(p, names=names, part_of_array=True)
    except GeometryError as error:
        raise section.fail("axes", f"cannot be used: {error}") from None
    section.done()
    return GyroColumns(columns, array, sign, scale)


def _accelerometer(section: StrictTable) -> Accelerometer:
    columns = stated_columns(section, ACCEL_UNITS)
    stated = section.value("axes", ["x", "y", "z"])
    if not isinstance(stated, list) or len(stated) != 3:
        raise section.fail("axes", 'must be the body axes of the three columns: ["x", "-y", "-z"]')
    x, y, z = (body_axis(section, "axes", axis) for axis in stated)
    square = np.array([x, y, z])
    if np.abs(square @ square.T - np.eye(3)).max() > 0.01:
        raise section.fail("axes", "must be three directions of length 1 at right angles")
    section.done()
    return Accelerometer(columns, (x, y, z))


def _temperature(section: StrictTable) -> Columns:
    columns = stated_columns(section, TEMPERATURE_UNITS, key="column")
    section.done()
    return columns


def _site(section: StrictTable) -> Site:
    latitude = section.number("latitude_deg", least=-90.0)
    if latitude > 90:
        raise section.fail("latitude_deg", f"{latitude:g}: write -90 to 90")
    site = Site(math.radians(latitude), math.radians(section.number("heading_deg", 0.0)))
    section.done()
    return site
