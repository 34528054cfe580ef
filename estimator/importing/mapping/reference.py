"""The table [reference] of a mapping file: what says how the body turned, or that it did not."""

import math
import re
from collections.abc import Callable
from collections.abc import Mapping as Dict
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np

from estimator.importing.mapping.columns import Columns, Vector, body_axis, signed_axis, stated_columns
from estimator.strict_toml import StrictTable

T = TypeVar("T")

KINDS = ("attitude", "rate", "angle", "turns", "rest", "gravity")


@dataclass(frozen=True, slots=True)
class AttitudeColumns:
    """Quaternions: ``order`` is wxyz or xyzw; ``inverted`` if they turn reference vectors into the body."""

    columns: Columns
    order: str
    inverted: bool


@dataclass(frozen=True, slots=True)
class RateColumns:
    """Body rates of another instrument: x y z, or one about a body axis (unit vector)."""

    columns: Columns
    axis: Vector | None


@dataclass(frozen=True, slots=True)
class AngleColumn:
    """The angle of an encoder: the body turns about gimbal x, y or z by ``sign`` times it."""

    columns: Columns
    gimbal: str
    sign: float
    earth_rate: bool


@dataclass(frozen=True, slots=True)
class Turn:
    """A stated turn about a body axis (unit vector); a rest pose turns by 0."""

    axis: Vector
    angle_rad: float


@dataclass(frozen=True, slots=True)
class Pose:
    """A body at rest: directions in body axes that point up and north, where they are stated."""

    up: Vector | None = None
    north: Vector | None = None


@dataclass(frozen=True, slots=True)
class Cuts:
    """How a file is cut into sections: rows (JSON beside the data), labels, or seconds from the first sample."""

    list_name: str | None = None
    column: str | None = None
    limits_s: Dict[str, tuple[float, float]] = field(default_factory=dict)


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
    """Several turns a file."""

    cuts: Cuts
    sections: Dict[str, Turn]
    checks: TurnChecks


@dataclass(frozen=True, slots=True)
class Gravity:
    """An accelerometer that says what points up, each direction to ``sd_rad``; ``from_rests``: its errors, too."""

    from_rests: bool
    sd_rad: float


@dataclass(frozen=True, slots=True)
class Rests:
    """The body rests: in sections if there are any, else in ``pose``, everywhere or where the samples are quiet.

    ``files`` are poses by name of file. At rest the output is within ``limit_rps``, for ``least_s`` or longer.
    With ``gravity`` what the accelerometer feels there is the reference of the turns between.
    """

    everywhere: bool
    pose: Pose
    files: Dict[str, Pose]
    cuts: Cuts
    sections: Dict[str, Pose]
    limit_rps: float
    least_s: float
    earth_rate: bool
    gravity: Gravity | None = None


MeasuredReference = AttitudeColumns | RateColumns | AngleColumn
ForeignReference = MeasuredReference | FileTurns | SectionTurns | Rests


def read_reference(section: StrictTable, *, wide: bool = False) -> ForeignReference:
    """Return the reference that a mapping states; in ``wide`` files a name can be that of several columns.

    Raises RecordingError with file, line and what to write.
    """
    kind = section.string("kind", one_of=KINDS)
    reference: ForeignReference
    if kind == "attitude":
        order = section.string("order", one_of=("wxyz", "xyzw"))
        direction = section.string("direction", "body to reference", one_of=("body to reference", "reference to body"))
        reference = AttitudeColumns(Columns(section.strings("columns")), order, direction == "reference to body")
    elif kind == "rate":
        columns = stated_columns(section, "rate")
        reference = RateColumns(columns, _rate_axis(section, columns, wide))
    elif kind == "angle":
        reference = _angle(section)
    elif kind == "turns":
        reference = _turns(section)
    else:
        reference = _rests(section, by_gravity=kind == "gravity")
    if wide and isinstance(reference, (SectionTurns, Rests)) and reference.cuts.column:
        raise section.fail("section_column", "is for text files: write section_list, or start_s and end_s in sections")
    section.done()
    return reference


def turn_about(axis: str, angle_deg: float) -> Turn:
    """Return the turn about +-x, y or z; ValueError for another axis. An empty axis is right for a rest only."""
    if not axis.strip().lstrip("+-") and angle_deg == 0:
        return Turn((0.0, 0.0, 0.0), 0.0)
    x, y, z = signed_axis(axis)
    sign = -1.0 if x + y + z < 0 else 1.0
    return Turn((abs(x), abs(y), abs(z)), sign * math.radians(angle_deg))


def _rate_axis(section: StrictTable, columns: Columns, wide: bool) -> Vector | None:
    if not section.has("axis"):
        if len(columns.names) == 1 and not wide:
            raise section.fail("columns", 'is one column: add axis = "z", the body axis that it is the rate about')
        return None
    if len(columns.names) != 1:
        raise section.fail("axis", "is for one column: leave it out beside the three columns x, y, z")
    return _direction(section, "axis")


def _direction(section: StrictTable, key: str) -> Vector:
    """Take a direction in body axes; it becomes a unit vector."""
    v = np.array(body_axis(section, key, section.value(key)))
    length = float(np.linalg.norm(v))
    if not length > 0:
        raise section.fail(key, "is no direction: write x, y or z with a sign, or three numbers")
    x, y, z = (v / length).tolist()
    return x, y, z


