"""The motion that readings of a table tell by themselves, where they do not follow straight ramps of rate.

A drive that rounds the corners of its ramps, or lags behind them, is elsewhere than straight ramps say by what counts
of an encoder hardly show. For the rate of a body that is little, but its derivative is off by up to the acceleration.
"""

from collections.abc import Sequence

import numpy as np

from estimator.geometry.polyline import turned
from estimator.recordings.motion.ramps import Ramp, Readings
from estimator.types import Floats, Stamps

SURE_RPS = float(np.radians(0.02))
"""Accuracy of a rate within a ramp that its instant's uncertainty must leave."""
_FOLLOWED_RAD, _FOLLOWED_RPS = 4e-4, 1.2e-3  # four sigmas of a reading, before its scatter is known


def followed_by(ramp: Ramp, readings: Readings, first: int, last: int) -> bool:
    """Return whether readings between ``first`` and ``last``, and the next ones to these, are those of a ramp.

    ``readings`` are instants (n,) in s, angles, rates and half widths (n,), and the time that rates are means of. A
    reading may be off by what its instant is. False for a ramp whose corners are not known well enough, too.
    """
    near = slice(max(first - 1, 0), last + 2)
    t_s, angle_rad, rate_rps, half_width_s = (one[near] for one in readings[:4])
    p = np.concatenate([ramp.t_s, ramp.rate_rps / ramp.scale, [ramp.angle_rad[0], ramp.scale]])
    angle, rate = turned(p, t_s, readings[4])
    steepest = float(np.abs(np.diff(ramp.rate_rps) / np.diff(ramp.t_s)).max())
    near_angle = np.abs(angle_rad - angle) <= _FOLLOWED_RAD + 2 * np.abs(rate) * half_width_s
    near_rate = np.abs(rate_rps - ramp.scale * rate) <= _FOLLOWED_RPS + 2 * steepest * half_width_s
    return bool((near_angle & near_rate).all()) and steepest * ramp.fitted_s <= SURE_RPS


def bent(t_ns: Stamps, known_ns: Stamps, angle: Floats, rate: Floats) -> Floats:
    """Return angles (n, g) at ordered instants (n,), bent between known ones (k, g) as the known rates (k, g) say.

    On a ramp of 50 deg/s2 a straight line between readings 50 ms apart is wrong by up to 0.3 mrad, which is 3 mm/s2
    of gravity. Beyond the known instants (k,) the angles are those of the nearest.
    """
    before = np.clip(np.searchsorted(known_ns, t_ns, side="right") - 1, 0, max(len(known_ns) - 2, 0))
    if len(known_ns) < 2:
        return np.repeat(angle[:1], len(t_ns), axis=0)
    step_s = ((known_ns[before + 1] - known_ns[before]) * 1e-9)[:, None]
    since_s = np.clip((t_ns - known_ns[before])[:, None] * 1e-9, 0.0, step_s)
    straight = angle[before] + (angle[before + 1] - angle[before]) * (since_s / step_s)
    slope = (rate[before + 1] - rate[before]) / step_s
    return np.asarray(straight - 0.5 * slope * since_s * (step_s - since_s))


def as_read(
    t_ns: Stamps,
    angle: Floats,
    rate: Floats,
    known_ns: Stamps,
    readings: tuple[Floats, Floats],
    ramps: Sequence[tuple[int, Stamps, Ramp]],
) -> tuple[Floats, Floats, Floats]:
    """Return angles and rates (n, g) in which readings replace ramps that they do not follow, and doubts (n, g) in s.

    ``angle`` and ``rate`` (n, g) at instants (n,) are those by all ``ramps``, as of ``with_corners``; ``readings`` are
    angles and rates (k, g) at instants ``known_ns`` (k,). Doubts of corners are NaN without a ramp that is followed.
    """
    angle, rate, doubt_s = angle.copy(), rate.copy(), np.full(rate.shape, np.nan)
    for column, _, ramp in ramps:
        if ramp.followed:
            doubt_s[:, column] = ramp.fitted_s
            continue
        own = slice(column, column + 1)
        angle[:, own] = bent(t_ns, known_ns, readings[0][:, own], readings[1][:, own])
        since_s, known_s = (t_ns - known_ns[0]) * 1e-9, (known_ns - known_ns[0]) * 1e-9
        rate[:, column] = np.interp(since_s, known_s, readings[1][:, column])
    return angle, rate, doubt_s
