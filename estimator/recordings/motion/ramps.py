"""Corners of ramps, found in readings of angle and rate: knots at which the rate is exact.

An axis that is told to move follows a trapezoid of rate. Between two readings a straight line is right everywhere but
where a corner lies. So each ramp is fitted as what it is: a rate that is constant, linear between corners, constant
again, and the angle that this sums up to, which knows the corners much better than the rate readings do. Nobody has
to know what was commanded: a drive rounds accelerations, and recordings of others hold no commands.

An axis that is sent back without a rest brakes, stands for as long as the next command takes, and speeds up again: one
change of rate with more corners. The fewest corners that the readings agree with are taken.
"""

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from estimator.geometry.polyline import modelled, turned
from estimator.types import Flags, Floats, Stamps

WINDOW_S = 3.0
"""How much of the steady rate before and after a ramp tells of it."""
LONGEST_S = 20.0
"""A change of rate that lasts longer, as two ramps of a slow reversal, is no ramp; its corners matter little."""

PIECE_S = 10.0
"""Where rates are means it is taken in pieces of at most this length."""
MOST_CORNERS = 8
"""Of one change of rate: an axis brakes, stands, creeps to its target, stands, speeds up again."""

HOLD_S = 0.4
"""So long before a change of rate is seen a ramp may have begun."""
LEAST_RPS2 = 0.02
"""Slower changes of rate are no ramps."""

_ANGLE_SD_RAD, _RATE_SD_RPS = 1e-4, 3e-4  # of readings with known instants, before their scatter is known
_MOST_SD = np.array([_ANGLE_SD_RAD, _RATE_SD_RPS])
_LEAST_SD = 1e-6  # rad and rad/s: nothing is read better
_SCALE_SD = 0.05  # of a drive's rate readback
_LEAST_RPS = 0.0175  # nor are smaller ones
_QUIET = 2  # intervals without change that end a ramp
_FEWEST = 3  # readings of steady rate on either side
_ROUNDS, _STEPS = 4, 8
_MOVES = 1e-12  # s, rad/s, rad: a step that moves no parameter by more ends a round
_TAIL = 3.0  # a few readings are far off, as a rate that is a mean over a corner
_INWARD = 0.02  # of a ramp
_FITS = 3.0  # sigmas rms; a worse fit is no ramp
_HOPELESS = 100.0  # sigmas rms after the first round: not worth another
_READINGS_A_CORNER = 5.0
_HIDDEN = 2.0  # times the largest change between two readings
_TRIES = 4  # numbers of corners
_BEYOND_S = 1e-3
_BELIEVED_RAD = 3e-5  # rms: counts of an encoder do not scatter where it turns by whole ones between readings
_SHORT = 7  # readings of a parabola
_SEEN = 4.0  # sigmas of a rest between two ramps
_ON_A_RAMP = 0.15, 0.85  # of the steady rate
_NEARLY_STANDS = 0.1  # of how much a rate changes: a corner at less may be at zero
Readings = tuple[Floats, Floats, Floats, Floats, float]
"""Instants in s, angles, rates, half widths in s (n,); the time before their instants in s that rates are means of."""


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class Ramp:
    """A ramp: corners at ``t_s`` (k,) with angles and rates there, and the modelled rates of the readings (n,).

    Rates are in the scale of the rate readings, ``scale`` times that of the angles. ``sd_s`` is the largest standard
    deviation of a corner's instant, of corners where the slope changes noticeably; it is large where the readings do
    not fit, ``fitted_s`` is not. ``followed`` says that both angles and rates are those of the ramp (``followed_by``).
    """

    t_s: Floats
    angle_rad: Floats
    rate_rps: Floats
    reading_rps: Floats
    sd_s: float
    scale: float
    fitted_s: float = np.nan
    followed: bool = True


