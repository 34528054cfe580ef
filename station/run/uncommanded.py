"""Motion of an axis compared with its commands: motion without a command, and rest despite one."""

import asyncio
import math
from collections import deque
from collections.abc import Callable
from itertools import pairwise
from typing import NamedTuple

from drivers.errors import DeviceFault
from drivers.protocols import Turntable
from drivers.types import AxisLimits, AxisState
from station.errors import sentence

_ANGLE_RAD = math.radians(0.1)  # twice the allowed error of an axis at the end of a step
_RATE_RPS = math.radians(1.0)
_RATE_SHARE = 1.1
_LATE_S = 0.25  # for which a controller may continue with a rate after a stop
_SIGMAS = 6.0  # of the rate that a standing axis reports
_FORGET = 0.05
_LOOKS, _AGAIN_S = 3, 0.02
_HOMING_LOOK_S = 0.1

AT_REST_S = 1.5
"""Time from when readings stop to tell the truth to when the axis is to stand."""
_SEEN_S = 0.25  # of that: readings are taken again, the fault is raised, the stop is sent
_SHORTEST_WINDOW_S = 0.2  # controllers and gateways may repeat a reading
_LATEST_START_S = 0.3  # that a drive may take to begin a motion, at least
_STANDS = 0.5  # share of the commanded way, below which an axis stands
_RATE_OFF = 0.25  # share of a steady rate by which all its readings may differ from the positions
_COUNTS = 2  # that a difference of two readings may be off


class Course(NamedTuple):
    """A trapezoid of rate that an axis was commanded to follow from ``sent_s`` on (loop time)."""

    sent_s: float
    duration_s: float
    rate_rps: float
    acceleration_rps2: float
    way_rad: float
    target_rad: float = math.nan

    def speed_rps(self, at_s: float) -> float:
        """Return the absolute rate planned for an instant, 0 before and after."""
        since_s = at_s - self.sent_s
        ramp_s = min(since_s, self.duration_s - since_s)
        return min(abs(self.rate_rps), self.acceleration_rps2 * max(ramp_s, 0.0))

    def least_speed_rps(self, from_s: float, to_s: float) -> float:
        """Return the least absolute rate planned between two instants: a trapezoid has it at one of its ends."""
        return min(self.speed_rps(from_s), self.speed_rps(to_s))

    def may_be_over(self, at_s: float) -> bool:
        """Return whether an axis whose rate is a tenth too high may have arrived."""
        return at_s >= self.sent_s + self.duration_s / _RATE_SHARE


class Commanded(NamedTuple):
    """The command of an axis: to be between two angles, no faster than a rate, since an instant (loop time).

    ``course`` is the planned motion, None where there is no plan.
    """

    low_rad: float
    high_rad: float
    rate_rps: float
    since_s: float
    course: Course | None = None

    def off_rad(self, angle_rad: float) -> float:
        """Return how far an angle lies outside. Whole turns are left out: a link opened again may have lost them."""
        return math.remainder(angle_rad - min(max(angle_rad, self.low_rad), self.high_rad), math.tau)


class UntrueReadings(DeviceFault):
    """The readings of an axis contradict its command or each other, so that they do not show whether it turns."""


