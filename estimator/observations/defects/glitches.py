"""Readings of another instrument that are wrong for moments: markers mixed up, frozen frames, counts that are lost.

Over each interval between two readings the body turns by what the reference says and, as a line, by what the gyros put
out. Where the two differ by far more than they usually do at such a rate, it is the reading: gyros have no such steps.
"""

from dataclasses import replace

import numpy as np

from estimator.geometry.kinematics import AXES
from estimator.observations.alignment import Following
from estimator.observations.turned import Turned
from estimator.recordings.reading import slopes_of
from estimator.recordings.recording import ImuData, Recording
from estimator.recordings.reference import AttitudeReadings, RateReadings
from estimator.types import Flags, Floats, runs_of

_FAR = 12.0  # times the usual difference
_SHARE = 0.1  # of the intervals: where more are wrong it is not for moments
_LEAST_RAD, _LEAST_SHARE = 1e-4, 0.05  # smaller ones are no glitches: absolute, and over usual turns between readings
_TOGETHER_S = 0.6  # readings between two wrong ones so near to each other are wrong, too
_SEEN = 0.05  # size of a direction of the line, over the largest, that determines how a body turned
_USUAL, _SIGMAS = 0.9, 1.645  # quantile of the differences that shows the usual size, and its place for noise


def without_glitches(recording: Recording, data: ImuData, line: Following) -> tuple[Recording, list[str]]:
    """Return a recording without the reference readings that are wrong for moments, and notes on them.

    The angles of a table lose the wrong steps, and its rates are derived anew; attitudes or rates become NaN. The
    recording is unchanged, without notes, if the reference does not allow this, if there are none, or if too many
    differ. ``line`` is how the outputs follow the reference.
    """
    reference = recording.reference
    if not reference.by_turns or len(line.turned.t_s) < 3 or not np.isfinite(data.rate_rps).any():
        return recording, []
    t_s = line.turned.t_s
    off_rad, speed_rps = _differences(data, line)
    if not np.isfinite(speed_rps).any():
        return recording, []
    turn_rad = speed_rps * np.diff(t_s)
    least_rad = max(_LEAST_RAD, _LEAST_SHARE * float(np.nanquantile(turn_rad, _USUAL, method="nearest")))
    far = _far(off_rad, speed_rps) & (np.nan_to_num(np.linalg.norm(off_rad, axis=1)) > least_rad)
    places = _places(far, t_s)
    if not places or far.mean() > _SHARE:
        return recording, []
    first_s = float(t_s[places[0][0] + 1] - t_s[0])
    worst_deg = float(np.degrees(np.linalg.norm(off_rad[far], axis=1).max()))
    told = (
        f"the reference jumps, or is wrong for a moment, {_times(len(places))}, the first at {first_s:.6g} s, by up to "
        f"{worst_deg:.3g} deg between readings compared with the gyros: "
    )
    table = reference.table
    if table is not None:
        steps = np.where(far, off_rad[:, AXES.index(table.gimbals[0])], 0.0)
        angle = table.angle_rad - np.concatenate([[0.0], np.cumsum(steps)])[:, None]
        right = replace(table, angle_rad=angle, rate_rps=slopes_of(table.t_ns, angle))
        return replace(recording, reference=right), [told + "these steps were removed from its angles"]
    wrong = np.zeros(len(t_s), dtype=np.bool_)
    for start, stop in places:  # intervals, of which both readings may be wrong
        wrong[start : stop + 1] = True
    told += f"{100 * wrong.mean():.2g} % of its readings were excluded"
    assert isinstance(reference, (AttitudeReadings, RateReadings))
    return replace(recording, reference=_without(reference, wrong)), [told]


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"


def _differences(data: ImuData, line: Following) -> tuple[Floats, Floats]:
    """Return the excess turn (k - 1, 3) of the reference over the gyros in each interval, and the speed (k - 1,).

    In rad and rad/s, the speed by the gyros. The excess is NaN where either is unknown, the speed where that of the
    gyros is. Directions in which the gyros do not sense have no excess.
    """
    turned = line.turned
    gains = line.rows[1:]
    size = np.linalg.norm(gains, axis=0)
    used = np.flatnonzero((size > _SEEN * size.max()) & np.isfinite(data.rate_rps).any(axis=0))
    gyros = Turned.of_rates(data.t_ns, data.rate_rps[:, used])
    first_s, last_s = turned.t_s[:-1] + line.delay_s, turned.t_s[1:] + line.delay_s
    rates = (gyros.means(first_s, last_s) - line.rows[0, used]) @ np.linalg.pinv(gains[:, used], rcond=_SEEN)
    seconds = np.diff(turned.t_s)[:, None]
    known = np.diff(turned.gaps) == 0
    said = np.where(known[:, None], np.diff(turned.integral, axis=0), np.nan)
    # The reference cannot be doubted where the gyros do not sense.
    tells = gains[:, used] @ np.linalg.pinv(gains[:, used], rcond=_SEEN)
    return said @ tells - rates * seconds, np.linalg.norm(rates, axis=1)


def _far(off_rad: Floats, speed_rps: Floats) -> Flags:
    """Return as flags (n,) which differences (n, 3) far exceed those usual at their rate: at rest, and in proportion to
    the rate ``speed_rps`` (n,).

    Unknown differences do not.
    """
    size = np.linalg.norm(off_rad, axis=1)
    known: Flags = np.isfinite(size)
    if not known.any():
        return known
    slow = known & (speed_rps <= np.median(speed_rps[known]))
    fast = known & ~slow
    # Of coarse readings most differences are next to zero: the size of the others is the usual one.
    least_rad = float(np.quantile(size[slow], _USUAL)) / _SIGMAS
    late_s = float(np.quantile(size[fast] / speed_rps[fast], _USUAL)) / _SIGMAS if fast.any() else 0.0
    return np.asarray(known & (np.nan_to_num(size) > _FAR * np.maximum(np.hypot(least_rad, late_s * speed_rps), 1e-9)))


def _places(far: Flags, t_s: Floats) -> list[tuple[int, int]]:
    """Return the places of wrong readings as (first interval, one past the last), in order.

    ``far`` (k - 1,) flags the intervals between readings at ``t_s`` (k,). Places less than ``_TOGETHER_S`` apart are
    one.
    """
    places: list[tuple[int, int]] = []
    for start, stop in runs_of(far):
        if places and t_s[start] - t_s[places[-1][1]] < _TOGETHER_S:
            start = places.pop()[0]
        places.append((start, stop))
    return places


def _without(reference: AttitudeReadings | RateReadings, wrong: Flags) -> AttitudeReadings | RateReadings:
    if isinstance(reference, AttitudeReadings):
        return replace(reference, attitude_wxyz=np.where(wrong[:, None], np.nan, reference.attitude_wxyz))
    return replace(reference, rate_rps=np.where(wrong[:, None], np.nan, reference.rate_rps))