def centred(at_ns: Stamps, t_ns: Stamps, rate_rps: Floats, window_ns: int) -> Floats:
    """Return rates (n, gimbals) at instants (n,) by means (k, gimbals) over windows that end at instants (k,)."""
    if not window_ns or not len(t_ns):
        return rate_rps  # of these instants
    at_s, known_s = (at_ns - t_ns[0] + window_ns // 2) * 1e-9, (t_ns - t_ns[0]) * 1e-9
    return np.column_stack([np.interp(at_s, known_s, column) for column in rate_rps.T])


def changing(t_s: Floats, rate_rps: Floats) -> Flags:
    """Return for each interval (n - 1,) between readings (n,), (n, axes) whether a rate may change by a ramp in it."""
    change = np.abs(np.diff(rate_rps, axis=0))
    return np.asarray((change > _RATE_SD_RPS + LEAST_RPS2 * np.diff(t_s)[:, None]).any(axis=1))


def ends(changes: Flags) -> tuple[int, bool]:
    """Return the number of intervals of a ramp that begins with the first change, and whether its end is seen."""
    steady = np.flatnonzero(~changes)
    for first in steady.tolist():
        if not changes[first : first + _QUIET].any():
            return first, first + _QUIET <= len(changes)
    return len(changes), False


def piece_of(t_s: Floats, angle_rad: Floats) -> int:
    """Return after how many readings to cut a change of rate: within its longest straight part.

    ``t_s`` and ``angle_rad`` (n,) are its readings, ``t_s`` from 0 on. Only the second half is searched, so that pieces
    do not become ever shorter; at least 1.
    """
    found = list(corners_of(*between_readings(t_s, angle_rad), MOST_CORNERS))
    corners = np.array(found[-1][0] if found else [0, len(t_s) - 1])
    middles, lengths = 0.5 * (t_s[corners[:-1]] + t_s[corners[1:]]), np.diff(t_s[corners])
    lengths[middles < 0.5 * t_s[-1]] = 0.0
    cut_s = float(middles[np.argmax(lengths)]) if lengths.any() else float(t_s[-1])
    return max(int(np.searchsorted(t_s, cut_s)), 1)


def is_ramp(rate_rps: Floats) -> bool:
    """Return whether rates (n, axes) differ enough for a ramp."""
    return bool((np.ptp(rate_rps, axis=0) > _LEAST_RPS).any())


def fitted(readings: Readings, first: int, last: int) -> Ramp | None:
    """Fit a ramp between the readings ``first`` and ``last``; return None if the change is not a ramp.

    ``readings`` are instants (n,) in s, angles, rates and half widths (n,), and the length of the means that rates are
    (0: none). Beyond the two the rate is constant. With fewer than three readings beyond, the change is cut off there;
    that is fitted only if rates are means, since other rates are interpolated well enough. Readings are weighted by
    their half widths and by their deviation. If even the best fit is bad, the instants of its corners count as unknown
    (large ``sd_s``).
    """
    t_s, angle_rad, rate_rps, _, window_s = readings
    cut = first + 1 < _FEWEST, len(t_s) - last < _FEWEST
    rested: Iterator[tuple[Floats, Flags]] = iter(())
    if any(cut):
        starts = _polylines(readings, first, last, cut, 1) if window_s else iter(())
    else:
        start = _start_parameters(t_s, angle_rad, rate_rps, first, last)
        if start is None:
            return None
        free = np.zeros(len(start), dtype=np.bool_)
        rested = _through_rest(readings, first, last)
        starts = itertools.chain([(start, free)], _polylines(readings, first, last, cut, len(start) // 2 - 1))
    noise = _scatter_sd(t_s, angle_rad)
    best, least = None, np.inf
    # Two ramps in one fit nearly as well as two with a short rest between, so these are tried before.
    candidates = itertools.chain(((True, one) for one in rested), ((False, one) for one in starts))
    for stands, (begin, held) in candidates:
        ramp = _fitted_from(begin, held, readings, first, last)
        if ramp is None or (stands and ramp.t_s[2] - ramp.t_s[1] <= _SEEN * ramp.sd_s):
            continue
        misfit = _misfit(ramp, readings, first, last, noise)
        if misfit < _FITS or misfit * noise[0] < _BELIEVED_RAD:
            return replace(ramp, fitted_s=ramp.sd_s)
        if misfit < least:
            best, least = ramp, misfit
    return None if best is None else replace(best, sd_s=LONGEST_S, fitted_s=best.sd_s)  # none of these fits


def _scatter_sd(t_s: Floats, angle_rad: Floats) -> Floats:
    """Return the standard deviations (2,) of angles and rates (rad, rad/s).

    That of angles is from their scatter about short parabolas, most of which contain no corner; limited to the prior
    one, which also holds for too few readings or an axis that stands. That of rates is the prior one.
    """
    if len(t_s) < _SHORT:
        return _MOST_SD.copy()
    t, angle = (sliding_window_view(one, _SHORT)[:: _SHORT // 2] for one in (t_s, angle_rad))
    moves = np.ptp(angle, axis=1) > 0
    if not moves.any():
        return _MOST_SD.copy()
    t, angle = t[moves] - t[moves].mean(axis=1, keepdims=True), angle[moves] - angle[moves].mean(axis=1, keepdims=True)
    basis = np.linalg.qr(np.stack([np.ones_like(t), t, t * t], axis=2))[0]
    left = angle - np.einsum("wij,wkj,wk->wi", basis, basis, angle)
    sd = float(np.median(np.sqrt(np.sum(left**2, axis=1) / (_SHORT - basis.shape[2]))))
    return np.asarray(np.clip([sd, _RATE_SD_RPS], _LEAST_SD, _MOST_SD))


def _misfit(ramp: Ramp, readings: Readings, first: int, last: int, sd: Floats) -> float:
    """Return how far angles lie off a ramp, in sigmas rms: all of them or, if that is more, those within it."""
    t_s = readings[0]
    p = np.concatenate([ramp.t_s, ramp.rate_rps / ramp.scale, [ramp.angle_rad[0], ramp.scale]])
    off = _weighed_deviations(p, readings, sd, np.inf)[0][: len(t_s)] ** 2
    near = (t_s > t_s[first] - 1e-9) & (t_s < t_s[last] + 1e-9)
    return float(np.sqrt(max(np.mean(off), np.mean(off[near]))))


def with_corners(
    known_ns: Stamps, angles: Floats, rates: Floats, ramps: Sequence[tuple[int, Stamps, Ramp]]
) -> tuple[Stamps, Floats, Floats, Floats]:
    """Return readings with the corners of ramps inserted: instants (m,), angles, rates, doubts of corners in s.

    ``known_ns`` (n + 1,), ``angles`` and ``rates`` (n + 1, gimbals) are the readings and the row before them, which is
    not returned. Each ramp is (column, instants of its corners in ns, ramp). Corners beyond the readings are left out.
    Doubts (m, gimbals) are NaN where a gimbal has no ramp.
    """
    inside = [corners[(corners > known_ns[0]) & (corners < known_ns[-1])] for _, corners, _ in ramps]
    t_ns = np.unique(np.concatenate([known_ns[1:], *inside]))
    doubt_s = np.full((len(t_ns), rates.shape[1]), np.nan)
    angle, rate = np.empty_like(doubt_s), np.empty_like(doubt_s)
    of_column = {column: (corners, ramp) for column, corners, ramp in ramps}
    for c in range(rates.shape[1]):
        own_ns, own_angle, own_rate = known_ns, angles[:, c], rates[:, c]
        if c in of_column:
            corners, ramp = of_column[c]
            doubt_s[:, c] = ramp.sd_s
            own_ns, first = np.unique(np.concatenate([known_ns, corners]), return_index=True)
            own_angle = np.concatenate([own_angle, ramp.angle_rad])[first]
            own_rate = np.concatenate([own_rate[:1], ramp.reading_rps, ramp.rate_rps])[first]
        since_s, own_s = (t_ns - known_ns[0]) * 1e-9, (own_ns - known_ns[0]) * 1e-9
        angle[:, c], rate[:, c] = np.interp(since_s, own_s, own_angle), np.interp(since_s, own_s, own_rate)
    return t_ns, angle, rate, doubt_s


def corners_of(t_s: Floats, rate_rps: Floats, most: int) -> Iterator[tuple[list[int], float]]:
    """Yield ever larger selections of readings (n,) that straight lines connect, and the largest deviation of others.

    A selection is a list of indices in order, from three on; the deviation is in rad/s. The first and the last reading
    are always selected; each time the one that deviates most is added. It ends at ``most`` or half of the readings, or
    when nothing deviates.
    """
    corners = [0, len(t_s) - 1]
    while len(corners) < min(most, len(t_s) // 2):
        off = np.abs(rate_rps - np.interp(t_s, t_s[corners], rate_rps[corners]))
        if not off.any():
            return
        corners = sorted({*corners, int(np.argmax(off))})
        yield corners, float(np.abs(rate_rps - np.interp(t_s, t_s[corners], rate_rps[corners])).max())


def between_readings(t_s: Floats, angle_rad: Floats) -> tuple[Floats, Floats]:
    """Return instants midway between readings (n,), and the mean rates there (n - 1,) from the angles."""
    return 0.5 * (t_s[:-1] + t_s[1:]), np.diff(angle_rad) / np.diff(t_s)


def _through_rest(readings: Readings, first: int, last: int) -> Iterator[tuple[Floats, Flags]]:
    """Yield at most one start, with four corners, for an axis that brakes, stands, and accelerates again.

    ``readings`` as for ``fitted``, start and flags of held parameters as for ``_polylines``: the rate in the middle is
    held at zero. The lines of both ramps are fitted well between rest and the steady rate, where there is no corner.
    Nothing if the axis does not turn before and after, or a ramp has too few readings.
    """
    t_s, angle_rad, rate_rps, _, _ = readings
    at_s, rates = between_readings(t_s[max(first - 1, 0) : last + 2], angle_rad[max(first - 1, 0) : last + 2])
    corners = []
    for steady, part in ((rate_rps[: first + 1], slice(None)), (rate_rps[last:], slice(None, None, -1))):
        steady_rps = float(np.median(steady))
        if abs(steady_rps) < _LEAST_RPS:
            return
        share = rates[part] / steady_rps
        own = slice(0, int(np.argmax(share < _ON_A_RAMP[0])))
        inside = (share[own] > _ON_A_RAMP[0]) & (share[own] < _ON_A_RAMP[1])
        if inside.sum() < 2:
            return
        slope_s, rest_s = np.polyfit(rates[part][own][inside], at_s[part][own][inside], 1)
        corners.append((rest_s + slope_s * steady_rps, rest_s, steady_rps))
    (begins_s, stands_s, before_rps), (ends_s, leaves_s, after_rps) = corners
    if leaves_s - stands_s < _BEYOND_S:
        stands_s, leaves_s = 0.5 * (stands_s + leaves_s) + np.array([-_BEYOND_S, _BEYOND_S])
    at = np.array([begins_s, stands_s, leaves_s, ends_s])
    if not np.all(np.diff(at) > 0):
        return
    start = np.concatenate([at, [before_rps, 0.0, 0.0, after_rps], [np.interp(begins_s, t_s, angle_rad), 1.0]])
    held = np.zeros(len(start), dtype=np.bool_)
    held[5:7] = True
    yield start, held


def _polylines(
    readings: Readings, first: int, last: int, cut: tuple[bool, bool], least: int
) -> Iterator[tuple[Floats, Flags]]:
    """Yield starts for a change of rate with more than ``least`` corners, those with the fewest first; none for noise.

    ``readings`` as for ``fitted``. A start has k instants, k rates, an angle and a scale. With each come flags of
    parameters to hold: the ends of a change that is ``cut`` off at its beginning or end, and the rates of corners that
    may be zero, for an axis that stands in between.
    """
    t_s, angle_rad, rate_rps, _, window_s = readings
    # The slope of angles between two readings is over a shorter time than a rate that is a mean.
    low, high = max(first - 1, 0), min(last + 1, len(t_s) - 1)
    between_s, rates = between_readings(t_s[low : high + 1], angle_rad[low : high + 1])
    kept = slice(None if cut[0] else 1, None if cut[1] else -1)
    for end, is_cut, steady in ((0, cut[0], rate_rps[: first + 1]), (-1, cut[1], rate_rps[last:])):
        rates[end] = rates[end] if is_cut else float(np.median(steady))
    # Straight lines between the right corners are off by no more than a corner can hide between two readings.
    most_rps = float(np.abs(np.diff(rates)).max(initial=0.0))
    if np.ptp(rates) < _READINGS_A_CORNER * most_rps:
        return  # noise, or a ramp that is seen by too few readings
    hidden_rps = _HIDDEN * most_rps
    tried = 0
    for corners, off_rps in corners_of(between_s, rates, MOST_CORNERS + 2):
        inner = corners[kept]
        if len(inner) <= least or off_rps > hidden_rps or tried == _TRIES:
            continue
        tried += 1
        at_s, at_rps = between_s[inner], rates[inner]
        ends = np.zeros(len(inner), dtype=np.bool_)
        stands = np.abs(at_rps) <= _NEARLY_STANDS * np.ptp(rate_rps[first : last + 1])
        stands[[0, -1]] = False
        # Beyond an end that is cut off there are no readings, nor means over earlier rates.
        slopes = np.diff(at_rps) / np.diff(at_s)
        for end, is_cut, beyond_s in ((0, cut[0], t_s[0] - window_s - _BEYOND_S), (-1, cut[1], t_s[-1] + _BEYOND_S)):
            if is_cut:
                at_rps[end] += slopes[end] * (beyond_s - at_s[end])
                at_s[end], ends[end] = beyond_s, True
            else:
                at_rps[end] = rates[end]
        angle = angle_rad[0] - at_rps[0] * (t_s[0] - at_s[0]) - 0.5 * slopes[0] * (t_s[0] - at_s[0]) ** 2
        angle = angle if cut[0] else np.interp(at_s[0], t_s, angle_rad)
        for zero in (stands, np.zeros_like(stands)) if stands.any() else (stands,):
            start = np.concatenate([at_s, np.where(zero, 0.0, at_rps), [angle, 1.0]])
            yield start, np.concatenate([ends, zero, [False] * 2])


def _fitted_from(start: Floats, held: Flags, readings: Readings, first: int, last: int) -> Ramp | None:
    """Return the ramp fitted from ``start``, with its number of corners; None if it does not fit or is not determined.

    ``held`` flags the parameters that are known; the others are as for ``fitted`` and ``_polylines``.
    """
    t_s, _, _, _, window_s = readings
    k = len(start) // 2 - 1
    # A corner is somewhere here, even without a reading within the ramp; the rest is only kept from being singular.
    prior = np.full(len(start), 1e-6)
    prior[:k], prior[-1] = 1 / (t_s[last] - t_s[first]), 1 / _SCALE_SD
    prior[held] = 1 / _LEAST_SD
    p, sd = start, _MOST_SD
    rows = np.vstack([np.zeros((2 * len(t_s), len(start))), np.diag(prior)])
    for lap in range(_ROUNDS):
        tail = _TAIL if lap else np.inf
        if lap:
            residual, jacobian, _ = _weighed_deviations(p, readings, sd, tail)
            if lap == 1 and np.mean(residual**2) > _HOPELESS**2:
                return None
            # The accuracy of angles and rates is seen in their scatter, corrected for the number of fitted parameters.
            rows[: 2 * len(t_s)] = jacobian
            taken = np.sum(np.linalg.qr(rows)[0][: len(jacobian)] ** 2, axis=1)
            squares, freedom = (one.reshape(2, -1).sum(axis=1) for one in (residual**2, 1 - taken))
            sd = np.clip(sd * np.sqrt(squares / np.maximum(freedom, 1e-9)), _LEAST_SD, _MOST_SD)
        for _ in range(_STEPS):
            residual, jacobian, _ = _weighed_deviations(p, readings, sd, tail)
            rows[: 2 * len(t_s)] = jacobian  # products of rows may be singular in floating point
            moved = np.linalg.lstsq(rows, np.concatenate([residual, prior * (start - p)]), rcond=None)[0]
            shortest = float((p[1:k] - p[: k - 1]).min())
            p = p + moved * min(1.0, 0.5 * shortest / max(np.abs(moved[:k]).max(), 1e-12))
            if not (p[1:k] > p[: k - 1]).all():
                return None
            if np.abs(moved).max() < _MOVES:
                break
    off = _weighed_deviations(p, readings, _MOST_SD, np.inf)[0] ** 2
    near = np.tile((t_s > t_s[first] - 1e-9) & (t_s < t_s[last] + 1e-9), 2)
    if not max(float(np.mean(off)), float(np.mean(off[near]))) < _FITS**2:
        return None
    residual, _, doubt = _weighed_deviations(p, readings, sd, _TAIL)
    # A reading at a corner says nothing about a shorter ramp, whatever its slopes say about a longer one.
    shorter = p.copy()
    shorter[[0, k - 1]] += _INWARD * (p[k - 1] - p[0]) * np.array([1, -1]) * ~held[[0, k - 1]]
    slopes = modelled(shorter, t_s, window_s)[2] / doubt[:, None]
    factor = np.linalg.qr(np.vstack([slopes, rows[len(slopes) :]]), mode="r")
    variance = np.sum(np.linalg.inv(factor) ** 2, axis=1)[:k] * max(float(np.mean(residual**2)), 1.0)
    if not np.all(np.isfinite(variance)):  # readings too coarse to keep its corners apart
        return None
    # A reading entirely outside the ramp shows how far the rate is from steady, as far as it is known
    # better than that.
    off_rps, doubt = (residual * doubt)[len(t_s) :], doubt[len(t_s) :]
    inside = (t_s > p[0]) & (t_s < p[k - 1] + window_s)
    share = np.where(inside, 0.0, _RATE_SD_RPS**2 / (_RATE_SD_RPS**2 + doubt**2))
    angle, rate = turned(p, p[:k])
    reading_rps = p[-1] * turned(p, t_s)[1] + share * off_rps
    # A corner at which the slope hardly changes may be anywhere: its weight is its effect on the rate.
    bends = np.abs(np.diff(np.diff(p[k : 2 * k]) / np.diff(p[:k]), prepend=0.0, append=0.0))
    sd_s = float(np.max(np.sqrt(variance) * bends / bends.max()))
    return Ramp(
        t_s=p[:k], angle_rad=angle, rate_rps=p[-1] * rate, reading_rps=reading_rps, sd_s=sd_s, scale=float(p[-1])
    )


def _weighed_deviations(p: Floats, readings: Readings, sd: Floats, tail: float) -> tuple[Floats, Floats, Floats]:
    """Return the deviations of readings from a ramp in sigmas (2 n,), their derivatives (2 n, parameters), the sigmas
    (2 n,).

    The angles come first, then the rates. A sigma includes the half width of the reading, as far as readings deviate by
    theirs. ``p`` are the parameters of the ramp, ``readings`` as for ``fitted``. ``sd`` (2,) is that of angles and
    rates with known instants; ``tail`` are the degrees of freedom of their distribution (Student's t), infinite for
    normal.
    """
    t_s, angle_rad, rate_rps, half_width_s, window_s = readings
    angle, rate, slopes = modelled(p, t_s, window_s)
    off = np.concatenate([angle_rad - angle, rate_rps - p[-1] * rate])
    doubt = np.repeat(sd, len(t_s))
    if half_width_s.any():
        # Angle and rate are asked for one after the other: the first may be off by half widths of both.
        angles, rates = turned(p, t_s + np.array([[-2.0], [2.0]]) * half_width_s, window_s)
        may = np.abs(np.hstack([angles - angle, p[-1] * (rates - rate)])).max(axis=0)
        excess = np.minimum(np.abs(off), may)
        share = min(float(np.sum(excess**2) / max(np.sum(may**2), 1e-30)), 1 / 3)
        doubt = np.hypot(doubt, np.maximum(excess, may * np.sqrt(share)))
    if math.isfinite(tail):
        doubt *= np.sqrt((tail + (off / doubt) ** 2) / (tail + 1))
    return off / doubt, slopes / doubt[:, None], doubt


def _start_parameters(t_s: Floats, angle_rad: Floats, rate_rps: Floats, first: int, last: int) -> Floats | None:
    """Return start parameters (2 k + 2,) of one change of rate, suggested by readings ``first`` to ``last``.

    They are k instants of corners in s, the rates at these, the angle at the first of them, and the scale 1. A change
    that goes up and down again has three corners, any other two. ``angle_rad`` and ``rate_rps`` (n,) are those of one
    axis at all instants ``t_s``; those up to ``first`` and from ``last`` on must belong to the steady rates, of which
    the medians are taken. None if the rate does not change, or its peak is at an end.
    """
    before, after = float(np.median(rate_rps[: first + 1])), float(np.median(rate_rps[last:]))
    inner = rate_rps[first : last + 1]
    slope = np.diff(inner) / np.diff(t_s[first : last + 1])
    peak = int(np.argmax(np.abs(inner - 0.5 * (before + after))))
    beyond = abs(inner[peak] - 0.5 * (before + after)) - 0.5 * abs(after - before)
    if beyond > 0.1 * np.ptp(inner):  # up and down again, or the other way round
        middle = t_s[first] + np.array([0.0, t_s[first + peak] - t_s[first], t_s[last] - t_s[first]])
        if not 0 < peak < len(inner) - 1:
            return None
        return np.concatenate([middle, [before, inner[peak], after], [angle_rad[first]], [1.0]])
    if abs(after - before) < 1e-9:
        return None
    steep = float(np.median(slope[np.abs(slope) >= 0.5 * np.abs(slope).max()]))
    length = min(abs((after - before) / steep), t_s[last] - t_s[first])
    # The two lines of the angles, before and after, meet in the middle of the ramp.
    way_rad = angle_rad[last] - angle_rad[first]
    middle_s = (after * t_s[last] - before * t_s[first] - way_rad) / (after - before)
    middle_s = float(np.clip(middle_s, t_s[first] + 0.25 * length, t_s[last] - 0.25 * length))
    corners = [middle_s - 0.5 * length, middle_s + 0.5 * length]
    return np.concatenate([corners, [before, after], [angle_rad[first] - before * (t_s[first] - corners[0])], [1.0]])
