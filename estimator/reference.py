"""What the body really did: body rate at any instant, from what the table or another reference measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.errors import RecordingError
from estimator.kinematics import Site, body_rate, check_gimbals

Floats = NDArray[np.float64]
Stamps = NDArray[np.int64]

GAP_NS = 150_000_000
GAP_ANGLE_RAD = float(np.radians(0.02))
"""Readings further apart than the one that disagree by more than the other hide what happened between them."""

ANCHOR_HALF_WINDOW_NS = 3_000_000_000
"""Half of the window over which the angles correct the rates."""


@dataclass(frozen=True, slots=True)
class TableUncertainty:
    """Standard uncertainties of a table: rate (relative), wobble and orthogonality of its axes, time of readings."""

    rate: float = 0.0
    wobble_rad: float = 0.0
    orthogonality_rad: float = 0.0
    timing_s: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class TableReadings:
    """Angles and rates (k, gimbals) that the table reported; columns as ``gimbals``, outermost first."""

    t_ns: Stamps
    angle_rad: Floats
    rate_rps: Floats
    gimbals: tuple[str, ...]
    uncertainty: TableUncertainty | None = None


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


class _Rows:
    """Rows that grow at the end without being copied each time."""

    def __init__(self, shape: tuple[int, ...], dtype: type = np.float64) -> None:
        self._store: NDArray[Any] = np.empty((256, *shape), dtype=dtype)
        self._length = 0

    def __len__(self) -> int:
        return self._length

    @property
    def all(self) -> NDArray[Any]:
        return self._store[: self._length]

    def append(self, rows: NDArray[Any]) -> None:
        total = self._length + len(rows)
        if total > len(self._store):
            grown = np.empty((max(total, 2 * len(self._store)), *self._store.shape[1:]), dtype=self._store.dtype)
            grown[: self._length] = self.all
            self._store = grown
        self._store[self._length : total] = rows
        self._length = total


class BodyRates:
    """Body rate at any instant from table readings that keep coming.

    Rate readings give the shape between two readings, angle readings the truth over seconds: a servo drive's
    rate is rounded and may be off in scale, its encoder counts are not. Each rate is corrected by the slope,
    within three seconds to each side, of what the angle says beyond the summed rate. A row is final once a
    reading three seconds later is there; ``finish`` makes the rest final. Feeding row by row or all at once gives
    the same numbers, so the live filter and the batch estimate see the same regressors.
    """

    def __init__(self, gimbals: Sequence[str], site: Site | None) -> None:
        """Start empty, for gimbals named outermost first."""
        self._gimbals = check_gimbals(gimbals)
        self._site = site
        n = len(self._gimbals)
        self._times = _Rows((), np.int64)
        self._angle, self._rate, self._summed, self._refined = (_Rows((n,)) for _ in range(4))
        self._known = _Rows((), np.bool_)  # whether what happened since the reading before is known
        self._sums = _Rows((2 + 2 * n,))  # running sums of [s, s^2, d, s d] before each row
        self._sums.append(np.zeros((1, 2 + 2 * n)))

    def add(self, t_ns: Stamps, angle_rad: Floats, rate_rps: Floats) -> None:
        """Take in readings (k,), (k, gimbals), (k, gimbals), later than all before."""
        if not len(t_ns):
            return
        first = not len(self._times)
        before = t_ns[:1] if first else self._times.all[-1:]
        step_ns = np.diff(np.concatenate([before, t_ns]))
        if np.any(step_ns[first:] <= 0):
            raise RecordingError("the times of the table readings do not increase: sort them, drop repeats")
        rates = np.vstack([rate_rps[:1] if first else self._rate.all[-1:], rate_rps])
        area = 0.5 * (rates[1:] + rates[:-1]) * (step_ns * 1e-9)[:, None]
        start = np.zeros((1, rates.shape[1])) if first else self._summed.all[-1:]
        summed = np.cumsum(np.vstack([start, area]), axis=0)[1:]
        drift = self._unwrapped(angle_rad, summed) - summed
        drift_before = drift[:1] if first else (self._angle.all[-1:] - self._summed.all[-1:])
        unexplained = np.diff(np.vstack([drift_before, drift]), axis=0)
        known_step = (step_ns <= GAP_NS) | (np.abs(unexplained).max(axis=1) <= GAP_ANGLE_RAD)
        self._known.append(known_step)
        # What happened in a gap is no error of the rates beside it: there the angles alone count.
        hidden = np.cumsum(np.where(known_step[:, None], 0.0, unexplained), axis=0)
        summed, drift = summed + hidden, drift - hidden
        s = (t_ns - (t_ns[0] if first else self._times.all[0])) * 1e-9
        terms = np.column_stack([s, s * s, drift, s[:, None] * drift])
        self._sums.append(np.cumsum(np.vstack([self._sums.all[-1:], terms]), axis=0)[1:])
        self._times.append(t_ns)
        self._angle.append(drift + summed)
        self._rate.append(rate_rps)
        self._summed.append(summed)
        latest = int(self._times.all[-1]) - ANCHOR_HALF_WINDOW_NS
        self._refine_up_to(int(np.searchsorted(self._times.all, latest, side="right")))

    def finish(self) -> None:
        """Make the last seconds final too, with windows that end with the readings."""
        self._refine_up_to(len(self._times))

    @property
    def final_until_ns(self) -> int:
        """Latest instant at which ``at`` may be asked; before the first reading when there is none yet."""
        n = len(self._refined)
        return int(self._times.all[n - 1]) if n else -(2**62)

    @property
    def starts_ns(self) -> int:
        """Instant of the first reading."""
        return int(self._times.all[0]) if len(self._times) else 2**62

    def at(self, t_ns: Stamps) -> Floats:
        """Return the body rate (rows, 3) in rad/s at instants between the first and the last final reading.

        Rows are NaN where readings are far apart and disagree on what happened between them.
        """
        angle, rate = self.gimbals_at(t_ns)
        w = body_rate(angle, rate, self._gimbals, self._site)
        ends = np.searchsorted(self._times.all[: len(self._refined)], t_ns, side="left")
        w[~self._known.all[ends]] = np.nan
        return w

    def gimbals_at(self, t_ns: Stamps) -> tuple[Floats, Floats]:
        """Return angles and rates (rows, gimbals) at instants in order; beyond the readings, those of the last one."""
        n = len(self._refined)
        times = self._times.all[:n]
        first = min(max(int(np.searchsorted(times, t_ns[0], side="right")) - 1, 0), n - 1)
        last = max(min(int(np.searchsorted(times, t_ns[-1], side="left")) + 1, n), first + 1)
        known = times[first:last]
        origin = int(known[0])
        at_s, known_s = (t_ns - origin) * 1e-9, (known - origin) * 1e-9
        columns = range(len(self._gimbals))
        angle = np.column_stack([np.interp(at_s, known_s, self._angle.all[first:last, c]) for c in columns])
        rate = np.column_stack([np.interp(at_s, known_s, self._refined.all[first:last, c]) for c in columns])
        return angle, rate

    def accelerations_at(self, t_ns: Stamps) -> Floats:
        """Return the slopes (rows, gimbals) of the rates between readings, rad/s2, at instants as for ``at``."""
        n = len(self._refined)
        times, rates = self._times.all[:n], self._refined.all
        ends = np.clip(np.searchsorted(times, t_ns, side="left"), 1, max(n - 1, 1))
        if n < 2:
            return np.zeros((len(t_ns), len(self._gimbals)))
        return np.asarray((rates[ends] - rates[ends - 1]) / ((times[ends] - times[ends - 1]) * 1e-9)[:, None])

    def _unwrapped(self, angle_rad: Floats, summed: Floats) -> Floats:
        """Return angles without whole-turn jumps: the summed rate says which turn it is."""
        known = len(self._times) > 0
        previous = self._angle.all[-1] - self._summed.all[-1] if known else angle_rad[0] - summed[0]
        drift = np.vstack([previous, angle_rad - summed])
        jumps = np.round(np.diff(drift, axis=0) / (2 * np.pi))
        return np.asarray(angle_rad - 2 * np.pi * np.cumsum(jumps, axis=0))

    def _refine_up_to(self, stop: int) -> None:
        start = len(self._refined)
        if stop <= start:
            return
        times, sums = self._times.all, self._sums.all
        low = np.searchsorted(times, times[start:stop] - ANCHOR_HALF_WINDOW_NS, side="left")
        high = np.searchsorted(times, times[start:stop] + ANCHOR_HALF_WINDOW_NS, side="right")
        window = sums[high] - sums[low]
        count = (high - low).astype(np.float64)[:, None]
        n = len(self._gimbals)
        s, ss, d, sd = window[:, :1], window[:, 1:2], window[:, 2 : 2 + n], window[:, 2 + n :]
        spread = ss - s * s / count
        slope = np.where(count >= 5, (sd - s * d / count) / np.where(spread > 0, spread, np.inf), 0.0)
        self._refined.append(self._rate.all[start:stop] + slope)


def rates_from_attitude(readings: AttitudeReadings) -> RateReadings:
    """Return mean body rates (k - 1, 3) between successive attitudes, stamped in the middle.

    NaN beside a lost attitude, and over a gap of more than three usual steps: what happened there is not known.
    """
    q = readings.attitude_wxyz
    w0, v0, w1, v1 = q[:-1, :1], q[:-1, 1:], q[1:, :1], q[1:, 1:]
    scalar = w0 * w1 + np.sum(v0 * v1, axis=1, keepdims=True)
    vector = w0 * v1 - w1 * v0 - np.cross(v0, v1)
    sign = np.where(scalar < 0, -1.0, 1.0)  # q and -q are one attitude: take the short way
    length = np.linalg.norm(vector, axis=1, keepdims=True)
    angle = 2 * np.arctan2(length, sign * scalar)
    turn = sign * vector * np.where(length > 1e-12, angle / np.where(length > 1e-12, length, 1.0), 2.0)
    step_s = np.diff(readings.t_ns)[:, None] * 1e-9
    step_s = np.where(step_s > 3 * np.median(step_s), np.nan, step_s)
    return RateReadings((readings.t_ns[:-1] + np.diff(readings.t_ns) // 2), turn / step_s)
