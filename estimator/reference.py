"""What the body really did: body rate at any instant, from what the table or another reference measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.errors import RecordingError
from estimator.kinematics import Site, body_rate, check_gimbals

Floats = NDArray[np.float64]
Stamps = NDArray[np.int64]

ANCHOR_HALF_WINDOW_NS = 1_000_000_000
"""Half of the window over which the angles correct the rates."""


@dataclass(frozen=True, slots=True, eq=False)
class TableReadings:
    """Angles and rates (k, gimbals) that the table reported; columns as ``gimbals``, outermost first."""

    t_ns: Stamps
    angle_rad: Floats
    rate_rps: Floats
    gimbals: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class RateReadings:
    """Body rates (k, 3) measured by another instrument."""

    t_ns: Stamps
    rate_rps: Floats


@dataclass(frozen=True, slots=True, eq=False)
class AttitudeReadings:
    """Attitudes (k, 4), unit quaternions w x y z that turn body vectors into a frame at rest; NaN where lost."""

    t_ns: Stamps
    attitude_wxyz: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Turns:
    """Spans of time with the angle turned in each, body axes (k, 3), and the doubt of that angle (k,)."""

    t_start_ns: Stamps
    t_end_ns: Stamps
    turn_rad: Floats
    sd_rad: Floats


Reference = TableReadings | RateReadings | AttitudeReadings | Turns


class BodyRates:
    """Body rate at any instant from table readings that keep coming.

    Rate readings give the shape between two readings, angle readings the truth over a second: a servo drive's
    rate is rounded and may be off in scale, its encoder counts are not. Each rate is corrected by the slope,
    within one second to each side, of what the angle says beyond the summed rate. A row is final once a
    reading one second later is there; ``finish`` makes the rest final. Feeding row by row or all at once gives
    the same numbers, so the live filter and the batch estimate see the same regressors.
    """

    def __init__(self, gimbals: Sequence[str], site: Site | None) -> None:
        """Start empty, for gimbals named outermost first."""
        self._gimbals = check_gimbals(gimbals)
        self._site = site
        n = len(self._gimbals)
        self._t = np.empty(0, dtype=np.int64)
        self._angle = np.empty((0, n))
        self._rate = np.empty((0, n))
        self._sums = np.zeros((1, 2 + 2 * n))  # running sums of [s, s^2, d, s d] before each row
        self._summed_rate = np.zeros((0, n))
        self._refined = np.empty((0, n))

    def add(self, t_ns: Stamps, angle_rad: Floats, rate_rps: Floats) -> None:
        """Take in readings (k,), (k, gimbals), (k, gimbals), later than all before."""
        if not len(t_ns):
            return
        last = self._t[-1:]
        times = np.concatenate([last, t_ns])
        if np.any(np.diff(times) <= 0):
            raise RecordingError("the times of the table readings do not increase: sort them, drop repeats")
        step_s = np.diff(times) * 1e-9
        rates = np.vstack([self._rate[-1:], rate_rps])
        area = 0.5 * (rates[1:] + rates[:-1]) * step_s[:, None]
        if not len(self._t):
            area = np.vstack([np.zeros(rates.shape[1]), area])
            start = np.zeros(rates.shape[1])
        else:
            start = self._summed_rate[-1]
        summed = np.cumsum(np.vstack([start, area]), axis=0)[1:]
        drift = self._unwrapped(angle_rad, summed) - summed
        s = (t_ns - (self._t[0] if len(self._t) else t_ns[0])) * 1e-9
        terms = np.column_stack([s, s * s, drift, s[:, None] * drift])
        self._sums = np.vstack([self._sums, np.cumsum(np.vstack([self._sums[-1], terms]), axis=0)[1:]])
        self._t = np.concatenate([self._t, t_ns])
        self._angle = np.vstack([self._angle, drift + summed])
        self._rate = np.vstack([self._rate, rate_rps])
        self._summed_rate = np.vstack([self._summed_rate, summed])
        final = int(np.searchsorted(self._t, self._t[-1] - ANCHOR_HALF_WINDOW_NS, side="right"))
        self._refine_up_to(final)

    def finish(self) -> None:
        """Make the last second final too, with windows that end with the readings."""
        self._refine_up_to(len(self._t))

    @property
    def final_until_ns(self) -> int:
        """Latest instant at which ``at`` may be asked; before the first reading when there is none yet."""
        n = len(self._refined)
        return int(self._t[n - 1]) if n else -(2**62)

    @property
    def starts_ns(self) -> int:
        """Instant of the first reading."""
        return int(self._t[0]) if len(self._t) else 2**62

    def at(self, t_ns: Stamps) -> Floats:
        """Return the body rate (rows, 3) in rad/s at instants between the first and the last final reading."""
        n = len(self._refined)
        # Search near the newest rows only: a live filter asks for the end of a long run.
        first = max(int(np.searchsorted(self._t[:n], t_ns[0], side="right")) - 1, 0)
        last = min(int(np.searchsorted(self._t[:n], t_ns[-1], side="left")) + 1, n)
        known = self._t[first:last]
        origin = int(known[0])
        at_s, known_s = (t_ns - origin) * 1e-9, (known - origin) * 1e-9
        columns = range(len(self._gimbals))
        angle = np.column_stack([np.interp(at_s, known_s, self._angle[first:last, c]) for c in columns])
        rate = np.column_stack([np.interp(at_s, known_s, self._refined[first:last, c]) for c in columns])
        return body_rate(angle, rate, self._gimbals, self._site)

    def _unwrapped(self, angle_rad: Floats, summed: Floats) -> Floats:
        """Return angles without whole-turn jumps: the summed rate says which turn it is."""
        previous = self._angle[-1] - self._summed_rate[-1] if len(self._t) else angle_rad[0] - summed[0]
        drift = np.vstack([previous, angle_rad - summed])
        jumps = np.round(np.diff(drift, axis=0) / (2 * np.pi))
        return np.asarray(angle_rad - 2 * np.pi * np.cumsum(jumps, axis=0))

    def _refine_up_to(self, stop: int) -> None:
        start = len(self._refined)
        if stop <= start:
            return
        t = self._t[start:stop]
        low = np.searchsorted(self._t, t - ANCHOR_HALF_WINDOW_NS, side="left")
        high = np.searchsorted(self._t, t + ANCHOR_HALF_WINDOW_NS, side="right")
        window = self._sums[high] - self._sums[low]
        count = (high - low).astype(np.float64)[:, None]
        n = len(self._gimbals)
        s, ss, d, sd = window[:, :1], window[:, 1:2], window[:, 2 : 2 + n], window[:, 2 + n :]
        spread = ss - s * s / count
        slope = np.where(count >= 5, (sd - s * d / count) / np.where(spread > 0, spread, np.inf), 0.0)
        self._refined = np.vstack([self._refined, self._rate[start:stop] + slope])


def rates_from_attitude(readings: AttitudeReadings) -> RateReadings:
    """Return mean body rates between successive attitudes, stamped in the middle; NaN beside a lost one."""
    q = readings.attitude_wxyz
    w0, v0, w1, v1 = q[:-1, :1], q[:-1, 1:], q[1:, :1], q[1:, 1:]
    scalar = w0 * w1 + np.sum(v0 * v1, axis=1, keepdims=True)
    vector = w0 * v1 - w1 * v0 - np.cross(v0, v1)
    sign = np.where(scalar < 0, -1.0, 1.0)  # q and -q are one attitude: take the short way
    length = np.linalg.norm(vector, axis=1, keepdims=True)
    angle = 2 * np.arctan2(length, sign * scalar)
    turn = sign * vector * np.where(length > 1e-12, angle / np.where(length > 1e-12, length, 1.0), 2.0)
    step_s = np.diff(readings.t_ns)[:, None] * 1e-9
    return RateReadings((readings.t_ns[:-1] + np.diff(readings.t_ns) // 2), turn / step_s)
