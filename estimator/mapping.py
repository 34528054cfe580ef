"""The mapping file: what the columns of a foreign recording mean. TOML, read strictly; see the package README.

Units are those of the foreign file here and only here; what leaves this module is SI.
"""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Mapping as Dict
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from estimator.array import SensorArray, sensor_array
from estimator.errors import GeometryError, RecordingError
from estimator.strict_toml import Section

RATE_UNITS = {"rad/s": 1.0, "deg/s": math.pi / 180}
ACCEL_UNITS = {"m/s2": 1.0, "g": 9.80665}
TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
TEMPERATURE_UNITS = {"degC": 0.0, "K": -273.15}
UNIT_AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


@dataclass(frozen=True, slots=True)
class Columns:
    """Columns of a text file, or variables of a .mat file; values are multiplied by ``scale``, then shifted."""

    names: tuple[str, ...]
    scale: float = 1.0
    shift: float = 0.0


@dataclass(frozen=True, slots=True)
class FileFormat:
    """``kind`` is csv or mat; text is split at ``delimiter`` and its numbers have this ``decimal`` mark."""

    kind: str
    delimiter: str = ","
    decimal: str = "."


@dataclass(frozen=True, slots=True)
class Timing:
    """Either a fixed rate, or a variable that holds it, or a column of stamps (``scale`` makes seconds)."""

    rate_hz: float | None = None
    rate_variable: str | None = None
    stamps: Columns | None = None


@dataclass(frozen=True, slots=True)
class AttitudeColumns:
    """Quaternions: ``order`` is wxyz or xyzw; ``inverted`` if they turn reference vectors into the body."""

    columns: Columns
    order: str
    inverted: bool


@dataclass(frozen=True, slots=True)
class RateColumns:
    """Body rates of another instrument, x y z."""

    columns: Columns


@dataclass(frozen=True, slots=True)
class Turn:
    """A stated turn about a body axis (unit vector); a rest pose turns by 0."""

    axis: tuple[float, float, float]
    angle_rad: float


@dataclass(frozen=True, slots=True)
class TurnChecks:
    """Doubt of a stated angle: fixed and as a share of it; that of a rest; and what counts as rest."""

    sd_rad: float
    sd_share: float
    rest_sd_rad: float
    sign_from_data: bool
    rest_limit_rps: float
    rest_s: float


@dataclass(frozen=True, slots=True)
class FileTurns:
    """One turn a file, stated here or by the named groups ``axis`` and ``angle_deg`` of the file's name."""

    pattern: re.Pattern[str] | None
    turn: Turn | None
    checks: TurnChecks


@dataclass(frozen=True, slots=True)
class SectionTurns:
    """Several turns a file; a list of row numbers (JSON, beside the data) or a column of labels cuts it."""

    list_name: str | None
    column: str | None
    sections: Dict[str, Turn]
    checks: TurnChecks


ForeignReference = AttitudeColumns | RateColumns | FileTurns | SectionTurns


@dataclass(frozen=True, slots=True, eq=False)
class Mapping:
    """What is in foreign files; ``text`` is the mapping file itself, kept in the recording."""

    name: str
    text: str
    device: str
    licence: str
    source: str
    format: FileFormat
    timing: Timing
    array: SensorArray
    gyro: Columns
    accelerometer: Columns | None
    temperature: Columns | None
    reference: ForeignReference


