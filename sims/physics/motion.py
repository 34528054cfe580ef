"""One axis of a table: a rotor that follows trapezoids of rate within its limits, exactly, at any instant."""

import math
import sys
from dataclasses import dataclass

import numpy as np

from drivers.types import Floats

_KEEP_SEGMENTS = 64  # seconds of the past, which sensors with a delay look at


@dataclass(frozen=True, slots=True)
class _Segment:
    """Constant acceleration from ``t_s`` on."""

    t_s: float
    angle_rad: float
    rate_rps: float
    acceleration_rps2: float

    def at(self, t_s: float) -> tuple[float, float]:
        dt = t_s - self.t_s
        rate = self.rate_rps + self.acceleration_rps2 * dt
        return self.angle_rad + 0.5 * (self.rate_rps + rate) * dt, rate


class AxisMotion:
    """Angle and rate of a rotor over time. Commands must come in the order of their times."""

    def __init__(self, angle_rad: float, max_rate_rps: float, max_acceleration_rps2: float) -> None:
        """Start at rest at ``angle_rad``; rates and accelerations of all commands are limited to those given here."""
        self.max_rate_rps = max_rate_rps
        self.max_acceleration_rps2 = max_acceleration_rps2
        self._segments = [_Segment(-math.inf, angle_rad, 0.0, 0.0)]
        self._ends_s = -math.inf
        self.revision = 0
        self._keep = _KEEP_SEGMENTS

    def keep_all(self) -> None:
        """Keep every segment from now on, for a run that is evaluated as a whole."""
        self._keep = sys.maxsize

    def at(self, t_s: float) -> tuple[float, float]:
        """Return angle and rate at one instant; before the kept segments, those of the first."""
        for segment in reversed(self._segments):
            if t_s >= segment.t_s:
                return segment.at(t_s) if segment.t_s > -math.inf else (segment.angle_rad, 0.0)
        first = self._segments[0]
        return first.angle_rad, first.rate_rps

    def angles(self, t_s: Floats) -> Floats:
        """Return the angle in rad at each instant (n,) in s, one or more, in ascending order or not.

        Before the first segment that is kept it is the angle at which that begins.
        """
        first_s = t_s.min()
        begun = [(0.0, self._segments[0].angle_rad, 0.0, 0.0)]
        for segment, following in zip(self._segments, [*self._segments[1:], None], strict=True):
            if segment.t_s > -math.inf and (following is None or following.t_s > first_s):
                begun.append((segment.t_s, segment.angle_rad, segment.rate_rps, segment.acceleration_rps2))
        starts_s, angles, rates, accelerations = np.array(begun).T
        place = np.searchsorted(starts_s[1:], t_s, side="right")
        dt = t_s - starts_s[place]
        return np.asarray(angles[place] + dt * (rates[place] + 0.5 * accelerations[place] * dt))

    def rates(self, t_s: Floats) -> Floats:
        """Return the rate in rad/s at each instant (n,) in s, in ascending order or not.

        Before the first segment that is kept it is the rate at which that begins; 0 before all motion.
        """
        out = np.full(len(t_s), self._segments[0].rate_rps)
        for segment in self._segments:
            if segment.t_s > -math.inf:
                dt = t_s - segment.t_s
                out = np.where(dt >= 0, segment.rate_rps + segment.acceleration_rps2 * dt, out)
        return np.asarray(out)

    def settled(self, t_s: float) -> bool:
        """Return whether the last command has been carried out."""
        return t_s >= self._ends_s

    def jog(self, t_s: float, rate_rps: float, acceleration_rps2: float) -> None:
        """Change to a rate along a ramp from the instant ``t_s`` on, in place of the present motion.

        Rate and acceleration are limited to those of the axis. The sign of the acceleration is ignored; 0 stands for
        the largest.
        """
        rate_rps = min(max(rate_rps, -self.max_rate_rps), self.max_rate_rps)
        acceleration = self._acceleration(acceleration_rps2)
        angle, rate = self.at(t_s)
        self._start(t_s)
        end = self._ramp(t_s, angle, rate, rate_rps, acceleration)
        self._ends_s = end[0]

    def stop(self, t_s: float, acceleration_rps2: float) -> None:
        """Come to rest along a ramp."""
        self.jog(t_s, 0.0, acceleration_rps2)

    def move(self, t_s: float, angle_rad: float, rate_rps: float, acceleration_rps2: float) -> None:
        """Go to an angle from the instant ``t_s`` on, and stay there.

        The rate is a trapezoid, a triangle if the way is short. Rate and acceleration are limited to those of the axis,
        and their signs ignored. If the axis is too fast to stop there, turns the other way or faster than the rate, it
        first comes to rest. A rate of 0 is a stop, an acceleration of 0 the largest.
        """
        acceleration = self._acceleration(acceleration_rps2)
        top = min(abs(rate_rps), self.max_rate_rps)
        if top == 0.0:
            self.stop(t_s, acceleration)
            return
        start_angle, rate = self.at(t_s)
        self._start(t_s)
        now, here = t_s, start_angle
        stopping = here + rate * abs(rate) / (2 * acceleration)
        if (rate and (stopping - angle_rad) * rate > 0) or abs(rate) > top:
            now, here, rate = self._ramp(now, here, rate, 0.0, acceleration)  # too fast to make it: rest first
        sign = math.copysign(1.0, angle_rad - here) if not rate else math.copysign(1.0, rate)
        way = abs(angle_rad - here)
        peak = min(top, math.sqrt(acceleration * way + 0.5 * rate * rate))
        if peak > 0.0:
            now, here, _ = self._ramp(now, here, rate, sign * peak, acceleration)
            ramp_down = peak * peak / (2 * acceleration)
            flat = max(abs(angle_rad - here) - ramp_down, 0.0) / peak
            self._segments.append(_Segment(now, here, sign * peak, 0.0))
            now, here = now + flat, here + sign * peak * flat
            now, here, _ = self._ramp(now, here, sign * peak, 0.0, acceleration)
        self._segments.append(_Segment(now, angle_rad, 0.0, 0.0))  # a servo ends exactly on its target
        self._ends_s = now

    def _ramp(
        self, t_s: float, angle: float, rate: float, to: float, acceleration: float
    ) -> tuple[float, float, float]:
        """Append a ramp from ``rate`` to the rate ``to``, and that rate after it, beginning at ``t_s`` and ``angle``.

        Returns instant, angle and rate at the end of the ramp; without a difference of rates there is no ramp.
        """
        duration = abs(to - rate) / acceleration
        if duration > 0:
            segment = _Segment(t_s, angle, rate, math.copysign(acceleration, to - rate))
            self._segments.append(segment)
            angle, _ = segment.at(t_s + duration)
        self._segments.append(_Segment(t_s + duration, angle, to, 0.0))
        return t_s + duration, angle, to

    def _start(self, t_s: float) -> None:
        """Remove the segments after an instant, before a new motion begins."""
        self.revision += 1
        past = [s for s in self._segments if s.t_s <= t_s]
        self._segments = past[-self._keep :]

    def _acceleration(self, wanted_rps2: float) -> float:
        return min(abs(wanted_rps2) or self.max_acceleration_rps2, self.max_acceleration_rps2)