class MotionGuard:
    """Checks readings against commands; a suspicious one is repeated before it is believed."""

    def __init__(self, table: Turntable, commanded: Callable[[str], Commanded]) -> None:
        """``commanded`` returns the last command to an axis."""
        self._table, self._commanded = table, commanded
        self._noise_rps2 = dict.fromkeys(table.limits, 0.0)
        self._readings: dict[str, deque[AxisState]] = {axis: deque() for axis in table.limits}

    async def look(self, axis: str, first: AxisState) -> None:
        """Check a reading of an axis; one that is suspicious is repeated twice before it is believed.

        DeviceFault if the axis has tripped or does something it was not commanded to do; UntrueReadings if its readings
        contradict its command or each other.
        """
        state = first
        for _ in range(_LOOKS - 1):
            if not self._off(axis, state) and not self._untrue(axis, state):
                return
            await asyncio.sleep(_AGAIN_S)
            state = await self._table.read(axis)
        if untrue := self._untrue(axis, state):
            await check_axes(self._table, (axis,))  # an axis that has tripped stands, and has a reason
            raise UntrueReadings("table", untrue)
        if not self._off(axis, state):
            return
        command = self._commanded(axis)
        turned_rad, took_s = state.angle_rad - first.angle_rad, (state.angle_t_ns - first.angle_t_ns) * 1e-9
        rate_dps = math.degrees(max(turned_rad / took_s, state.rate_rps, key=abs))
        does = f"turns at {rate_dps:.1f} deg/s"
        if abs(turned_rad / took_s) < _STANDS * abs(state.rate_rps):
            turned_deg = math.degrees(turned_rad)
            does = f"reports a rate of {rate_dps:.1f} deg/s and a position that changed by {turned_deg:.2f} deg"
            does = f"{does} in {took_s:.2f} s: it turns, or its readings are frozen or wrong"
        if abs(rate_dps) < math.degrees(_RATE_RPS):
            off_deg = math.degrees(command.off_rad(state.angle_rad))
            does = f"stands {off_deg:+.2f} deg from where it should be (it was turned, or its encoder has jumped)"
        raise DeviceFault("table", f"axis {axis} {does}; {_command_text(command)}")

    def _off(self, axis: str, state: AxisState) -> bool:
        """Return whether a reading is outside the commanded angles or rate, allowing for noise and a late stop.

        A reading from before the command does not count. The rates of an axis that is to stand go into its noise.
        """
        command = self._commanded(axis)
        # A mean rate is evidence on this command only if its whole interval came after it.
        if state.rate_t_ns - state.rate_window_ns // 2 >= command.since_s * 1e9:
            noise_rps = math.sqrt(self._noise_rps2[axis])
            if abs(state.rate_rps) > _RATE_SHARE * command.rate_rps + _RATE_RPS + _SIGMAS * noise_rps:
                return True
            if not command.rate_rps:
                self._noise_rps2[axis] += _FORGET * (state.rate_rps**2 - self._noise_rps2[axis])
        judged = state.angle_t_ns >= command.since_s * 1e9
        return judged and abs(command.off_rad(state.angle_rad)) > _ANGLE_RAD + _LATE_S * command.rate_rps

    def _untrue(self, axis: str, state: AxisState) -> str:
        """Add a reading; return in words how those of the last moments contradict the course or each other, else "".

        "" also while the readings do not yet span the time needed to decide. Older readings are dropped.
        """
        command, limits = self._commanded(axis), self._table.limits[axis]
        readings = self._readings[axis]
        if not readings or state.angle_t_ns > readings[-1].angle_t_ns:
            readings.append(state)
        until_s = state.angle_t_ns * 1e-9
        late_s, window_s = _patience_s(command, limits)
        round_trips_s = 4 * state.half_width_ns * 1e-9
        mean_s = 2 * state.rate_window_ns * 1e-9  # two means, one after the other
        window_s = max(window_s - round_trips_s, _SHORTEST_WINDOW_S, mean_s)
        while len(readings) > 1 and readings[1].angle_t_ns * 1e-9 <= until_s - window_s:
            readings.popleft()
        since = readings[0]
        from_s = since.angle_t_ns * 1e-9
        if until_s - from_s < window_s:
            return ""
        way = _Way(tuple(readings), limits.resolution_rad)
        for found in (self._stands(axis, command, late_s + round_trips_s, way), self._contradicts(axis, way)):
            if found:
                return f"axis {axis} {found}; {_command_text(command)}"
        return ""

    def _stands(self, axis: str, command: Commanded, late_s: float, way: "_Way") -> str:
        """Return in words that an axis stands, by its readings, or its rate is wrong, although its course turns it.

        ``way`` has the readings of the last moments, ``command`` the command, which may begin late by ``late_s``. "" if
        that is not so, there is no course, or it may be over and the axis is at its target.
        """
        course = command.course
        if course is None or (course.may_be_over(way.until_s) and abs(way.angle_rad - course.target_rad) < _ANGLE_RAD):
            return ""
        least_rps = course.least_speed_rps(way.from_s - late_s, way.until_s)
        turned_rad = math.copysign(1.0, course.way_rad) * way.turned_rad
        rates_rps = [math.copysign(1.0, course.way_rad) * rate for rate in way.rates_rps]
        slow_rps = _STANDS * least_rps - _RATE_RPS
        rates_stand = bool(rates_rps) and slow_rps > 0.0 and max(rates_rps) < slow_rps
        least_rad = _STANDS * least_rps * way.took_s - way.doubt_rad(least_rps)
        if turned_rad < least_rad and least_rad > 0.0:
            if rates_rps and max(map(abs, rates_rps)) > _RATE_RPS:
                return f"{way.stands}, and it reports {way.rate_text}: its position readings are frozen or wrong"
            return f"{way.stands}: it is held fast, its drive does not obey, or its readings are frozen"
        if rates_stand or self._rate_is_off(axis, course, way, least_rps):
            return f"reports {way.rate_text} while its position turns at {way.mean_dps:.1f} deg/s: its rate is wrong"
        return ""

    def _rate_is_off(self, axis: str, course: Course, way: "_Way", least_rps: float) -> bool:
        """Return whether an axis turns at its full rate and none of its reported rates agrees with its position.

        ``least_rps`` is the least speed of the course in the time of ``way``; False below the full rate.
        """
        if least_rps < abs(course.rate_rps) or not way.rates_rps:
            return False
        mean_rps = way.turned_rad / way.took_s
        nearest_rps = min(abs(rate - mean_rps) for rate in way.rates_rps)
        doubt_rps = way.doubt_rad(least_rps) / way.took_s + _SIGMAS * math.sqrt(self._noise_rps2[axis])
        return nearest_rps > _RATE_OFF * least_rps + _RATE_RPS + doubt_rps

    def _contradicts(self, axis: str, way: "_Way") -> str:
        """Return in words that an axis reports a rate while its position stands, "" if not.

        It stands if its path is less than half of what the smallest reported rate gives in that time, less the
        uncertainty of the readings. Return "" as well if rates differ in sign, or if the smallest one is below 1 deg/s
        after its noise is taken off.
        """
        least_rps = min(map(abs, way.rates_rps), default=0.0) - _SIGMAS * math.sqrt(self._noise_rps2[axis])
        if least_rps < _RATE_RPS or min(way.rates_rps) < 0.0 < max(way.rates_rps):
            return ""
        if way.length_rad < _STANDS * least_rps * way.took_s - way.doubt_rad(least_rps):
            return f"{way.stands}, and it reports {way.rate_text}: its readings are frozen or wrong"
        return ""


