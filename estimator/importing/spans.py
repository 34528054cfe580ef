"""Files and sections of them of which something is stated; a stated turn is checked before it counts."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from estimator.errors import MISSHAPEN, RecordingError
from estimator.importing.expressions import SEARCH_LIMIT_S, groups_of
from estimator.importing.log import Log
from estimator.importing.mapping.mapping import Mapping, beside
from estimator.importing.mapping.reference import KnownSections, Rests, StatedTurns, Turn, turn_about
from estimator.importing.table import Table
from estimator.packaged import sentence
from estimator.types import Floats
from estimator.untrusted import read_json, read_text

T = TypeVar("T")

_EDGE_ROWS = 3  # least number of samples that show rest at an end
_WRONG_BY = 0.5  # a gyro whose output turns by this share more or less than stated: wrong axis, unit or angle
_SENSED = 0.5  # share of an axis that the gyros must span to determine its turn


@dataclass(frozen=True, slots=True)
class Refused:
    """A file, or a section of one, that was left out, and why."""

    name: str
    reason: str

    def __str__(self) -> str:
        return f"{self.name}: {self.reason}"


@dataclass(frozen=True, slots=True, eq=False)
class Span:
    """One turn with its beginning and end, in seconds from the first sample of its file."""

    start_s: float
    end_s: float
    turn_rad: Floats
    sd_rad: float


def turn_spans(mapping: Mapping, stated: StatedTurns, log: Log, rate: Floats) -> tuple[list[Span], list[Refused]]:
    """Return the turns of a file with gyro outputs ``rate`` (rows, m), and its refused sections.

    Without sections the file is a single turn; RecordingError if that is invalid, or as ``of_sections``.
    """
    t_s, rows = log.time.t_s, rate[log.time.rows]
    if not stated.sections:
        return [_span(mapping, stated, t_s, rows, _turn_of_file(mapping, stated, log.path))], []
    return of_sections(
        mapping.name, stated, log, lambda name, a, b: _span(mapping, stated, t_s[a:b], rows[a:b], stated.sections[name])
    )


def _turn_of_file(mapping: Mapping, reference: StatedTurns, path: Path) -> Turn:
    """Return the turn stated for all files, or in the file's name.

    RecordingError if the name does not match, states no turn, or matching takes too long.
    """
    if reference.turn is not None:
        return reference.turn
    assert reference.pattern is not None
    try:
        found = groups_of(reference.pattern, path.name)
    except TimeoutError:
        raise RecordingError(
            f"{path.name}: file_name in [reference] of {mapping.name} takes more than {SEARCH_LIMIT_S:g} s "
            "on this name. Avoid nested repetitions such as (a+)+"
        ) from None
    if found is None:
        raise RecordingError(f"{path.name}: its name does not match file_name in [reference] of {mapping.name}")
    try:
        return turn_about(found["axis"] or "", float(found["angle_deg"] or ""))
    except (ValueError, TypeError) as error:
        raise RecordingError(f"{path.name}: its name states no turn: {error}") from None


def of_sections(
    mapping: str, stated: StatedTurns | Rests | KnownSections, log: Log, read: Callable[[str, int, int], T]
) -> tuple[list[T], list[Refused]]:
    """Return ``read(name, first, stop)`` for each section (numbers of kept rows), and the sections that it refuses.

    Refused are those for which it raises RecordingError. Both are in the order of ``_section_rows``, whose
    RecordingError passes.
    """
    found: list[T] = []
    refused: list[Refused] = []
    for name, first, stop in _section_rows(mapping, stated, log):
        try:
            found.append(read(name, first, stop))
        except RecordingError as reason:
            refused.append(Refused(f"{log.path.name}, section {name}", str(reason)))
    return found, refused


def _section_rows(mapping: str, stated: StatedTurns | Rests | KnownSections, log: Log) -> list[tuple[str, int, int]]:
    """Return (name, first, stop) of each named section in kept rows, by labels, a list, or limits in seconds.

    They are in the order of labels, list or limits; a label that comes again gives another section of the name.
    ``mapping`` is the name of the mapping. RecordingError if a named section is missing or begins after the file, or
    the list is invalid; for turns also if the file has one that is not named, while else such sections are skipped.
    """
    cuts, names, path, all_named = stated.cuts, stated.sections, log.path, isinstance(stated, StatedTurns)
    edges, last_s = log.time.rows if not cuts.limits_s else log.time.t_s, float(log.time.t_s[-1])
    limits: Sequence[tuple[str, float, float]] = [(name, *limits_s) for name, limits_s in cuts.limits_s.items()]
    for name, start_s, _ in limits:
        if start_s > last_s:
            raise RecordingError(
                f"{path.name}: section {name} begins at {start_s:g} s, but the file lasts {last_s:.6g} s"
            )
    if cuts.column is not None:
        limits = _labelled(log.table.labels[cuts.column])
    elif cuts.list_name is not None:
        limits = _listed(beside(path, cuts.list_name), log.table)
    present = dict.fromkeys(name for name, _, _ in limits)
    unknown = [name for name in present if name not in names]
    if unknown and all_named:
        raise RecordingError(
            sentence("importing.section_unknown", file=path.name, sections=", ".join(unknown), mapping=mapping)
        )
    missing = [name for name in names if name not in present]
    if missing:
        has = f"; it has {', '.join(unknown)}" if unknown else ""
        raise RecordingError(f"{path.name} has no section {', '.join(missing)}, which {mapping} names{has}")
    return [(name, *np.searchsorted(edges, [start, end]).tolist()) for name, start, end in limits if name in names]


def _labelled(labels: tuple[str, ...]) -> list[tuple[str, int, int]]:
    """Return (label, first, stop) of each run of equal labels, without those of empty labels; a label may occur
    again.
    """
    limits: list[tuple[str, int, int]] = []
    at = 0
    for label, group in groupby(labels):
        stop = at + len(list(group))
        if label:
            limits.append((label, at, stop))
        at = stop
    return limits


def _listed(path: Path, table: Table) -> list[tuple[str, int, int]]:
    """Return (name, first, stop) from the section list at ``path``, which stands beside the file of ``table``.

    They are rows of the file, counted from 0; the row ``stop`` is the first after the section. RecordingError if it is
    missing or invalid, or if the file has broken lines, by which rows would be off.
    """
    if table.skipped_lines:
        raise RecordingError(sentence("importing.broken_and_listed", file=table.name, lines=table.skipped_lines))
    if not path.is_file():
        raise RecordingError(f"{table.name}: its section list {path.name} is not in the same folder")
    try:
        values: Any = read_json(read_text(path, RecordingError))
        limits = {str(name): (int(value["start"]), int(value["end"])) for name, value in values.items()}
    except MISSHAPEN:
        raise RecordingError(
            f'{path.name} is not a section list. Write {{"name": {{"start": 0, "end": 100}}}}'
        ) from None
    rows = len(next(iter(table.columns.values())))
    for name, (start, end) in limits.items():
        if not 0 <= start < end <= rows:
            raise RecordingError(f"{path.name}: section {name} is {start} to {end}, the file has rows 0 to {rows}")
    return [(name, start, end) for name, (start, end) in limits.items()]


def _span(mapping: Mapping, stated: StatedTurns, t_s: Floats, rate: Floats, turn: Turn) -> Span:
    """Return the turn of these samples, with its uncertainty, after checking it; incomplete rows are left out.

    A turn by 0 is a rest: its mean rate is checked, and its uncertainty is that of a rest. RecordingError if there are
    too few rows, they do not begin and end at rest, or turn otherwise than stated in ``turn``.
    """
    whole = np.isfinite(rate).all(axis=1)
    t_s, rate = t_s[whole], rate[whole]
    if len(t_s) < 2 * _EDGE_ROWS:
        raise RecordingError(f"it has {len(t_s)} usable rows, too few for a turn")
    period_s = float(np.median(np.diff(t_s)))
    edge = min(max(round(stated.rest_s / period_s), _EDGE_ROWS), len(t_s) // 2)
    limit = stated.rest_limit_rps
    for end, rows in (("start", rate[:edge]), ("end", rate[-edge:])):
        worst = float(np.abs(rows.mean(axis=0)).max())
        if worst > limit:
            raise RecordingError(
                f"it is not at rest at the {end} ({np.degrees(worst):.1f} deg/s over {edge * period_s:.2g} s, "
                f"{np.degrees(limit):.3g} allowed), so its turned angle is not known"
            )
    length_s = float(t_s[-1] - t_s[0])
    turned = np.asarray(np.trapezoid(rate, t_s, axis=0))
    if not turn.angle_rad:
        worst = float(np.abs(turned).max()) / length_s
        if worst > limit:
            raise RecordingError(f"it should be at rest but turns at {np.degrees(worst):.1f} deg/s on average")
        return Span(float(t_s[0]), float(t_s[-1]), np.zeros(3), stated.rest_sd_rad)
    angle = _checked_angle(mapping, stated, turned, turn)
    sd = float(np.hypot(stated.sd_rad, stated.sd_share * angle))
    return Span(float(t_s[0]), float(t_s[-1]), angle * np.array(turn.axis), sd)


def _checked_angle(mapping: Mapping, stated: StatedTurns, turned_rad: Floats, turn: Turn) -> float:
    """Return the stated angle of a turn in rad, with the sign of the data if asked for.

    It is checked against the angles ``turned_rad`` (m,) by which the gyros turned: RecordingError if they differ by
    half of it or more. No check if no gyro senses the axis; then RecordingError if the sign is wanted from the data.
    """
    p, axis, angle = mapping.gyro.array.p, np.array(turn.axis), turn.angle_rad
    if np.linalg.lstsq(p, p @ axis, rcond=None)[0] @ axis < _SENSED:
        if stated.sign_from_data:
            raise RecordingError(
                "no gyro senses the axis of its turn, so its sign cannot be found from the data. State it"
            )
        return angle
    # The turn of the body, as far as the gyros determine it: least squares over their nominal axes.
    measured = float(np.linalg.lstsq(p, turned_rad, rcond=None)[0] @ axis)
    if stated.sign_from_data and measured * angle < 0:
        angle = -angle
    if not abs(measured / angle - 1) < _WRONG_BY:
        raise RecordingError(sentence("importing.turn_unlike", turned=np.degrees(measured), stated=np.degrees(angle)))
    return angle
