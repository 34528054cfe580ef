"""The table [reference] of a mapping file: how the body turned, or that it did not."""

import math
import re
from collections.abc import Mapping as Dict
from dataclasses import dataclass, field, replace

import numpy as np

from estimator.importing.mapping.columns import KEYS, Columns, Vector, direction, signed_axis, stated_columns
from estimator.packaged import sentence
from estimator.strict_toml import StrictTable, typed


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """Data of another instrument: ``kind`` is attitude (w x y z, body to reference), body rate, or angle.

    An angle is that of an encoder: the body turns by it about ``gimbal`` x, y or z.
    """

    kind: str
    columns: Columns
    gimbal: str = ""
    earth_rate: bool = False


@dataclass(frozen=True, slots=True)
class Turn:
    """A stated turn about a body axis (unit vector); 0 for a rest."""

    axis: Vector
    angle_rad: float


@dataclass(frozen=True, slots=True)
class Pose:
    """A body at rest: directions in body axes that point up and north, where stated."""

    up: Vector | None = None
    north: Vector | None = None


@dataclass(frozen=True, slots=True)
class Cuts:
    """How a file is cut into sections: rows (JSON beside the data), labels, or seconds from the first sample."""

    list_name: str | None = None
    column: str | None = None
    limits_s: Dict[str, tuple[float, float]] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class StatedTurns:
    """Turns in ``sections``, or one per file: ``turn``, or by the groups axis and angle_deg in the file's name.

    The uncertainty of an angle is ``sd_rad`` and a share of it, that of 0 is ``rest_sd_rad``. Before and after a turn
    the output is within ``rest_limit_rps`` for ``rest_s``.
    """

    sd_rad: float
    sd_share: float
    rest_sd_rad: float
    sign_from_data: bool
    rest_limit_rps: float
    rest_s: float
    cuts: Cuts = field(default_factory=Cuts)
    sections: Dict[str, Turn] = field(default_factory=dict)
    turn: Turn | None = None
    pattern: re.Pattern[str] | None = None


@dataclass(frozen=True, slots=True)
class Gravity:
    """An accelerometer that shows what is up, each direction to ``sd_rad``; ``from_rests``: its errors are estimated,
    too.
    """

    from_rests: bool
    sd_rad: float


@dataclass(frozen=True, slots=True)
class Rests:
    """The body rests: in sections if there are any, else in ``pose``, everywhere or where the samples are quiet.

    ``files`` are poses by file name. At rest the output is within ``limit_rps``, for at least ``least_s``. With
    ``gravity`` the specific force there is the reference for the turns in between.
    """

    limit_rps: float
    least_s: float
    earth_rate: bool
    pose: Pose
    files: Dict[str, Pose]
    everywhere: bool = False
    cuts: Cuts = field(default_factory=Cuts)
    sections: Dict[str, Pose] = field(default_factory=dict)
    gravity: Gravity | None = None


@dataclass(frozen=True, slots=True)
class KnownSections:
    """Sections of which each is a rest in a stated pose, or a stated turn."""

    cuts: Cuts
    sections: Dict[str, Pose | Turn]


ExternalReference = Measured | StatedTurns | Rests


def read_reference(section: StrictTable, *, wide: bool = False) -> ExternalReference:
    """Return the reference of a mapping, by its kind: measured columns, stated turns, or rests.

    In ``wide`` files (not text) one name may stand for several columns. RecordingError, with file, line and what to
    write, if it is invalid.
    """
    kind = section.string("kind", one_of=("attitude", "rate", "angle", "turns", "rest", "gravity"))
    reference: ExternalReference
    if kind == "attitude":
        reference = _attitude(section)
    elif kind == "rate":
        reference = Measured(kind, _rates(section, wide))
    elif kind == "angle":
        reference = _angle(section)
    elif kind == "turns":
        reference = _turns(section)
    else:
        reference = _rests(section, by_gravity=kind == "gravity")
    if wide and not isinstance(reference, Measured) and reference.cuts.column:
        raise section.fail("section_column", "is for text files: write section_list, or start_s and end_s in sections")
    section.done()
    return reference


def _attitude(section: StrictTable) -> Measured:
    """Return the columns of an attitude: a quaternion reordered to w x y z, or a matrix by rows, from body to
    reference.

    If the section's sign says that it turns the other way, it is inverted.
    """
    stated = section.stated(KEYS["attitude"])
    names = section.strings("columns")
    if not stated["order"]:
        order = np.arange(9) if stated["sign"] > 0 else np.arange(9).reshape(3, 3).T.ravel()
        return Measured("attitude", Columns(names=names, width=9, axes=np.eye(9)[:, order]))
    turned = np.eye(4)[:, stated["order"]] * [1.0, *[stated["sign"]] * 3]
    return Measured("attitude", Columns(names=names, width=4, axes=turned))


def turn_about(axis: str, angle_deg: float) -> Turn:
    """Return the turn about +-x, y or z; ValueError for another axis. An empty axis is right for a rest only."""
    if not axis.strip().lstrip("+-") and angle_deg == 0:
        return Turn((0.0, 0.0, 0.0), 0.0)
    x, y, z = signed_axis(axis)
    return Turn((abs(x), abs(y), abs(z)), (x + y + z) * math.radians(angle_deg))


def _rates(section: StrictTable, wide: bool) -> Columns:
    """Return the columns of a rate: three, or one with its axis; the section's error otherwise.

    In ``wide`` files one name without an axis may stand for three columns.
    """
    columns = stated_columns(section, "rate")
    if not section.has("axis"):
        if len(columns.names) == 1 and not wide:
            raise section.fail("columns", 'is one column: add axis = "z", the body axis of this rate')
        return columns
    if len(columns.names) != 1:
        raise section.fail("axis", "is for one column: leave it out with the three columns x, y, z")
    return replace(columns, width=1, axes=np.array([_unit(section, "axis")]))


