"""The mapping file: the meaning of columns in an external recording. Read strictly (docs/pages/reference/mapping.md).

Units are those of the foreign file here and only here; what leaves this module is SI.
"""

import math
import re
from collections.abc import Callable, Mapping as Dict, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.effects.catalogue import records
from estimator.effects.effect import Kind
from estimator.errors import GeometryError, RecordingError
from estimator.geometry.array import SensorArray, sensor_array
from estimator.geometry.kinematics import Site
from estimator.geometry.model import Prior
from estimator.importing.mapping.columns import KEYS, Columns, Vector, direction, stated_columns
from estimator.importing.mapping.reference import ExternalReference, Measured, Rests, read_reference
from estimator.importing.stamps import ISO
from estimator.packaged import sentence
from estimator.strict_toml import StrictTable, not_one_of
from estimator.types import Floats
from estimator.untrusted import read_text

_COLUMN = re.compile(r"(?P<name>\S+) (?P<many>\d*)(?P<kind>[iu][1248]|f[48]|V)")


Capture = Callable[[bytes, Sequence[str]], tuple[Dict[str, NDArray[np.float64]], tuple[str, ...]]]
"""Decodes a capture to columns (rows,) or (rows, width), a row for each value of the first that is named, and notes."""
Protocols = Dict[str, Callable[[StrictTable, Path], Capture]]
"""For each protocol what takes its keys from the table [file] of a mapping, whose folder is given."""


@dataclass(frozen=True, slots=True)
class FileFormat:
    """``kind`` is csv, mat, binary or a protocol; limits select data rows (from 0), and seconds among these.

    Text is split at ``delimiter`` (empty: at blanks) and has a ``decimal`` mark; without a heading its ``columns`` are
    named. Binary files are a header and then one ``record`` per row.
    """

    kind: str
    delimiter: str = ","
    decimal: str = "."
    columns: tuple[str, ...] = ()
    record: np.dtype[Any] | None = None
    header_bytes: int = 0
    capture: Capture | None = None
    from_row: float = 0.0
    until_row: float = math.inf
    from_s: float = 0.0
    until_s: float = math.inf


@dataclass(frozen=True, slots=True)
class Timing:
    """A fixed ``rate`` in Hz, or a variable that holds it, or a column of stamps (``scale`` converts to seconds).

    Stamps may be dates or times in the pattern ``calendar``, or a counter that wraps at ``wraps_at``.
    """

    rate: float | str = 0.0
    stamps: Columns | None = None
    calendar: str = ""
    wraps_at: float = math.inf


def beside(path: Path, name: str) -> Path:
    """Return the path of file ``name`` in the folder of ``path``; {stem} in it becomes the stem of that.

    RecordingError if it is not a plain name.
    """
    try:
        return path.with_name(name.replace("{stem}", path.stem))
    except ValueError:
        raise RecordingError(
            f"{name!r}: give the name of a file in the folder of {path.name}, without a path"
        ) from None


@dataclass(frozen=True, slots=True)
class ReferenceFile:
    """A reference in its own file; "{stem}" in its ``name`` is that of the data file.

    ``offset_s`` is added to its stamps; None to find it from the motion.
    """

    name: str
    format: FileFormat
    timing: Timing
    offset_s: float | None

    def beside(self, path: Path) -> Path:
        """Return where it is for a data file."""
        return beside(path, self.name)


@dataclass(frozen=True, slots=True, eq=False)
class GyroColumns:
    """Gyros with their nominal axes, and whether sign and scale of each are taken from the data."""

    columns: Columns
    array: SensorArray
    sign_from_data: bool
    scale_from_data: bool


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class Mapping:
    """The description of external files; ``text`` is that of the mapping file, stored in the recording."""

    name: str
    text: str
    format: FileFormat
    timing: Timing
    gyro: GyroColumns
    accelerometer: Columns | None
    temperature: Columns | None
    reference: ExternalReference
    reference_file: ReferenceFile | None
    site: Site | None
    device: str
    licence: str
    source: str
    prior: Prior
    accelerometer_file: ReferenceFile | None = None

    @property
    def names(self) -> list[str]:
        """Names of the columns of the data file, but for its time and its labels."""
        inline = self.reference.columns if isinstance(self.reference, Measured) and not self.reference_file else None
        felt = self.accelerometer if not self.accelerometer_file else None
        columns = (self.gyro.columns, felt, self.temperature, inline)
        return [name for own in columns if own for name in own.names]

    @property
    def earth_rate(self) -> bool:
        """Whether the Earth is taken to turn the body."""
        return isinstance(self.reference, (Measured, Rests)) and self.reference.earth_rate


