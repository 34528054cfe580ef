"""Where a body is at rest, stated or found from quiet samples, and the Earth rate that it has there."""

from dataclasses import dataclass

import numpy as np

from estimator.geometry.kinematics import EARTH_RATE_RPS, Site
from estimator.importing.mapping.reference import Pose, Rests
from estimator.types import Floats, runs_of

_WINDOW_S = 0.25
_FEWEST_ROWS = 10  # a window of fewer does not tell its scatter
_QUIET_TENTH = 0.05  # of the windows, the share that is taken to be at rest for certain
_SLOW = 0.2  # of the quiet windows, those of the slowest output, which tell the bias from a steady turn
_LOUD = 4.0  # scatter of a window, in that of the quiet ones, beyond which it is motion
_TILT_RAD = float(np.radians(1.0))  # by which specific force may move within a rest
_UP_WITHIN = float(np.cos(np.radians(30.0)))  # of a stated pose
_GRAVITY_MPS2 = 9.81
_GRAVITY_OFF = 0.2


@dataclass(frozen=True, slots=True, eq=False)
class Rest:
    """Rows ``first`` to before ``stop`` of one file, at rest; ``up`` and ``north`` in body axes where known."""

    first: int
    stop: int
    up: Floats | None
    north: Floats | None

    def rate_rps(self, site: Site | None) -> Floats:
        """Return the body rate (3,): that of the Earth, as far as the pose is known; zero without a site."""
        if site is None or self.up is None:
            return np.zeros(3)
        rate = EARTH_RATE_RPS * np.sin(site.latitude_rad) * self.up
        if self.north is not None:
            rate = rate + EARTH_RATE_RPS * np.cos(site.latitude_rad) * self.north
        return np.asarray(rate)


def stated_rest(
    t_s: Floats, rate: Floats, accel: Floats | None, first: int, stop: int, pose: Pose, stated: Rests
) -> Rest:
    """Return the rest of these rows as stated; ValueError with the reason if the samples say otherwise."""
    part = rate[first:stop]
    if len(part) < 2:
        raise ValueError(f"it has {len(part)} usable rows, too few for a rest")
    limit = stated.limit_rps
    mean = np.nanmean(part, axis=0)
    worst = float(np.abs(mean).max())
    if worst > limit:
        raise ValueError(
            f"it is said to be at rest but turns at {np.degrees(worst):.1f} deg/s on average, {np.degrees(limit):.3g} "
            'allowed: check its limits (without sections write where = "found"), or raise rest_limit_dps if that is '
            "the gyro's bias"
        )
    rows = _window_rows(t_s)
    windows = _windows(part, rows)
    loud = np.abs(windows.mean(axis=1) - np.median(windows.mean(axis=1), axis=0)).max(axis=1) > limit
    if loud.any():
        at = int(np.argmax(loud)) * rows
        raise ValueError(
            f"it is said to be at rest but moves at {t_s[first + at]:.6g} s of the file: make it shorter, or leave "
            'sections away and write where = "found"'
        )
    return _posed(accel, first, stop, pose)


def found_rests(t_s: Floats, rate: Floats, accel: Floats | None, pose: Pose, stated: Rests) -> list[Rest]:
    """Return where the samples are as quiet as they get, for long enough, in order of time.

    Rests have the scatter of the quietest windows, and nearly their mean: a steady turn is as quiet as a rest. The
    accelerometer, if there is one, must be quiet too and not tilt. Raises ValueError if there is none.
    """
    rows = _window_rows(t_s)
    if len(rate) < 2 * rows:
        raise ValueError(f"it has {len(rate)} usable rows, too few to find where it rests")
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
        for c, d in _level(mean[:, rate.shape[1] :], a, b, tilt) if accel is not None else [(a, b)]:
            first, last = c * rows, len(rate) if d == len(quiet) else d * rows
            if last > first and t_s[last - 1] - t_s[first] >= stated.least_s:
                rests.append(_posed(accel, first, last, pose))
    if not rests:
        raise ValueError(
            f"no rest of {stated.least_s:g} s is found in it: state where it rests by [reference.sections] with "
            'start_s and end_s, or write where = "everywhere", or a shorter rest_s'
        )
    return rests


def gravity_note(accel: Floats) -> str:
    """Return what is wrong with the specific force (rows, 3) of a body at rest, in words; empty if nothing is."""
    length = float(np.nanmedian(np.linalg.norm(accel, axis=1)))
    if abs(length / _GRAVITY_MPS2 - 1) <= _GRAVITY_OFF:
        return ""
    return f"at rest the accelerometer shows {length:.3g} m/s2 where 9.81 are due: check [accelerometer] unit and count"


def _posed(accel: Floats | None, first: int, stop: int, pose: Pose) -> Rest:
    up = None if pose.up is None else np.array(pose.up)
    north = None if pose.north is None else _level_north(np.array(pose.north), np.array(pose.up))
    found = None
    if accel is not None:
        force = np.nanmean(accel[first:stop], axis=0)
        length = float(np.linalg.norm(force))
        found = force / length if np.isfinite(length) and length > 0 else None
    if up is not None and found is not None and float(up @ found) < _UP_WITHIN:
        raise ValueError(
            f"it is said to have {_rounded(up)} up, but its accelerometer shows up along {_rounded(found)} (body "
            "axes): check up, and axes in [accelerometer] (at rest the specific force points up)"
        )
    return Rest(first, stop, found if up is None else up, north)


def _level_north(north: Floats, up: Floats) -> Floats:
    level = north - (north @ up) * up
    return np.asarray(level / np.linalg.norm(level))


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
    out = np.empty(scatter.shape[1])
    for i, column in enumerate(scatter.T):
        moving = column[column > 0]
        steps = np.abs(np.diff(channels[:, i]))
        step = float(steps[steps > 1e-9].min(initial=np.inf))
        quiet = float(np.quantile(moving, _QUIET_TENTH)) if len(moving) else 0.0
        out[i] = max(quiet, step / 3 if np.isfinite(step) else 0.0)
    return out


def _level(mean: Floats, first: int, stop: int, tilt_rad: float) -> list[tuple[int, int]]:
    """Return the parts of a quiet run of windows over which specific force (windows, 3) keeps its direction."""
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