def read_mapping(path: Path) -> Mapping:
    """Read a mapping file; RecordingError with file, line and what to write for anything unknown or wrong."""
    try:
        text = path.read_text(encoding="utf-8")
        values = tomllib.loads(text)
    except OSError as error:
        raise RecordingError(f"{path} cannot be read: {error.strerror}; give the path of a mapping (.toml)") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise RecordingError(f"{path} is not TOML: {error}") from None
    top = Section(path.name, text, "", values)
    for name in ("device", "file", "time", "gyro", "reference"):
        if not top.has(name):
            raise RecordingError(f"{path.name} has no table [{name}]: add it")
    device = top.table("device")
    named = (device.text("name"), device.text("licence", ""), device.text("source", ""))
    device.done()
    file_format = _format(top.table("file"))
    timing = _timing(top.table("time"), file_format)
    array, gyro = _gyro(top.table("gyro"))
    accelerometer = _accelerometer(top.table("accelerometer")) if top.has("accelerometer") else None
    temperature = _temperature(top.table("temperature")) if top.has("temperature") else None
    reference = _reference(top.table("reference"))
    if file_format.kind == "mat" and isinstance(reference, SectionTurns) and reference.column:
        raise RecordingError(f"{path.name}: section_column is for text files: write section_list")
    top.done(also=("accelerometer", "temperature"))
    return Mapping(path.name, text, *named, file_format, timing, array, gyro, accelerometer, temperature, reference)


def turn_about(axis: str, angle_deg: float) -> Turn:
    """Return the turn about +-x, y or z; ValueError for another axis. An empty axis is right for a rest only."""
    letter = axis.strip().lower()
    sign = -1.0 if letter.startswith("-") else 1.0
    letter = letter.lstrip("+-")
    if not letter and angle_deg == 0:
        return Turn((0.0, 0.0, 0.0), 0.0)
    if letter not in UNIT_AXES:
        raise ValueError(f"{axis!r} is no axis: write x, y or z, with a sign if need be")
    return Turn(UNIT_AXES[letter], sign * math.radians(angle_deg))


def _format(section: Section) -> FileFormat:
    kind = section.text("format", one_of=("csv", "tsv", "mat"))
    if kind == "mat":
        section.done()
        return FileFormat("mat")
    delimiter = section.text("delimiter", "\t" if kind == "tsv" else ",")
    delimiter = "\t" if delimiter == "tab" else delimiter
    decimal = section.text("decimal", ".", one_of=(".", ","))
    if len(delimiter) != 1 or delimiter == decimal:
        raise section.wrong("delimiter", f"is {delimiter!r}: write one character that is not the decimal mark")
    section.done()
    return FileFormat("csv", delimiter, decimal)


def _timing(section: Section, file_format: FileFormat) -> Timing:
    given = [key for key in ("rate_hz", "rate_variable", "column") if section.has(key)]
    if len(given) != 1:
        raise section.wrong(given[0] if given else "rate_hz", "or column or rate_variable: give one of the three")
    timing: Timing
    if given[0] == "column":
        unit = section.text("unit", one_of=tuple(TIME_UNITS))
        timing = Timing(stamps=Columns((section.text("column"),), TIME_UNITS[unit]))
    elif given[0] == "rate_variable":
        if file_format.kind != "mat":
            raise section.wrong("rate_variable", "is for .mat files: write rate_hz or column")
        timing = Timing(rate_variable=section.text("rate_variable"))
    else:
        timing = Timing(rate_hz=section.number("rate_hz", positive=True))
    section.done(also=("rate_hz", "rate_variable", "column", "unit"))
    return timing


def _scale(section: Section, units: Dict[str, float]) -> float:
    """Return what makes SI of a column: its unit, or for raw counts the size of a count."""
    unit = section.text("unit", one_of=(*units, "raw"))
    if unit != "raw":
        return units[unit]
    size_unit = section.text("count_unit", one_of=tuple(units))
    return section.number("count", positive=True) * units[size_unit]


def _gyro(section: Section) -> tuple[SensorArray, Columns]:
    columns = Columns(section.texts("columns"), _scale(section, RATE_UNITS))
    axes = section.any("axes", ("x", "y", "z"))
    if not isinstance(axes, (list, tuple)):
        raise section.wrong("axes", 'must be a list: ["x", "-y", "z"] or one row of three numbers for each gyro')
    p = [_sense_axis(section, axis) for axis in axes]
    fallback = [a.lstrip("+-") if isinstance(a, str) else f"gyro{i + 1}" for i, a in enumerate(axes)]
    if len(set(fallback)) < len(fallback):
        fallback = [f"gyro{i + 1}" for i in range(len(axes))]
    names = section.texts("names", tuple(fallback))
    try:
        array = sensor_array(p, names=names, part_of_array=True)
    except GeometryError as error:
        raise section.wrong("axes", f"cannot be used: {error}") from None
    section.done()
    return array, columns