def read_mapping(path: Path | str, protocols: Protocols | None = None) -> Mapping:
    """Return the mapping in a file.

    Captures of ``protocols``, by name, are formats besides csv, tsv, mat and binary. RecordingError, with file, line
    and what to write, if a table is missing or anything is unknown or wrong.
    """
    path = Path(path)
    text = read_text(path, RecordingError)
    top = StrictTable.parse(text, path.name, RecordingError)
    for name in ("device", "file", "time", "gyro", "reference"):
        if not top.has(name):
            how = ", with column and unit of the stamps, or rate_hz if there are none" if name == "time" else ""
            raise RecordingError(f"{path.name} has no table [{name}]: add it{how}")
    protocols, folder = protocols or {}, path.parent
    named = top.table("device").whole(lambda table: table.stated(KEYS["device"]))
    file_format = read_format(top.table("file"), protocols, folder)
    timing = read_timing(top.table("time"), file_format)
    gyro = top.table("gyro").whole(partial(read_gyro, file_format=file_format))
    felt = top.table("accelerometer") if top.has("accelerometer") else None
    beside_file = None
    if felt is not None and felt.has("file"):
        beside_file = _reference_file(felt, file_format, timing, protocols, folder)
        if beside_file.offset_s is None:
            raise felt.fail("time", 'offset_s = "from data" is for a reference: state the seconds to add to its stamps')
    accelerometer = felt.whole(read_accelerometer) if felt is not None else None
    warmth = partial(stated_columns, quantity="temperature", key="column")
    temperature = top.table("temperature").whole(warmth) if top.has("temperature") else None
    site = top.table("site").whole(lambda table: Site(**table.stated(KEYS["site"]))) if top.has("site") else None
    prior = Prior(**top.table("datasheet", optional=True).whole(lambda table: table.stated(KEYS["datasheet"])))
    top.table("undeclared", optional=True).whole(_check_undeclared)
    section = top.table("reference")
    other = _reference_file(section, file_format, timing, protocols, folder) if section.has("file") else None
    reference = read_reference(section, wide=(other.format if other else file_format).kind != "csv")
    top.done(also=("accelerometer", "temperature", "site", "datasheet", "undeclared"))
    mapping = Mapping(
        name=path.name,
        text=text,
        format=file_format,
        timing=timing,
        gyro=gyro,
        accelerometer=accelerometer,
        temperature=temperature,
        reference=reference,
        reference_file=other,
        site=site,
        **named,
        prior=prior,
        accelerometer_file=beside_file,
    )
    _check(mapping, section)
    return mapping


def _check_undeclared(section: StrictTable) -> None:
    """Raise the section's error for unknown effects; the excluded ones are read when states are estimated."""
    section.stated(KEYS["undeclared"])
    laws = [record.name for record in records() if record.kind is Kind.LAW and record.listed(1.0)]
    for name in section.strings("excluded") if section.has("excluded") else ():
        if name not in laws:
            raise section.fail("excluded", not_one_of(name, laws))