class _Way:
    """What the readings of one time window show; there are at least two, oldest first."""

    def __init__(self, readings: tuple[AxisState, ...], resolution_rad: float) -> None:
        """Compute first and last time, angle turned between them, length of the path, and reported rates.

        ``rates_rps`` may be shorter than ``readings``, even empty: means that began before the first reading are left
        out. ``resolution_rad`` is the encoder's.
        """
        first, last = readings[0], readings[-1]
        self._resolution_rad = resolution_rad
        self.from_s, self.until_s = first.angle_t_ns * 1e-9, last.angle_t_ns * 1e-9
        self.took_s = self.until_s - self.from_s
        self.angle_rad = last.angle_rad
        self.turned_rad = last.angle_rad - first.angle_rad
        angles_rad = [one.angle_rad for one in readings]
        self.length_rad = sum(abs(after - before) for before, after in pairwise(angles_rad))
        self.half_width_s = max(first.half_width_ns, last.half_width_ns) * 1e-9
        # Rates that are means over a time which lies within the window.
        self.rates_rps = [
            one.rate_rps for one in readings if one.rate_t_ns - one.rate_window_ns // 2 >= first.angle_t_ns
        ]

    def doubt_rad(self, rate_rps: float) -> float:
        """Return the uncertainty of the way: from the counts, and from the unknown instant within its round trip."""
        return _COUNTS * self._resolution_rad + rate_rps * 2 * self.half_width_s

    @property
    def mean_dps(self) -> float:
        return math.degrees(self.turned_rad / self.took_s)

    @property
    def rate_text(self) -> str:
        return f"a rate of {math.degrees(self.rates_rps[-1]):.1f} deg/s"

    @property
    def stands(self) -> str:
        at_deg, turned_deg = math.degrees(self.angle_rad), math.degrees(self.turned_rad)
        return f"reports that it stands (at {at_deg:.2f} deg, {turned_deg:+.2f} deg in {self.took_s:.2f} s)"


def _patience_s(command: Commanded, limits: AxisLimits) -> tuple[float, float]:
    """Return how late (s) an axis may start to turn, and for how long (s) it may then read as if it stood.

    Without a course it may not start late. Together they leave enough time to bring it to rest: on a gentle ramp it
    takes longer until the rate matters.
    """
    to_see_s = AT_REST_S - _SEEN_S
    at_rate_s = to_see_s - command.rate_rps / limits.acceleration_rps2
    if command.course is None:
        return 0.0, max(at_rate_s, _SHORTEST_WINDOW_S)
    on_the_ramp_s = to_see_s / (1.0 + command.course.acceleration_rps2 / limits.acceleration_rps2)
    from_start_s = max(on_the_ramp_s, at_rate_s)
    late_s = max(_LATEST_START_S, from_start_s / 2)
    return late_s, max(min(at_rate_s, from_start_s - late_s), _SHORTEST_WINDOW_S)


def _command_text(command: Commanded) -> str:
    return (
        f"it was told to {f'turn at up to {math.degrees(command.rate_rps):.1f} deg/s' if command.rate_rps else 'stand'}"
    )


async def check_axes(table: Turntable, axes: tuple[str, ...]) -> None:
    """Check that every axis is in operation; DeviceFault if one has a fault or an open interlock, or is not enabled."""
    for axis in axes:
        status = await table.status(axis)
        if status.trouble:
            raise DeviceFault("table", status.trouble)
        if not status.enabled:
            raise DeviceFault("table", sentence("run.left_operation", axis=axis, status=status.text))


async def watch_homing(table: Turntable) -> None:
    """Check the readings of all axes until cancelled; DeviceFault if one turns that is not homing.

    An axis that is homing may turn at its largest rate; one that has finished counts as standing from then on. Raises
    as ``MotionGuard.look``, and what ``table.read`` raises.
    """
    loop = asyncio.get_running_loop()
    homed_s = dict.fromkeys(table.limits, loop.time())

    def commanded(axis: str) -> Commanded:
        if axis in table.homing:
            homed_s[axis] = loop.time()
        rate_rps = table.limits[axis].rate_rps if axis in table.homing else 0.0
        return Commanded(-math.inf, math.inf, rate_rps, homed_s[axis])

    guard = MotionGuard(table, commanded)
    while True:
        for axis in table.limits:
            await guard.look(axis, await table.read(axis))
        await asyncio.sleep(_HOMING_LOOK_S)
