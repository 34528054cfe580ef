"""Manual mode: a person drives the table by words, in the place of a script."""

from __future__ import annotations

import asyncio
import math
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from drivers.errors import DeviceRefused
from drivers.protocols import Turntable
from station.errors import UsageError
from station.run.uncommanded import Commanded
from station.scripts.script import Move, Script, check

HOLDING = "holding"
_FIRST_S = 0.7  # that a jog lasts after its first word: a key that is held repeats after half a second or so
_RENEWED_S = 0.4  # and after each further word: by the host's clock, for it is a person who may be gone
_LOOK_S = 0.05
_OVERDUE_S = 5.0
_ON_TARGET_RAD = _STILL_RAD = math.radians(0.05)
_HOLD_RPS = math.radians(1.0)  # of a move to where the axis stands; a language may know whole deg/s only
_DEG = math.degrees(1)
_WORDS = (
    'not understood: say "jog" with axis, rate_rps; "go" with axis, angle_rad, rate_rps; "home" with rate_rps, and '
    'axis if not all; all may have acceleration_rps2, the axis\' limit without; "hold"; "end"'
)


class ManualSequencer:
    """Carries out the last word that was said, one motion at a time; the table must be enabled and homed.

    It is to the session what a ``Sequencer`` is. A jog is a dead man's switch: it goes on while the word comes again, and
    whatever has become of who said it, the axis is brought to rest soon after the last. An axis that has a travel is
    sent to its end by a jog, so that the controller keeps the limit.
    """

    paused = ""

    def __init__(
        self, table: Turntable, on_step: Callable[[str, int, int], None], tell: Callable[[str], None], time_scale: float
    ) -> None:
        """``on_step`` and ``tell`` as of a ``Sequencer``; ``time_scale`` is how fast the loop's clock runs."""
        self._table, self._on_step, self._tell, self._scale = table, on_step, tell, time_scale
        self._zero_s = self._began_s = asyncio.get_running_loop().time()
        self._stands = dict.fromkeys(table.limits, Commanded(0.0, 0.0, 0.0, self._zero_s))
        self._orders: deque[Move] = deque()
        self._until_s = math.inf
        self._step: Move | None = None
        self._word = asyncio.Event()
        self._ended = False

    @property
    def driven_axis(self) -> str | None:
        """Axis that turns, or comes to rest."""
        return None if self._step is None else self._step.axis

    @property
    def label(self) -> str:
        """What is under way."""
        return HOLDING if self._step is None else self._step.label

    def pause(self) -> None:
        """Raise UsageError: there is no script."""
        raise UsageError('manual mode has no script to pause: "hold" brings the table to rest')

    resume = pause

    async def going_on(self) -> None:
        """Return at once: there is no pause."""

    def obey(self, action: str, given: Mapping[str, Any]) -> None:
        """Take a word, which takes the place of the last; UsageError if it is not understood, or beyond a limit."""
        numbers = [value for key, value in given.items() if key != "axis"]
        if not all(isinstance(value, int | float) and math.isfinite(value) for value in numbers):
            raise UsageError(_WORDS)
        match action, given:
            case "jog", {"axis": str(axis), "rate_rps": rate}:
                self._jog(axis, rate, given)
            case "go", {"axis": str(axis), "angle_rad": angle, "rate_rps": rate}:
                self._order([self._checked(f"{axis} to {angle * _DEG:.6g} deg", axis, angle, rate, given)])
            case "home", {"rate_rps": rate}:
                axes = [str(given["axis"])] if "axis" in given else list(self._table.limits)
                self._order(self._checked(f"{axis} home", axis, 0.0, rate, given) for axis in axes)
            case "hold", _:
                self._order([])
            case "end", _:
                self._ended = True
                self._order([])
            case _:
                raise UsageError(_WORDS)

    def _jog(self, axis: str, rate_rps: float, given: Mapping[str, Any]) -> None:
        """Begin a jog, or let one go on that is of the same rate."""
        limits = self._table.limits.get(axis)
        low, high = (limits and limits.travel_rad) or (-math.inf, math.inf)
        end = high if rate_rps > 0 else low
        step = self._checked(f"jog {axis} at {rate_rps * _DEG:+.6g} deg/s", axis, end, rate_rps, given)
        now_s = asyncio.get_running_loop().time()
        if self._orders and self._orders[0] == step:
            self._until_s = max(self._until_s, now_s + _RENEWED_S * self._scale)
        elif self._step is None and abs(self._stands[axis].low_rad - end) < _ON_TARGET_RAD:
            raise UsageError(f"axis {axis} stands at the end of its travel, {end * _DEG:g} deg")
        else:
            self._order([step], now_s + _FIRST_S * self._scale)

    def _checked(self, label: str, axis: str, angle_rad: float, rate_rps: float, given: Mapping[str, Any]) -> Move:
        """Return a step as the table does it; ScriptError if it is beyond a limit."""
        limits = self._table.limits.get(axis)
        acceleration = given.get("acceleration_rps2", limits.acceleration_rps2 if limits else 1.0)
        step = Move(axis, angle_rad, rate_rps, acceleration, label)
        (driven,) = check(Script("by hand", (step,)), self._table.limits).steps
        assert isinstance(driven, Move)
        return driven

    def _order(self, steps: Iterable[Move], until_s: float = math.inf) -> None:
        self._orders, self._until_s = deque(steps), until_s
        self._word.set()

    def commanded(self, axis: str) -> Commanded:
        """Return what an axis was told last."""
        stands, step = self._stands[axis], self._step
        if step is None or step.axis != axis:
            return stands
        ends = stands.low_rad, step.angle_rad
        return Commanded(min(ends), max(ends), abs(step.rate_rps), self._began_s)

    def setpoint_rps(self, axis: str, now_s: float) -> float:
        """Return the rate that is asked of an axis: that of the word, after its ramp."""
        step = self._step
        if step is None or step.axis != axis or not self._wanted(step):
            return 0.0
        rate_rps = min(abs(step.rate_rps), step.acceleration_rps2 * (now_s - self._began_s))
        return math.copysign(rate_rps, step.angle_rad - self._stands[axis].low_rad)

    def wanted_hz(self, now_s: float) -> float:
        """Return 0: the table is read as often as is usual."""
        return 0.0

    def times_s(self, now_s: float) -> tuple[float, float]:
        """Return how long it has gone on, and that nothing is planned."""
        return now_s - self._zero_s, 0.0

    async def run(self) -> None:
        """Carry out words until "end"; DeviceRefused if an axis does not come to rest, or not where it was sent."""
        while not self._ended:
            self._word.clear()
            while self._orders:
                step = self._orders[0]
                await self._drive(step)
                if self._orders and self._orders[0] is step:
                    self._orders.popleft()
            if not self._ended:
                await self._word.wait()

    def _wanted(self, step: Move) -> bool:
        now_s = asyncio.get_running_loop().time()
        return bool(self._orders) and self._orders[0] is step and now_s < self._until_s

    async def _drive(self, step: Move) -> None:
        loop, axis = asyncio.get_running_loop(), step.axis
        self._began_s, self._step = loop.time(), step
        self._tell(step.label)
        try:
            if math.isinf(step.angle_rad):
                await self._table.jog(axis, step.rate_rps, step.acceleration_rps2)
            else:
                await self._table.move(axis, step.angle_rad, abs(step.rate_rps), step.acceleration_rps2)
        except DeviceRefused as error:  # of this motion, by the controller's own rules: no harm to the next
            self._tell(f"refused: {error.message}")
            arrived = False
        else:
            arrived = await self._arrives(step)
        angle_rad = step.angle_rad if arrived else await self._halt(step)
        self._stands[axis] = Commanded(angle_rad, angle_rad, 0.0, loop.time())
        self._step = None
        self._on_step(step.label, round(self._began_s * 1e9), round(loop.time() * 1e9))

    async def _arrives(self, step: Move) -> bool:
        """Return whether an axis came where it was sent, before another word came or the last was too old."""
        way_rad = abs(step.angle_rad - self._stands[step.axis].low_rad)
        rate_rps = abs(step.rate_rps)
        due_s = self._began_s + way_rad / rate_rps + rate_rps / step.acceleration_rps2 + _OVERDUE_S
        while self._wanted(step):
            await asyncio.sleep(_LOOK_S)
            reached = (await self._table.status(step.axis)).target_reached and not math.isinf(step.angle_rad)
            if reached or asyncio.get_running_loop().time() > due_s:
                angle_rad = (await self._table.read(step.axis)).angle_rad
                if abs(angle_rad - step.angle_rad) < _ON_TARGET_RAD:
                    return True
                self._overdue(step, angle_rad, due_s)
        return False

    async def _halt(self, step: Move) -> float:
        """Bring an axis to rest along its ramp and have it hold its angle (rad), which is returned."""
        axis, angle_rad = step.axis, math.inf
        due_s = asyncio.get_running_loop().time() + abs(step.rate_rps) / step.acceleration_rps2 + _OVERDUE_S
        await self._table.jog(axis, 0.0, step.acceleration_rps2)
        while True:
            await asyncio.sleep(_LOOK_S)
            reached, before_rad = (await self._table.status(axis)).target_reached, angle_rad
            angle_rad = (await self._table.read(axis)).angle_rad
            if reached and abs(angle_rad - before_rad) < _STILL_RAD:
                break
            self._overdue(step, angle_rad, due_s)
        await self._table.move(axis, angle_rad, _HOLD_RPS, step.acceleration_rps2)  # a rate of zero may drift
        return angle_rad

    def _overdue(self, step: Move, angle_rad: float, due_s: float) -> None:
        if asyncio.get_running_loop().time() > due_s:
            said = f"{step.label!r} is overdue: axis {step.axis} is at {angle_rad * _DEG:.2f} deg and not at rest there"
            raise DeviceRefused("table", said)