def _angle(section: StrictTable) -> AngleColumn:
    column = stated_columns(section, "angle", "column")
    if len(column.names) != 1:
        raise section.fail("column", "must be one column")
    axis = body_axis(section, "axis", section.string("axis"))
    gimbal = "xyz"[int(np.argmax(np.abs(axis)))]
    return AngleColumn(column, gimbal, float(sum(axis)), section.flag("earth_rate", False))


def _turns(section: StrictTable) -> FileTurns | SectionTurns:
    checks = TurnChecks(
        sd_rad=math.radians(section.number("sd_deg", positive=True)),
        sd_share=section.number("sd_share", 0.0, least=0.0),
        rest_sd_rad=math.radians(section.number("rest_sd_deg", 0.05, least=0.0)),
        sign_from_data=section.string("sign", "stated", one_of=("stated", "from data")) == "from data",
        rest_limit_rps=math.radians(section.number("rest_limit_dps", 2.0, positive=True)),
        rest_s=section.number("rest_s", 0.25, positive=True),
    )
    if section.has("sections"):
        cuts, tables = _sections(section)
        return SectionTurns(cuts, _each(tables, _turn), checks)
    if section.has("file_name"):
        return FileTurns(_pattern(section), None, checks)
    if not section.has("angle_deg"):
        raise section.fail("angle_deg", "is missing: give it, or file_name (an expression), or sections")
    return FileTurns(None, _turn(section), checks)


def _turn(section: StrictTable) -> Turn:
    angle_deg, axis = section.number("angle_deg"), section.string("axis", "")
    try:
        return turn_about(axis, angle_deg)
    except ValueError as error:
        raise section.fail("axis", str(error)) from None


def _pattern(section: StrictTable) -> re.Pattern[str]:
    text = section.string("file_name")
    try:
        pattern = re.compile(text)
    except re.error as error:
        raise section.fail("file_name", f"is no regular expression: {error}") from None
    if not {"axis", "angle_deg"} <= set(pattern.groupindex):
        raise section.fail("file_name", "needs the groups (?P<axis>...) and (?P<angle_deg>...)")
    return pattern


def _rests(section: StrictTable, *, by_gravity: bool) -> Rests:
    gravity = None
    if by_gravity:
        from_rests = section.string("accelerometer", "from rests", one_of=("from rests", "stated")) == "from rests"
        gravity = Gravity(from_rests, math.radians(section.number("sd_deg", 0.0 if from_rests else 0.1, least=0.0)))
    limit_rps = math.radians(section.number("rest_limit_dps", 2.0, positive=True))
    least_s = section.number("rest_s", 2.0, positive=True)
    earth_rate = section.flag("earth_rate", False)
    cuts, everywhere = Cuts(), False
    sections: dict[str, Pose] = {}
    if section.has("sections"):
        for key in ("where", "up", "north"):
            if section.has(key):
                raise section.fail(key, "is not for a mapping with sections: they say where, each with its own up")
        cuts, tables = _sections(section)
        sections = _each(tables, _pose)
    else:
        everywhere = section.string("where", "found", one_of=("found", "everywhere")) == "everywhere"
    listed = section.table("files", optional=True)
    files = _each({name: listed.table(name) for name in listed.remaining()}, _pose)
    return Rests(everywhere, _pose(section), files, cuts, sections, limit_rps, least_s, earth_rate, gravity)


def _each(tables: dict[str, StrictTable], read: Callable[[StrictTable], T]) -> dict[str, T]:
    """Return what is made of each table, of which every key must have been taken."""
    found = {}
    for name, table in tables.items():
        found[name] = read(table)
        table.done()
    return found


def _pose(section: StrictTable) -> Pose:
    found = {key: _direction(section, key) for key in ("up", "north") if section.has(key)}
    if "north" in found and "up" not in found:
        raise section.fail("north", "is stated without up: add up, the body axis that points up")
    if "north" in found and abs(float(np.dot(found["up"], found["north"]))) > 0.1:
        raise section.fail("north", "is not at a right angle to up: north is horizontal")
    return Pose(found.get("up"), found.get("north"))


def _sections(section: StrictTable) -> tuple[Cuts, dict[str, StrictTable]]:
    """Return how files are cut, and the table of each section less its limits."""
    table = section.table("sections")
    tables = {name: table.table(name) for name in table.remaining()}
    if not tables:
        raise section.fail("sections", "is empty: name a section and what is known of it")
    list_name = section.string("section_list") if section.has("section_list") else None
    column = section.string("section_column") if section.has("section_column") else None
    timed = [name for name, own in tables.items() if own.has("start_s") or own.has("end_s")]
    if (list_name is not None) + (column is not None) + bool(timed) != 1:
        raise section.fail(
            "sections",
            "needs section_list (a JSON file), section_column (labels), or start_s and end_s in each: one of the three",
        )
    limits = {}
    for name, own in tables.items() if timed else ():
        start, end = own.number("start_s", least=0.0), own.number("end_s", positive=True)
        if end <= start:
            raise own.fail("end_s", f"{end:g} is not after start_s {start:g}")
        limits[name] = (start, end)
    return Cuts(list_name, column, limits), tables
