"""Bringing a table to rest whatever the state of its link, and avoiding a table that another program turns."""

import asyncio
import math
from collections import deque
from collections.abc import Awaitable, Callable, Iterator, Sequence
from contextlib import contextmanager

from drivers.errors import BadReply, DeviceError, DeviceRefused, LinkLost
from drivers.packaged import sentence
from drivers.protocols import Turntable
from drivers.types import AxisState

AT_REST_RPS = math.radians(0.02)
_TURNS_RPS = math.radians(0.05)  # at first contact: a servo that holds may tremble
_STILL_RAD = math.radians(0.02)  # between two readings
_LOOK_S = 0.02
_TOLD_AGAIN_S = 0.5  # if an axis does not slow down meanwhile
_WAIT = 50  # time-outs without anything new to be seen
_TELLS, _HEEDS = 2, 0.98  # an axis that answers but has not slowed down after so many stops ignores them
_SLOWER_RPS, _IN_A_ROW = math.radians(0.005), 5  # rate drop, and readings, for an axis that slows down
_LOOKS = 3  # at one that turns without a motion of its controller's, which has nothing to stop then


@contextmanager
def kept(failures: list[DeviceError]) -> Iterator[None]:
    """Collect device errors raised within, so that the caller can go on with the other axes."""
    try:
        yield
    except (LinkLost, BadReply, DeviceRefused) as error:
        failures.append(error)


class _Axis:
    """What was seen of an axis since it was told to stop."""

    def __init__(self, name: str) -> None:
        """Start without readings."""
        self.name = name
        self.stands = self.turns = False
        self.tells = self.astray = 0
        self._first: AxisState | None = None
        self._last: AxisState | None = None
        self._rates_rps: deque[float] = deque(maxlen=_IN_A_ROW)
        self._first_rps = self._slowest_rps = self.news_s = math.inf

    @property
    def heedless(self) -> bool:
        """Whether it got several stops and slows no more (it may tremble), or turns without a motion to stop."""
        enough = self.tells >= _TELLS and len(self._rates_rps) == _IN_A_ROW  # a slow link needs time for its readings
        return self.astray >= _LOOKS or (enough and self._slowest_rps > min(_TURNS_RPS, _HEEDS * self._first_rps))

    def see(self, state: AxisState) -> bool:
        """Add a reading; return whether it shows that the axis slows down or stands.

        Standing means a rate near zero and an angle like that of the reading before. Slowing down means five readings
        in a row clearly below the slowest rate so far: single ones may be noise. The count of stops in vain (``tells``)
        begins anew then.
        """
        self.turns = self._last is not None and abs(state.angle_rad - self._last.angle_rad) > _STILL_RAD
        still = self._last is not None and not self.turns
        rate_rps = abs(state.rate_rps)
        if self._last is None:
            self._first = state
            self._first_rps = self._slowest_rps = rate_rps
        else:
            self._rates_rps.append(rate_rps)
        self._last = state
        self.stands = rate_rps <= AT_REST_RPS and still
        # Compared with the rate at the last stop: a gentle ramp needs time to show, and noise has low readings.
        slows = len(self._rates_rps) == _IN_A_ROW and max(self._rates_rps) < self._slowest_rps - _SLOWER_RPS
        if slows:
            self._slowest_rps, self.tells = max(self._rates_rps), 0
            self._rates_rps.clear()
        return slows or self.stands

    @property
    def contradicts_itself(self) -> bool:
        """Whether it reports a rate, but a position that has not changed since the stop."""
        if self._first is None or self._last is None:
            return False
        return (
            abs(self._last.rate_rps) > AT_REST_RPS and abs(self._last.angle_rad - self._first.angle_rad) <= _STILL_RAD
        )

    def text(self, now_s: float) -> str:
        """Return in words the last reading of the axis and its age at ``now_s`` (loop time).

        Or that its rate and angle contradict each other, or that there was none.
        """
        if self._last is None:
            return f"axis {self.name} no longer reports its state"
        if self.contradicts_itself:
            rate_dps, angle_deg = math.degrees(self._last.rate_rps), math.degrees(self._last.angle_rad)
            return f"axis {self.name} reports {rate_dps:.2f} deg/s but a position that stays at {angle_deg:.2f} deg"
        rate_dps, ago_s = math.degrees(self._last.rate_rps), now_s - self._last.rate_t_ns * 1e-9
        return f"axis {self.name} turned at {rate_dps:.2f} deg/s when last seen, {ago_s:.1f} s ago"