def _unit(section: StrictTable, key: str) -> Vector:
    """Return the direction in body axes under ``key`` as a unit vector; the section's error if it is missing or
    zero.
    """
    v = np.array(section.take(key, None, direction))
    length = float(np.linalg.norm(v))
    if not length > 0:
        raise section.fail(key, "is not a direction. Write x, y or z with a sign, or three numbers")
    x, y, z = (v / length).tolist()
    return x, y, z


def _angle(section: StrictTable) -> Measured:
    column = stated_columns(section, "angle", "column")
    if len(column.names) != 1:
        raise section.fail("column", "must be one column")
    axis = np.array(section.take("axis", None, lambda value: signed_axis(str(typed(value, (str,), "a text")))))
    column = replace(column, axes=axis.sum().reshape(1, 1))
    return Measured("angle", column, "xyz"[int(np.argmax(np.abs(axis)))], section.flag("earth_rate", False))


def _turns(section: StrictTable) -> StatedTurns:
    """Return the stated turns, in the first form that the section has.

    The forms are ``sections``, a table of turns by name of section; ``file_name``, a regular expression for the names
    of files; ``angle_deg``, a single turn. Raise the section's error if there is none of them, or one is invalid.
    """
    stated = StatedTurns(**section.stated(KEYS["turns"]))
    if section.has("sections"):
        cuts, tables = read_sections(section)
        return replace(stated, cuts=cuts, sections={name: table.whole(read_turn) for name, table in tables.items()})
    if section.has("file_name"):
        return replace(stated, pattern=section.take("file_name", None, _pattern))
    if not section.has("angle_deg"):
        raise section.fail("angle_deg", "is missing: give it, or file_name (a regular expression), or sections")
    return replace(stated, turn=read_turn(section))


def read_turn(section: StrictTable) -> Turn:
    """Return the turn that a section states; its error for an invalid axis."""
    angle_deg, axis = section.number("angle_deg"), section.string("axis", "")
    try:
        return turn_about(axis, angle_deg)
    except ValueError as error:
        raise section.fail("axis", str(error)) from None


def _pattern(value: object) -> re.Pattern[str]:
    """Return a compiled regular expression with the groups axis and angle_deg; ValueError otherwise."""
    try:
        pattern = re.compile(typed(value, (str,), "a text"))
    except re.error as error:
        raise ValueError(f"is not a regular expression: {error}") from None
    if not {"axis", "angle_deg"} <= set(pattern.groupindex):
        raise ValueError("needs the groups (?P<axis>...) and (?P<angle_deg>...)")
    return pattern


def _rests(section: StrictTable, *, by_gravity: bool) -> Rests:
    """Return the stated rests; the section's error for keys that exclude each other.

    ``by_gravity``: an accelerometer measures the direction up in them. Rests are those of sections, else found in the
    data, or everywhere if that is stated; a pose may be stated for single files.
    """
    gravity = None
    if by_gravity:
        from_rests = section.string("accelerometer", "from rests", one_of=("from rests", "stated")) == "from rests"
        gravity = Gravity(from_rests, math.radians(section.number("sd_deg", 0.0 if from_rests else 0.1, least=0.0)))
    stated = section.stated(KEYS["rest"]) | {"gravity": gravity}
    if section.has("sections"):
        for key in ("where", "up", "north"):
            if section.has(key):
                raise section.fail(key, "cannot be combined with sections, which state the rests, each with its own up")
        stated["cuts"], tables = read_sections(section)
        stated["sections"] = {name: table.whole(read_pose) for name, table in tables.items()}
    else:
        stated["everywhere"] = section.string("where", "found", one_of=("found", "everywhere")) == "everywhere"
    listed = section.table("files", optional=True)
    files = {name: listed.table(name).whole(read_pose) for name in listed.remaining()}
    return Rests(pose=read_pose(section), files=files, **stated)


def read_pose(section: StrictTable) -> Pose:
    """Return the pose that a section states; its error for north without up, or not perpendicular to it."""
    found = {key: _unit(section, key) for key in ("up", "north") if section.has(key)}
    if "north" in found and "up" not in found:
        raise section.fail("north", "is stated without up: add up, the body axis that points up")
    if "north" in found and abs(float(np.dot(found["up"], found["north"]))) > 0.1:
        raise section.fail("north", "is not perpendicular to up; north is horizontal")
    return Pose(found.get("up"), found.get("north"))


def read_sections(section: StrictTable) -> tuple[Cuts, dict[str, StrictTable]]:
    """Return how files are cut into sections, and by name the table of each section without its limits.

    The section's error without sections, or unless there is exactly one of a section list, a column of labels, and
    limits. Limits are start and end in s: if any section has one, all must have both, the end after the start.
    """
    table = section.table("sections")
    tables = {name: table.table(name) for name in table.remaining()}
    if not tables:
        raise section.fail("sections", "is empty: name a section and its motion")
    list_name, column = (
        section.string(key) if section.has(key) else None for key in ("section_list", "section_column")
    )
    timed = [name for name, own in tables.items() if own.has("start_s") or own.has("end_s")]
    if (list_name is not None) + (column is not None) + bool(timed) != 1:
        raise section.fail("sections", sentence("importing.one_of_sections"))
    limits = {}
    for name, own in tables.items() if timed else ():
        start, end = own.number("start_s", least=0.0), own.number("end_s", positive=True)
        if end <= start:
            raise own.fail("end_s", f"{end:g} is not after start_s {start:g}")
        limits[name] = (start, end)
    return Cuts(list_name, column, limits), tables