def _check(mapping: Mapping, section: StrictTable) -> None:
    """Raise RecordingError, or the section's error, for tables that cannot be combined.

    They are a reference file, signs or scales from data with a stated reference, gravity without an accelerometer, and
    Earth rate without a site or a direction up.
    """
    reference = mapping.reference
    if not isinstance(reference, Measured):
        if mapping.reference_file:
            raise section.fail("file", "is for kind = rate, angle or attitude")
        if mapping.gyro.sign_from_data or mapping.gyro.scale_from_data:
            key = "sign" if mapping.gyro.sign_from_data else "scale"
            raise RecordingError(sentence("importing.from_data", mapping=mapping.name, key=key))
    if isinstance(reference, Rests) and reference.gravity and mapping.accelerometer is None:
        raise section.fail("kind", "gravity as reference needs an accelerometer: add the table [accelerometer]")
    if not mapping.earth_rate:
        return
    if mapping.site is None:
        raise section.fail("earth_rate", "needs the latitude: add a table [site] with latitude_deg")
    if isinstance(reference, Rests) and mapping.accelerometer is None:
        poses = [reference.pose, *reference.files.values()] if not reference.sections else reference.sections.values()
        if any(pose.up is None for pose in poses) and not (reference.files and reference.pose.up is None):
            raise section.fail(
                "earth_rate", 'needs the direction up: add up = "z" (the body axis) or an [accelerometer]'
            )


def _reference_file(
    section: StrictTable, file_format: FileFormat, timing: Timing, protocols: Protocols, folder: Path
) -> ReferenceFile:
    """Return the separate file that a section names, with its format, time and offset.

    Stated by name it has the ``file_format`` of the data, without limits and names of columns; stated as a table, a
    format of its own. Its timing is ``timing`` unless its table of time states more than an offset. The offset is 0
    unless stated, None if it is to be found in the data.
    """
    offset_s: float | None = 0.0
    if isinstance(section.again().value("file"), str):
        name = section.string("file")
        own = replace(file_format, columns=(), from_row=0.0, until_row=math.inf, from_s=0.0, until_s=math.inf)
    else:
        stated = section.table("file")
        name, own = stated.string("name"), read_format(stated, protocols, folder)
    if section.has("time"):
        stated = section.table("time")
        told = isinstance(stated.again().value("offset_s"), str) and stated.string("offset_s", one_of=("from data",))
        offset_s = None if told else stated.number("offset_s", 0.0)
        timing = read_timing(stated, own) if stated.remaining() else timing
    return ReferenceFile(name, own, timing, offset_s)


def read_format(section: StrictTable, protocols: Protocols, folder: Path) -> FileFormat:
    """Return the file format of a section; the section's error for anything unknown, invalid limits or delimiters.

    Text is of kind csv, also where the section says tsv; its delimiter is "" for blanks. ``protocols`` are further
    formats, which may look for files in ``folder``.
    """
    limits = section.stated(KEYS["file"])
    for what in ("row", "s"):
        start, end = limits[f"from_{what}"], limits[f"until_{what}"]
        if end <= start:
            raise section.fail(f"until_{what}", f"{end:g} is not after from_{what} {start:g}")
    kind = section.string("format", one_of=("csv", "tsv", "mat", "binary", *protocols))
    if kind not in ("csv", "tsv"):
        record = _record(section) if kind == "binary" else None
        header_bytes = int(section.number("header_bytes", 0.0, least=0.0)) if kind == "binary" else 0
        capture = protocols[kind](section, folder) if kind in protocols else None
        section.done()
        return FileFormat(kind, record=record, header_bytes=header_bytes, capture=capture, **limits)
    delimiter = section.string("delimiter", "\t" if kind == "tsv" else ",")
    delimiter = {"tab": "\t", "space": " "}.get(delimiter, delimiter)
    decimal = section.string("decimal", ".", one_of=(".", ","))
    if len(delimiter) != 1 or delimiter == decimal:
        raise section.fail("delimiter", f"{delimiter!r}: write one character that is not the decimal mark")
    columns = section.strings("columns") if section.has("columns") else ()
    section.done(also=("columns",))
    return FileFormat("csv", delimiter.strip(" "), decimal, columns, **limits)


