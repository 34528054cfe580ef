"""Rests of foreign files: where they are, what is known of the body rate there, and what is to be told."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from estimator.errors import RecordingError
from estimator.geometry.kinematics import EARTH_RATE_RPS
from estimator.importing.clocks.spans import Refused, section_rows
from estimator.importing.clocks.timefit import TimeFit
from estimator.importing.columns import Table
from estimator.importing.mapping.mapping import Mapping
from estimator.importing.mapping.reference import Rests
from estimator.importing.resting import Rest, found_rests, gravity_note, stated_rest
from estimator.types import Floats

_LEVEL = 0.05  # part of a sense axis that is horizontal and so feels the unknown part of Earth rate


@dataclass(frozen=True, slots=True, eq=False)
class PartRests:
    """Rests of one file, with their limits in seconds, and the body rate (rows, 3) of its gyro rows, NaN in motion."""

    rests: tuple[Rest, ...]
    limits_s: tuple[tuple[float, float], ...]
    rate_rps: Floats
    notes: tuple[str, ...]


def part_rests(
    mapping: Mapping,
    stated: Rests,
    path: Path,
    table: Table,
    time: TimeFit,
    own: NDArray[np.intp],
    rate: Floats,
    accel: Floats | None,
) -> tuple[PartRests, list[Refused]]:
    """Return the rests of a file; ``own`` (rows,) are its kept rows that the gyro's ``rate`` (rows, m) is of.

    Raises RecordingError if it has none, or nothing says what points up where that is needed.
    """
    t_s = time.t_s[own]
    pose = stated.files.get(path.name, stated.pose)
    rests: list[Rest] = []
    refused: list[Refused] = []
    notes: list[str] = []
    if stated.sections:
        names = tuple(stated.sections)
        for name, first, stop in section_rows(mapping, stated.cuts, names, path, table, time, all_named=False):
            a, b = np.searchsorted(own, [first, stop])
            try:
                rests.append(stated_rest(t_s, rate, accel, int(a), int(b), stated.sections[name], stated))
            except ValueError as error:
                refused.append(Refused(f"{path.name}, section {name}", str(error)))
        notes += _unnamed(stated, table)
    else:
        try:
            if stated.everywhere:
                rests = [stated_rest(t_s, rate, accel, 0, len(rate), pose, stated)]
            else:
                rests = found_rests(t_s, rate, accel, pose, stated)
        except ValueError as error:
            raise RecordingError(f"{path.name}: {error}") from None
        if pose.up is not None and accel is None and len(rests) > 1:
            notes.append(
                f"{len(rests)} rests with motion between them count as the one pose that is stated: if the body was "
                "turned over, cut them into [reference.sections]"
            )
    if stated.earth_rate and any(rest.up is None for rest in rests):
        raise RecordingError(f'{path.name}: nothing says what points up: add "{path.name}" to [reference.files]')
    known = np.full((len(rate), 3), np.nan)
    for rest in rests:
        known[rest.first : rest.stop] = rest.rate_rps(mapping.site if stated.earth_rate else None)
    limits = [(float(t_s[rest.first]), float(t_s[rest.stop - 1])) for rest in rests]
    if rests:
        total, count = sum(b - a for a, b in limits), f"{len(rests)} rest{'s' if len(rests) > 1 else ''}"
        notes.append(f"at rest for {total:.6g} of {t_s[-1] - t_s[0]:.6g} s ({count})")
        if accel is not None:
            still = np.isfinite(known[:, 0])
            notes += [note for note in [gravity_note(accel[still])] if note]
    return PartRests(tuple(rests), tuple(limits), known, tuple(notes)), refused


def earth_note(mapping: Mapping, parts: list[PartRests]) -> list[str]:
    """Return what of Earth rate is not known at the rests of these files, in words."""
    assert mapping.site is not None
    p = mapping.gyro.array.p
    ups = [rest.up for part in parts for rest in part.rests if rest.north is None and rest.up is not None]
    level = [np.linalg.norm(p - np.outer(p @ up, up), axis=1).max() for up in ups]
    if not level or max(level) < _LEVEL:
        return []
    size = np.degrees(EARTH_RATE_RPS * np.cos(mapping.site.latitude_rad)) * 3600 * max(level)
    return [
        f"the horizontal part of Earth rate, up to {size:.2g} deg/h, stays in the biases: state for each pose the body "
        'axis that points north (north = "x")'
    ]


def rests_text(parts: list[tuple[PartRests, float]]) -> str:
    """Return a line for each rest: its limits in seconds of the recording, and the direction up where it is known."""
    lines = []
    for part, start in parts:
        for rest, (a, b) in zip(part.rests, part.limits_s, strict=True):
            up = "" if rest.up is None else f", up {rest.up[0]:.4f} {rest.up[1]:.4f} {rest.up[2]:.4f}"
            lines.append(f"{a + start:.3f} to {b + start:.3f} s{up}")
    return "\n".join(lines)


def _unnamed(stated: Rests, table: Table) -> list[str]:
    if stated.cuts.column is None:
        return []
    others = sorted({label for label in table.labels[stated.cuts.column] if label and label not in stated.sections})
    return [f"rows labelled {', '.join(others)} count as motion"] if others else []
