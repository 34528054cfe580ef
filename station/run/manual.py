"""Manual mode: a person drives the table by words, in the place of a script."""

import asyncio
import math
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import Any

from drivers.errors import DeviceRefused
from drivers.protocols import Turntable
from station.errors import ScriptError, UsageError, sentence
from station.run.sequencer import ON_TARGET_RAD, OVERDUE_S, WATCH_S, Sequencer
from station.scripts.script import Script, check_step
from station.scripts.steps.kind import Span, Turn
from station.scripts.steps.move import Move
from station.scripts.steps.rest import Rest

_HOLDING = Script("manual", (Rest(0.0, "holding"),))
_FIRST_S = 0.7  # that a jog lasts after its first word: a key that is held repeats after half a second or so
_RENEWED_S = 0.4  # and after each further command: by the host's clock, as it is the person who may be gone
_ENDLESS_RAD = 1e6  # where there is no travel: days of turning
_HOLD_RPS = math.radians(1.0)  # of a move to where the axis stands; a language may know whole deg/s only
_DEG = math.degrees(1)
_WORDS = sentence("manual.words")
_LEAST, _MOST = 1e-6, 1e6  # numbers that a command may have beside 0, in rad, rad/s, rad/s2


class ManualSequencer(Sequencer):
    """Carries out the latest manual command, one motion at a time.

    A jog is a dead man's switch: it must be repeated, and the axis is brought to rest soon after the last repetition,
    whatever happened to the sender. The jog of an axis with limited travel is a move to its end, so that the controller
    keeps the limit.
    """

    def __init__(
        self, table: Turntable, on_step: Callable[[str, int, int], None], tell: Callable[[str], None], time_scale: float
    ) -> None:
        """Prepare to drive ``table``, at home, by hand on the running loop; ``time_scale`` is how fast its clock runs.

        ``on_step(label, start_ns, end_ns)`` is called after each motion, ``tell`` for each event.
        """
        super().__init__(table, _HOLDING, on_step, tell)
        self._scale, self._zero_s = time_scale, asyncio.get_running_loop().time()
        self._orders: deque[Move] = deque()
        self._until_s = math.inf
        self._word = asyncio.Event()
        self._ended = False

    def pause(self) -> None:
        """Raise UsageError: there is no script."""
        raise UsageError('manual mode has no script to pause. Send "hold" to bring the table to rest')

    def times(self, now_s: float) -> tuple[float, Span]:
        """Return the time since the start in s, and a planned span of zero."""
        return now_s - self._zero_s, Span.exactly(0.0)

    def target_rad(self, axis: str) -> float:
        """Return the target angle of an axis that turns, NaN if it does not, or turns without an end."""
        angle_rad = super().target_rad(axis)
        return math.nan if abs(angle_rad) == _ENDLESS_RAD else angle_rad

    def obey(self, action: str, given: Mapping[str, Any]) -> None:
        """Accept a command, which replaces the last; a jog like the present one extends that.

        It is "hold" or "end", which take no values, "jog", "go" or "home". ``given`` has "axis", "rate_rps", for go
        "angle_rad", and perhaps "acceleration_rps2"; "home" without an axis drives all, one after the other. Other keys
        are ignored if they hold numbers. UsageError for anything invalid, and after "end" for all but "hold" and "end";
        ScriptError beyond a limit or for an unknown axis.
        """
        numbers = [value for key, value in given.items() if key != "axis"]
        sound = all(type(value) in (int, float) and (_LEAST <= abs(value) < _MOST or value == 0) for value in numbers)
        match action, given:
            case "hold" | "end", _:
                self._ended |= action == "end"
                self._order([])
            case _ if self._ended or not sound:
                raise UsageError(_WORDS)
            case "jog", {"axis": str(axis), "rate_rps": rate}:
                self._jog(axis, rate, given)
            case "go", {"axis": str(axis), "angle_rad": angle, "rate_rps": rate}:
                self._order([self._checked(f"{axis} to {angle * _DEG:.6g} deg", axis, angle, rate, given)])
            case "home", {"rate_rps": rate}:
                axes = [str(given["axis"])] if "axis" in given else self._table.limits
                self._order([self._checked(f"{axis} home", axis, 0.0, rate, given) for axis in axes])
            case _:
                raise UsageError(_WORDS)

    def _jog(self, axis: str, rate_rps: float, given: Mapping[str, Any]) -> None:
        """Start a jog of an axis, or extend the present one if it has the same rate and acceleration.

        It ends 0.7 s after the first word and 0.4 s after each further one (wall), or at the end of the travel.
        UsageError if the axis stands at that end already, ScriptError beyond a limit.
        """
        limits = self._table.limits.get(axis)
        low, high = (limits and limits.travel_rad) or (-_ENDLESS_RAD, _ENDLESS_RAD)
        end = high if rate_rps > 0 else low
        step = self._checked(f"jog {axis} at {rate_rps * _DEG:+.6g} deg/s", axis, end, rate_rps, given)
        now_s = asyncio.get_running_loop().time()
        if self._orders and self._orders[0] == step:
            self._until_s = max(self._until_s, now_s + _RENEWED_S * self._scale)
        elif self.driven_axis is None and abs(self._target_rad[axis] - end) < ON_TARGET_RAD:
            raise UsageError(f"axis {axis} stands at the end of its travel, {end * _DEG:g} deg")
        else:
            self._order([step], now_s + _FIRST_S * self._scale)

    def _checked(self, label: str, axis: str, angle_rad: float, rate_rps: float, given: Mapping[str, Any]) -> Move:
        """Return the move of ``axis`` to ``angle_rad`` as the table carries it out.

        ``given`` may have the acceleration as "acceleration_rps2"; by default it is the limit of the axis. ScriptError,
        which names ``label``, if the move is beyond a limit or the axis is unknown.
        """
        limits = self._table.limits.get(axis)
        acceleration = given.get("acceleration_rps2", limits.acceleration_rps2 if limits else 1.0)
        step = Move(axis, angle_rad, rate_rps, acceleration, label)
        try:
            return check_step(step, self._table.limits, {})
        except ScriptError as error:
            raise ScriptError(f"script by hand, step 1 ({label}): {error}") from None

    def _order(self, steps: Iterable[Move], until_s: float = math.inf) -> None:
        self._orders, self._until_s = deque(steps), until_s
        self._word.set()

    async def run(self) -> None:
        """Carry out commands one after the other until "end"; a jog whose time is over before its turn is dropped.

        DeviceRefused if an axis does not come to rest.
        """
        while not self._ended:
            if self._orders:
                step = self._orders[0]
                if asyncio.get_running_loop().time() < self._until_s:  # a jog may have waited for a halt
                    await self._obey(step)
                if self._orders and self._orders[0] is step:
                    self._orders.popleft()
            else:
                self._word.clear()
                await self._word.wait()

    async def _obey(self, step: Move) -> None:
        """Carry out a move while it is wanted, then halt the axis unless it arrived.

        It is told when it begins. A move without an end is a jog. A refusal by the table is only reported, but
        DeviceRefused raised if the axis does not come to rest. The motion is recorded as a step.
        """
        loop, axis = asyncio.get_running_loop(), step.axis
        from_rad = self._target_rad[axis]
        way_s = abs((step.angle_rad - from_rad) / step.rate_rps)
        turn = Turn(
            axis=axis,
            from_rad=from_rad,
            to_rad=step.angle_rad,
            rate_rps=step.rate_rps,
            acceleration_rps2=step.acceleration_rps2,
            duration_s=way_s + abs(step.rate_rps) / step.acceleration_rps2,
        )
        self._script = Script("manual", (step,))
        began_s = self._begin_turn(turn)
        self._tell(step.label)
        try:
            if abs(step.angle_rad) == _ENDLESS_RAD:
                await self._table.jog(axis, step.rate_rps, step.acceleration_rps2)
            else:
                await self._table.move(axis, step.angle_rad, abs(step.rate_rps), step.acceleration_rps2)
            self._sent_s = loop.time()
            arrived = await self._arrives(step, began_s + turn.duration_s + OVERDUE_S)
        except DeviceRefused as error:
            self._tell(f"refused: {error.message}")
            arrived = False
        self._target_rad[axis] = step.angle_rad if arrived else await self._halt(step, turn)
        self._on_step(step.label, round(began_s * 1e9), round(loop.time() * 1e9))
        self._script = _HOLDING
        self._end_turn(axis)

    async def _arrives(self, step: Move, due_s: float) -> bool:
        """Wait for the end of a move that was commanded; return whether the axis reached its target.

        False once the move is replaced by another command, a jog is not repeated, or it is overdue at ``due_s`` (loop
        time), which is told.
        """
        loop = asyncio.get_running_loop()
        while self._orders and self._orders[0] is step and loop.time() < min(self._until_s, due_s):
            await asyncio.sleep(WATCH_S)
            off_rad = (await self._table.read(step.axis)).angle_rad - step.angle_rad
            if abs(off_rad) < ON_TARGET_RAD and (await self._table.status(step.axis)).target_reached:
                return True
        if loop.time() > due_s:
            self._tell(f"overdue, ended: {step.label}")
        return False

    async def _halt(self, step: Move, turn: Turn) -> float:
        """Brake an axis along its ramp and hold it where it stands; return its angle (rad).

        ``turn`` is the planned motion, which is cut short. DeviceRefused if the axis is not at rest 5 s after its ramp.
        """
        axis, angle_rad, now_s = step.axis, math.inf, asyncio.get_running_loop().time()
        ramp_s = abs(step.rate_rps) / step.acceleration_rps2
        self._turn = replace(turn, duration_s=now_s - self._turn_began_s + ramp_s)
        await self._table.jog(axis, 0.0, step.acceleration_rps2)
        while True:
            await asyncio.sleep(WATCH_S)
            reached, before_rad = (await self._table.status(axis)).target_reached, angle_rad
            angle_rad = (await self._table.read(axis)).angle_rad
            if reached and abs(angle_rad - before_rad) < ON_TARGET_RAD:
                break
            if asyncio.get_running_loop().time() > now_s + ramp_s + OVERDUE_S:
                reason = f"axis {axis} should be at rest, but is not at {angle_rad * _DEG:.2f} deg"
                raise DeviceRefused("table", reason)
        await self._table.move(axis, angle_rad, _HOLD_RPS, step.acceleration_rps2)  # a rate of zero may drift
        return angle_rad