def _record(section: StrictTable) -> np.dtype[Any]:
    """Return the structured type of a binary row; the section's error if it is no list of different names with
    types.
    """
    order = section.string("byte_order", "little", one_of=("little", "big"))
    fields: dict[str, str] = {}
    if "," in section.text_of("record"):
        raise section.fail("record", 'must be a list with a text for each column, as in ["t f8", "gyro 3i2"]')
    for entry in section.strings("record"):
        found = _COLUMN.fullmatch(entry)
        if not found or found["name"] in fields:
            raise section.fail("record", f'holds {entry!r}: write a name and a type, "t f8", "gyro 3i2" or "pad 4V"')
        fields[found["name"]] = f"{found['many'] or ''}{found['kind']}" if found["kind"] != "V" else f"V{found['many']}"
    return np.dtype(list(fields.items())).newbyteorder("<" if order == "little" else ">")


def read_timing(section: StrictTable, file_format: FileFormat) -> Timing:
    """Return the timing of a section: stamps, a rate, or a variable with the rate.

    The section's error unless exactly one is given, or if it does not go with the format of the file.
    """
    given = [key for key in ("rate_hz", "rate_variable", "column") if section.has(key)]
    if len(given) != 1:
        raise section.fail(given[0] if given else None, sentence("importing.one_of_times"))
    if given[0] == "column":
        unit = section.again().value("unit")
        calendar = unit if unit == ISO else section.string("pattern") if unit == "pattern" else ""
        if calendar and file_format.kind != "csv":
            raise section.fail("unit", f"{unit} is for text files: write s, ms, us or ns")
        wraps_at = section.number("wraps_at", math.inf, positive=True)
        timing = Timing(0.0, stated_columns(section, "time", "column"), calendar, wraps_at)
    elif given[0] == "rate_variable":
        if file_format.kind != "mat":
            raise section.fail("rate_variable", "is for .mat files: write rate_hz or column")
        timing = Timing(section.string("rate_variable"))
    else:
        timing = Timing(section.number("rate_hz", positive=True))
    section.done(also=("rate_hz", "rate_variable", "column", "unit", "pattern"))
    return timing


def read_gyro(section: StrictTable, file_format: FileFormat) -> GyroColumns:
    """Return the gyros of a section; its error if anything in it is invalid, such as their number or axes.

    Without axes there are three along x, y, z. Without names they are named by their axes if these differ, else
    numbered. Text needs a column for each axis; in other files one name may stand for all.
    """
    taken = section.stated(KEYS["gyro"])
    columns = stated_columns(section, "rate", count_needed=not taken["scale_from_data"])
    where = "axes" if section.has("axes") else "columns"
    letters, p = section.take("axes", _axes(["x", "y", "z"]), _axes)
    if file_format.kind == "csv" and len(columns.names) != len(p):
        raise section.fail(where, sentence("importing.columns_of_axes", columns=len(columns.names), axes=len(p)))
    numbered = [f"gyro{i + 1}" for i in range(len(p))]
    named = [letter or number for letter, number in zip(letters, numbered, strict=True)]
    names = section.strings("names", tuple(named if len(set(named)) == len(named) else numbered))
    try:
        array = sensor_array(p, names=names, part_of_array=True)
    except GeometryError as error:
        raise section.fail("axes", f"cannot be used: {error}") from None
    return GyroColumns(replace(columns, width=len(p)), array, **taken)


def _axes(value: object) -> tuple[list[str], list[Vector]]:
    """Return the letters of sense axes, empty for three numbers, and their directions."""
    listed = [value] if isinstance(value, str) else value
    if not isinstance(listed, list):
        raise ValueError('must be a list: ["x", "-y", "z"] or one row of three numbers for each gyro')
    return [a.lstrip("+-") if isinstance(a, str) else "" for a in listed], [direction(a) for a in listed]


def read_accelerometer(section: StrictTable) -> Columns:
    """Return three accelerometers of a section; its error if unit or axes are invalid."""
    return replace(stated_columns(section, "acceleration"), axes=section.take("axes", np.eye(3), _square))


def _square(value: object) -> Floats:
    if not isinstance(value, list) or len(value) != 3:
        raise ValueError('must be the body axes of the three columns: ["x", "-y", "-z"]')
    square = np.array([direction(axis) for axis in value])
    if np.abs(square @ square.T - np.eye(3)).max() > 0.01:
        raise ValueError("must be three orthogonal directions of length 1")
    return square