def _sense_axis(section: Section, axis: Any) -> list[float]:
    if isinstance(axis, str):
        try:
            turn = turn_about(axis, 1.0)
        except ValueError as error:
            raise section.wrong("axes", str(error)) from None
        return [float(v) for v in np.sign(turn.angle_rad) * np.array(turn.axis)]
    numbers = isinstance(axis, list) and len(axis) == 3 and all(isinstance(v, (int, float)) for v in axis)
    if not numbers:
        raise section.wrong("axes", f"holds {axis!r}: write x, y or z with a sign, or three numbers")
    return [float(v) for v in axis]


def _accelerometer(section: Section) -> Columns:
    columns = Columns(section.texts("columns"), _scale(section, ACCEL_UNITS))
    section.done()
    return columns


def _temperature(section: Section) -> Columns:
    unit = section.text("unit", one_of=tuple(TEMPERATURE_UNITS))
    columns = Columns((section.text("column"),), shift=TEMPERATURE_UNITS[unit])
    section.done()
    return columns


def _reference(section: Section) -> ForeignReference:
    kind = section.text("kind", one_of=("attitude", "rate", "turns"))
    reference: ForeignReference
    if kind == "attitude":
        order = section.text("order", one_of=("wxyz", "xyzw"))
        direction = section.text("direction", "body to reference", one_of=("body to reference", "reference to body"))
        columns = Columns(section.texts("columns"))
        reference = AttitudeColumns(columns, order, direction == "reference to body")
    elif kind == "rate":
        reference = RateColumns(Columns(section.texts("columns"), _scale(section, RATE_UNITS)))
    else:
        reference = _turns(section)
    section.done()
    return reference


def _turns(section: Section) -> FileTurns | SectionTurns:
    checks = TurnChecks(
        sd_rad=math.radians(section.number("sd_deg", positive=True)),
        sd_share=section.number("sd_share", 0.0, least=0.0),
        rest_sd_rad=math.radians(section.number("rest_sd_deg", 0.05, least=0.0)),
        sign_from_data=section.text("sign", "stated", one_of=("stated", "from data")) == "from data",
        rest_limit_rps=math.radians(section.number("rest_limit_dps", 2.0, positive=True)),
        rest_s=section.number("rest_s", 0.25, positive=True),
    )
    if section.has("sections"):
        if section.has("section_list") == section.has("section_column"):
            raise section.wrong("sections", "needs section_list (a JSON file) or section_column (labels), one of them")
        name = section.text("section_list") if section.has("section_list") else None
        column = section.text("section_column") if section.has("section_column") else None
        table = section.table("sections")
        return SectionTurns(name, column, {key: _stated_turn(table.table(key)) for key in table.remaining()}, checks)
    if section.has("file_name"):
        return FileTurns(_pattern(section), None, checks)
    if not section.has("angle_deg"):
        raise section.wrong("angle_deg", "is missing: give it, or file_name (an expression), or sections")
    axis, angle_deg = section.text("axis", ""), section.number("angle_deg")
    try:
        return FileTurns(None, turn_about(axis, angle_deg), checks)
    except ValueError as error:
        raise section.wrong("axis", str(error)) from None


def _pattern(section: Section) -> re.Pattern[str]:
    text = section.text("file_name")
    try:
        pattern = re.compile(text)
    except re.error as error:
        raise section.wrong("file_name", f"is no regular expression: {error}") from None
    if not {"axis", "angle_deg"} <= set(pattern.groupindex):
        raise section.wrong("file_name", "needs the groups (?P<axis>...) and (?P<angle_deg>...)")
    return pattern


def _stated_turn(section: Section) -> Turn:
    angle_deg, axis = section.number("angle_deg"), section.text("axis", "")
    section.done()
    try:
        return turn_about(axis, angle_deg)
    except ValueError as error:
        raise section.wrong("axis", str(error)) from None
