"""Rests of a body, stated or found from quiet samples, its rate there, and notes on them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.errors import RecordingError
from estimator.geometry.kinematics import EARTH_RATE_RPS, Site
from estimator.importing.log import Log
from estimator.importing.mapping.mapping import Mapping
from estimator.importing.mapping.reference import Pose, Rests
from estimator.importing.spans import Refused, of_sections
from estimator.packaged import sentence
from estimator.types import Floats, least_steps, runs_of

_WINDOW_S = 0.25
_FEWEST_ROWS = 10  # a window of fewer gives no scatter
_QUIET_TENTH = 0.05  # of the windows, the share that is taken to be at rest for certain
_SLOW = 0.2  # of the quiet windows, those of the slowest output, which distinguish the bias from a steady turn
_LOUD = 4.0  # scatter of a window, in that of the quiet ones, beyond which it is motion
_TILT_RAD = float(np.radians(1.0))  # by which specific force may move within a rest
_UP_WITHIN = float(np.cos(np.radians(30.0)))  # of a stated pose
_GRAVITY_MPS2 = 9.81
_GRAVITY_OFF = 0.2
_LEVEL = 0.05  # part of a sense axis that is horizontal and so feels the unknown part of Earth rate


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class Rest:
    """Gyro rows ``first`` to before ``stop`` of one file, at rest; ``up`` and ``north`` in body axes where known.

    It lasts from ``start_s`` to ``end_s`` of the file.
    """

    first: int
    stop: int
    start_s: float
    end_s: float
    up: Floats | None
    north: Floats | None


@dataclass(frozen=True, slots=True, eq=False)
class _Samples:
    """Samples at instants (n,): rates (n, m) and, with an accelerometer, specific force (n, 3)."""

    t_s: Floats
    rate: Floats
    accel: Floats | None


def rests_of(
    mapping: Mapping, stated: Rests, log: Log, kept_rows: NDArray[np.intp], rate: Floats, accel: Floats | None
) -> tuple[list[Rest], list[Refused], list[str]]:
    """Return the rests of a file, refused sections, and notes.

    They are those of sections, the whole file, or quiet stretches, as stated. ``kept_rows`` (rows,) are the numbers of
    the kept rows of the gyro's ``rate`` and the accelerometer's ``accel`` (rows, m). Notes say how long it rests, which
    labels count as motion, and what is odd about poses or gravity. RecordingError if there is no rest, or up is
    measured elsewhere than stated; sections are refused for that instead, even if no rest is left. RecordingError, too,
    if a named section is missing or begins after the file, or the direction up is needed and not known.
    """
    name, t_s = log.path.name, log.time.t_s[kept_rows]
    samples, refused, notes = _Samples(t_s, rate, accel), list[Refused](), list[str]()
    if stated.sections:

        def rest_of(section: str, first: int, stop: int) -> Rest:
            a, b = np.searchsorted(kept_rows, [first, stop]).tolist()
            return _stated_rest(samples, a, b, stated.sections[section], stated)

        rests, refused = of_sections(mapping.name, stated, log, rest_of)
        others = set(log.table.labels[stated.cuts.column]) - {"", *stated.sections} if stated.cuts.column else ()
        notes += [f"rows labelled {', '.join(sorted(others))} count as motion"] if others else []
    else:
        pose = stated.files.get(name, stated.pose)
        whole = stated.everywhere
        rests = (
            [_stated_rest(samples, 0, len(rate), pose, stated)] if whole else _quiet_stretches(samples, pose, stated)
        )
        if pose.up is not None and accel is None and len(rests) > 1:
            notes.append(sentence("importing.several_poses", rests=len(rests)))
    if stated.earth_rate and any(rest.up is None for rest in rests):
        raise RecordingError(f'{name}: the direction up is not stated: add "{name}" to [reference.files]')
    if rests:
        total, count = sum(r.end_s - r.start_s for r in rests), f"{len(rests)} rest{'s' if len(rests) > 1 else ''}"
        notes.append(f"at rest for {total:.6g} of {t_s[-1] - t_s[0]:.6g} s ({count})")
        if accel is not None:
            notes += _gravity_notes(accel[np.isfinite(rest_rates(rests, len(rate), None)[:, 0])])
    return rests, refused, notes


def rest_rates(rests: Sequence[Rest], rows: int, site: Site | None) -> Floats:
    """Return the body rate (rows, 3) of a file in rad/s: NaN in motion, Earth rate at rest.

    Only the component along a known direction is included: the vertical one if ``up`` of the rest is known, the
    horizontal one if ``north`` is known as well. The rate at rest is zero if neither is known or there is no site.
    """
    known = np.full((rows, 3), np.nan)
    for rest in rests:
        rate = np.zeros(3)
        if site is not None and rest.up is not None:
            rate = EARTH_RATE_RPS * np.sin(site.latitude_rad) * rest.up
            if rest.north is not None:
                rate = rate + EARTH_RATE_RPS * np.cos(site.latitude_rad) * rest.north
        known[rest.first : rest.stop] = rate
    return known


def earth_note(mapping: Mapping, rests: Sequence[Rest]) -> list[str]:
    """Return a single note on the part of Earth rate that is unknown at these rests: of gyros that are not upright.

    The list is empty if it is small, or no rest has an up without a north. The mapping must have a site.
    """
    assert mapping.site is not None
    p = mapping.gyro.array.p
    ups = [rest.up for rest in rests if rest.north is None and rest.up is not None]
    level = max((float(np.linalg.norm(p - np.outer(p @ up, up), axis=1).max()) for up in ups), default=0.0)
    if level < _LEVEL:
        return []
    size = np.degrees(EARTH_RATE_RPS * np.cos(mapping.site.latitude_rad)) * 3600 * level
    return [sentence("importing.level_earth_rate", size_dph=size)]


def rest_text(rest: Rest, file_s: float) -> str:
    """Return the limits of a rest of a file that begins at ``file_s``, and the direction up where it is known."""
    up = "" if rest.up is None else f", up {rest.up[0]:.4f} {rest.up[1]:.4f} {rest.up[2]:.4f}"
    return f"{rest.start_s + file_s:.3f} to {rest.end_s + file_s:.3f} s{up}"


def _stated_rest(samples: _Samples, first: int, stop: int, pose: Pose, stated: Rests) -> Rest:
    """Return the rest of the rows from ``first`` to before ``stop``, with its ``pose``.

    RecordingError if they are fewer than two, turn on average, or move in between by more than the limit of ``stated``,
    or if up is measured elsewhere than stated in ``pose``.
    """
    t_s, part = samples.t_s, samples.rate[first:stop]
    if len(part) < 2:
        raise RecordingError(f"it has {len(part)} usable rows, too few for a rest")
    limit = stated.limit_rps
    mean = np.nanmean(part, axis=0)
    worst = float(np.abs(mean).max())
    if worst > limit:
        raise RecordingError(
            sentence("importing.turns_at_rest", rate_dps=np.degrees(worst), limit_dps=np.degrees(limit))
        )
    rows = _window_rows(t_s)
    windows = _windows(part, rows)
    loud = np.abs(windows.mean(axis=1) - np.median(windows.mean(axis=1), axis=0)).max(axis=1) > limit
    if loud.any():
        at = int(np.argmax(loud)) * rows
        raise RecordingError(sentence("importing.moves_at_rest", at_s=t_s[first + at]))
    return _rest_with_directions(samples, first, stop, pose)


def _quiet_stretches(samples: _Samples, pose: Pose, stated: Rests) -> list[Rest]:
    """Return the quiet stretches of samples that are long enough, in order of time.

    Rests have the scatter of the quietest windows, and nearly their mean, as a steady turn is equally quiet. An
    accelerometer must be quiet as well, and keep its direction. A window at each end is left out, as a motion may begin
    in it. RecordingError if there is none, too few rows to tell, or up is measured elsewhere than stated in ``pose``.
    """
    t_s, rate, accel = samples.t_s, samples.rate, samples.accel
    rows = _window_rows(t_s)
    if len(rate) < 2 * rows:
        raise RecordingError(f"it has {len(rate)} usable rows, too few to find where it rests")
    channels = rate if accel is None else np.hstack([rate, accel])
    windows = _windows(channels, rows)
    scatter, mean = windows.std(axis=1, ddof=1), windows.mean(axis=1)
    least = _quiet_scatter(scatter, channels)
    quiet = (scatter <= _LOUD * least).all(axis=1)
    gyros = mean[:, : rate.shape[1]]
    if quiet.any():
        size = np.abs(gyros).max(axis=1)
        slow = quiet & (size <= np.quantile(size[quiet], _SLOW))
        quiet &= (np.abs(gyros - np.median(gyros[slow], axis=0)) <= stated.limit_rps).all(axis=1)
    tilt = max(_TILT_RAD, 6 * float(least[rate.shape[1] :].max(initial=0.0)) / np.sqrt(rows) / _GRAVITY_MPS2)
    rests = []
    for start, stop in runs_of(quiet):
        a, b = start + (start > 0), stop - (stop < len(quiet))  # its ends may hold the beginning of a motion
        for c, d in _level_parts(mean[:, rate.shape[1] :], a, b, tilt) if accel is not None else [(a, b)]:
            first, last = c * rows, len(rate) if d == len(quiet) else d * rows
            if last > first and t_s[last - 1] - t_s[first] >= stated.least_s:
                rests.append(_rest_with_directions(samples, first, last, pose))
    if not rests:
        raise RecordingError(sentence("importing.no_rest", least_s=stated.least_s))
    return rests


def _gravity_notes(accel: Floats) -> list[str]:
    """Return a sentence if the specific force (rows, 3) at rest is not 1 g; else an empty list."""
    length = float(np.nanmedian(np.linalg.norm(accel, axis=1)))
    if abs(length / _GRAVITY_MPS2 - 1) <= _GRAVITY_OFF:
        return []
    return [sentence("importing.gravity_off", length_mps2=length)]


def _rest_with_directions(samples: _Samples, first: int, stop: int, pose: Pose) -> Rest:
    """Return the rest of the rows from ``first`` to before ``stop`` with its directions.

    Up is as stated in ``pose``, else as measured, else None; north is stated or None, made perpendicular to up.
    RecordingError if up as stated and measured are more than 30 deg apart.
    """
    up = None if pose.up is None else np.array(pose.up)
    north, found = None, None
    if pose.north is not None:
        level = np.array(pose.north) - (np.array(pose.north) @ up) * up
        north = level / np.linalg.norm(level)
    if samples.accel is not None:
        force = np.nanmean(samples.accel[first:stop], axis=0)
        length = float(np.linalg.norm(force))
        found = force / length if np.isfinite(length) and length > 0 else None
    if up is not None and found is not None and float(up @ found) < _UP_WITHIN:
        raise RecordingError(sentence("importing.up_elsewhere", stated=_rounded(up), found=_rounded(found)))
    start_s, end_s = float(samples.t_s[first]), float(samples.t_s[stop - 1])
    return Rest(first=first, stop=stop, start_s=start_s, end_s=end_s, up=found if up is None else up, north=north)


def _window_rows(t_s: Floats) -> int:
    period_s = float(np.median(np.diff(t_s[:100000]))) if len(t_s) > 1 else 1.0
    return max(round(_WINDOW_S / period_s), _FEWEST_ROWS)


def _windows(values: Floats, rows: int) -> Floats:
    """Return values (n, m) as windows (n // rows, rows, m); one window if there are fewer rows."""
    rows = min(rows, len(values))
    count = len(values) // rows
    return values[: count * rows].reshape(count, rows, -1)


def _quiet_scatter(scatter: Floats, channels: Floats) -> Floats:
    """Return the scatter (m,) of each channel at rest, not below that of rounding."""
    steps = least_steps(np.abs(np.diff(channels, axis=0)))
    moving = [column[column > 0] for column in scatter.T]
    quiet = np.array([np.quantile(own, _QUIET_TENTH) if len(own) else 0.0 for own in moving])
    return np.asarray(np.maximum(quiet, np.where(np.isfinite(steps), steps / 3, 0.0)))


def _level_parts(mean: Floats, first: int, stop: int, tilt_rad: float) -> list[tuple[int, int]]:
    """Return the parts (first, stop) of a quiet run of windows over which specific force keeps its direction.

    ``mean`` (windows, 3) is that of each window; a change by more than ``tilt_rad`` begins a new part, but not at the
    last window.
    """
    parts, start = [], first
    for at in range(first + 1, stop):
        here, there = mean[start : at : max((at - start) // 8, 1)].mean(axis=0), mean[at]
        apart = np.linalg.norm(np.cross(here, there)) / max(float(np.linalg.norm(here) * np.linalg.norm(there)), 1e-9)
        if apart > np.sin(tilt_rad) and at + 1 < stop:
            parts.append((start, at))
            start = at
    parts.append((start, stop))
    return parts


def _rounded(direction: Floats) -> str:
    return "[" + ", ".join(f"{v:.2f}" for v in direction) + "]"
