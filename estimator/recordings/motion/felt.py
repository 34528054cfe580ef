"""The motion between the final rows of a table, and as accelerometers feel it.

An accelerometer away from the axis feels how fast the rate changes. That is known where an axis ramps evenly, and as a
mean between two readings. At a corner of a ramp it jumps: a mean across it, or a sensor that averages for some ms,
moves a part of the force out of the ramp, and a lever arm found from it would be too short.
"""

import numpy as np

from estimator.recordings.motion.as_read import bent
from estimator.recordings.motion.growing_rows import GrowingRows
from estimator.types import Flags, Floats, Stamps

_HALF_SPAN_NS = 10_000_000  # to each side of an acceleration: a mean over it is hardly touched by noise of rates


def interpolated(final: GrowingRows, t_ns: Stamps, *names: str) -> list[Floats]:
    """Return the named columns of final rows, each (rows, gimbals), at ordered instants (rows,), linear in between.

    They come in the order of ``names``. Beyond the final rows the values are those of the nearest.
    """
    n, times = len(final), final["t_ns"]
    first = min(max(int(times.searchsorted(t_ns[0], side="right")) - 1, 0), n - 1)
    last = max(min(int(times.searchsorted(t_ns[-1], side="left")) + 1, n), first + 1)
    known = times[first:last]
    origin = int(known[0])
    at_s, known_s = (t_ns - origin) * 1e-9, (known - origin) * 1e-9
    found = []
    for name in names:
        values = final[name][first:last]
        out = np.empty((len(at_s), values.shape[1]))
        for column in range(values.shape[1]):
            out[:, column] = np.interp(at_s, known_s, values[:, column])
        found.append(out)
    return found


def mean_slopes(final: GrowingRows, t_ns: Stamps, name: str) -> Floats:
    """Return the mean slopes (rows, gimbals) of a column of rates over 20 ms about ordered instants (rows,), rad/s2."""
    # A reading and a corner may lie so close together that the slope between them is nothing but rounding.
    known = final["t_ns"]
    before, after = (np.clip(t_ns + way_ns, known[0], known[-1]) for way_ns in (-_HALF_SPAN_NS, _HALF_SPAN_NS))
    change = interpolated(final, after, name)[0] - interpolated(final, before, name)[0]
    return np.asarray(change / (np.maximum(after - before, 1) * 1e-9)[:, None])


def felt_at(final: GrowingRows, t_ns: Stamps) -> tuple[Floats, Floats, Floats]:
    """Return angles, rates and accelerations (rows, gimbals) for accelerometers at ordered instants (rows,).

    Where readings do not follow straight ramps, they count as they are (``as_read``). Angles are bent between rows,
    accelerations are means from one row to the next, or over 20 ms if these are nearer. Beyond the rows the angles and
    rates are those of the nearest.
    """
    times, angle, rate = (final[name] for name in ("t_ns", "felt_angle", "felt_rate"))
    acceleration = mean_slopes(final, t_ns, "felt_rate")
    if len(times) > 1:
        after = np.clip(np.searchsorted(times, t_ns, side="right"), 1, len(times) - 1)
        step_ns = times[after] - times[after - 1]
        apart = step_ns >= 2 * _HALF_SPAN_NS
        step_s = step_ns[apart, None] * 1e-9
        acceleration[apart] = (rate[after[apart]] - rate[after[apart] - 1]) / step_s
    return bent(t_ns, times, angle, rate), interpolated(final, t_ns, "felt_rate")[0], acceleration


def felt_known(final: GrowingRows, t_ns: Stamps) -> Flags:
    """Return as flags (rows,) whether ``felt_at`` is what accelerometers feel at ordered instants (rows,).

    So it is where the motion is known, and no corner of a straight ramp is nearer than 10 ms.
    """
    times = final["t_ns"]
    known = final["felt_sure"][np.searchsorted(times[:-1], t_ns, side="left")]
    corners = times[final["sharp"]]
    first, last = (np.searchsorted(corners, t_ns + way_ns) for way_ns in (-_HALF_SPAN_NS, _HALF_SPAN_NS))
    return np.asarray(known & (first == last))