async def bring_to_rest(
    device: str,
    axes: Sequence[str],
    tell: Callable[[str], Awaitable[None]],
    read: Callable[[str], Awaitable[AxisState]],
    timeout_s: float,
    idle: Callable[[str], Awaitable[bool]] | None = None,
) -> str:
    """Tell all axes to stop, in the given order, wait until they stand, and return in words what was seen.

    ``tell(axis)`` sends the stop to one axis and reopens its link if that is lost; ``read(axis)`` reads it. A failure
    with one axis does not delay the others: it is told again after them, and so is an axis that is not seen to slow
    down. ``idle(axis)`` asks whether the controller carries out no motion of an axis; one that turns all the same, at
    three readings in a row, does not hold up the others and counts as one that keeps turning.

    Gives up when an axis that answers does not slow down for about a second, or after 50 times ``timeout_s`` without
    news. LinkLost, BadReply if something else answered, or DeviceRefused if an axis keeps turning; the message has the
    last reading of each axis that may still turn. ``device`` is for the error.
    """
    loop = asyncio.get_running_loop()
    began_s = seen_s = loop.time()
    waiting = [_Axis(name) for name in axes]
    while True:
        failures: list[DeviceError] = []
        stopping = []
        for axis in tuple(waiting):
            with kept(failures):
                await tell(axis.name)
                stopping.append(axis)
        for axis in stopping:
            axis.news_s = loop.time()
        while stopping and loop.time() < min(axis.news_s for axis in stopping) + _TOLD_AGAIN_S:
            for axis in tuple(stopping):
                try:
                    if axis.see(await read(axis.name)):
                        seen_s = axis.news_s = loop.time()
                    if idle is not None:
                        axis.astray = axis.astray + 1 if axis.turns and await idle(axis.name) else 0
                except (LinkLost, BadReply, DeviceRefused) as error:
                    failures.append(error)
                    waiting.append(waiting.pop(waiting.index(axis)))  # the others first
                    break
                if axis.stands:
                    stopping.remove(axis)
                    waiting.remove(axis)
            # Axes that have not got a stop must not wait until the others stand, nor until one is given up.
            if failures or any(axis.astray >= _LOOKS for axis in stopping):
                break
            await asyncio.sleep(_LOOK_S if stopping else 0.0)
        if not waiting:
            return f"{', '.join(axes)} seen at rest {loop.time() - began_s:.2f} s after the stop began"
        for axis in stopping:
            axis.tells += 1
        heedless = [axis for axis in stopping if axis.heedless and not failures]
        if heedless or loop.time() > seen_s + _WAIT * timeout_s:
            raise _not_at_rest(device, heedless or waiting, failures)
        await asyncio.sleep(_LOOK_S)


def _not_at_rest(device: str, axes: Sequence[_Axis], failures: Sequence[DeviceError]) -> DeviceError:
    """Return the error for axes that may still turn, with their last readings and what to do.

    BadReply if the first failure is one, LinkLost for any other; without failures DeviceRefused, which says so if the
    readings of all axes contradict themselves.
    """
    now_s = asyncio.get_running_loop().time()
    readings = "; ".join(axis.text(now_s) for axis in axes)
    if failures:
        kind = BadReply if isinstance(failures[0], BadReply) else LinkLost
        return kind(device, f"{failures[0].message}; {readings}: look at the table")
    if all(axis.contradicts_itself for axis in axes):
        return DeviceRefused(device, f"told to stop, {readings}: its readings do not show whether it is at rest")
    return DeviceRefused(device, f"told to stop, {readings}: it keeps turning. Cut its power")


async def first_look(table: Turntable, *, take_over: bool) -> None:
    """Check at first contact that nobody else drives the table: DeviceRefused if an enabled axis turns.

    Turning is above 0.05 deg/s. With ``take_over`` the table is stopped instead. Failures of the table pass through.
    """
    for axis in table.limits:
        rate_rps = (await table.read(axis)).rate_rps
        if abs(rate_rps) <= _TURNS_RPS or not (await table.status(axis)).enabled:
            continue
        if take_over:
            await table.stop()
            break
        raise DeviceRefused("table", sentence("table.driven_elsewhere", axis=axis, dps=math.degrees(rate_rps)))
