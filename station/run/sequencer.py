"""Carries out a script on a table."""

import asyncio
import math
from collections.abc import Callable, Mapping
from typing import Any

from drivers.errors import DeviceRefused
from drivers.protocols import Turntable
from station.errors import UsageError, sentence
from station.run.event_loop.host import Overdue
from station.run.snapshot import AFTER_THIS_STEP, PAUSED
from station.run.uncommanded import Commanded, Course
from station.scripts.polling import MARGIN_S, ramp_s, wanted_hz
from station.scripts.script import Move, Rest, Rotate, Script

WATCH_S = 0.05  # how often arrival is asked for, from this long before it is due
OVERDUE_S = 5.0
ON_TARGET_RAD = math.radians(0.05)
_PAUSE = "pause"


class Sequencer:
    """Runs steps in order; tells when each begins and ends. The table must be enabled and homed."""

    def __init__(
        self,
        table: Turntable,
        script: Script,
        on_step: Callable[[str, int, int], None],
        tell: Callable[[str], None] = lambda text: None,
    ) -> None:
        """``on_step(label, start_ns, end_ns)`` is called after each step and pause; ``tell`` keeps what happened."""
        self._table, self._script, self._on_step, self._tell = table, script, on_step, tell
        self._target_rad: dict[str, float] = dict.fromkeys(table.limits, 0.0)
        self._stands_since_s = dict.fromkeys(table.limits, asyncio.get_running_loop().time())
        self._durations_s = script.durations_s()
        self._index = 0
        self._step_began_s = 0.0
        self._way_rad = 0.0  # of the step under way
        self._sent_s = math.inf  # when the table had been told of it
        self.paused = ""
        """Empty, AFTER_THIS_STEP or PAUSED."""
        self._resumed = asyncio.Event()

    @property
    def driven_axis(self) -> str | None:
        """Axis that the step under way turns."""
        step = self._script.steps[self._index]
        return None if isinstance(step, Rest) or self.paused == PAUSED else step.axis

    @property
    def label(self) -> str:
        return _PAUSE if self.paused == PAUSED else self._script.steps[self._index].label

    def pause(self) -> None:
        """Hold once the step under way has ended, until ``resume``; UsageError in the last step."""
        if self.paused:
            return
        if self._index == len(self._durations_s) - 1:
            raise UsageError("the last step is running, and the run ends after it")
        self._resumed.clear()
        self.paused = AFTER_THIS_STEP
        self._tell(f"will pause after step {self.label!r}")

    def resume(self) -> None:
        """Go on, or take back a pause that has not begun; UsageError if there is none."""
        if not self.paused:
            raise UsageError("the run is not paused")
        self._tell("resumed" if self.paused == PAUSED else "pause taken back")
        self.paused = ""
        self._resumed.set()

    def obey(self, action: str, given: Mapping[str, Any]) -> None:
        """Raise UsageError: only a ``ManualSequencer`` is driven by words."""
        raise UsageError("this run follows a script. `station run --manual` starts one that is driven by hand")

    def commanded(self, axis: str) -> Commanded:
        """Return what an axis was told last."""
        step, target = self._script.steps[self._index], self._target_rad[axis]
        if isinstance(step, Rest) or axis != self.driven_axis:
            return Commanded(target, target, 0.0, self._stands_since_s[axis])
        start = target - self._way_rad
        duration_s = self._durations_s[self._index]
        course = Course(self._sent_s, duration_s, step.rate_rps, step.acceleration_rps2, self._way_rad, target)
        low, high = min(start, target), max(start, target)
        return Commanded(low, high, abs(step.rate_rps), self._step_began_s, course)

    async def going_on(self) -> None:
        """Wait for the end of a pause, if there is one."""
        if self.paused == PAUSED:
            await self._resumed.wait()

    def setpoint_rps(self, axis: str, now_s: float) -> float:
        """Return the rate that the script asks of an axis at an instant of the loop's clock."""
        step = self._script.steps[self._index]
        if isinstance(step, Rest) or step.axis != axis or self.paused == PAUSED:
            return 0.0
        duration_s = self._durations_s[self._index]
        course = Course(self._step_began_s, duration_s, step.rate_rps, step.acceleration_rps2, self._way_rad)
        return math.copysign(course.speed_rps(now_s), self._way_rad)

    def wanted_hz(self, now_s: float) -> float:
        """Return how often the table should be read now, beyond what is usual: 0 but on ramps."""
        step = self._script.steps[self._index]
        if isinstance(step, Rest) or self.paused == PAUSED:
            return 0.0
        length_s = ramp_s(step.rate_rps, step.acceleration_rps2, self._way_rad)
        since_s = now_s - self._step_began_s
        near = min(since_s, self._durations_s[self._index] - since_s) < length_s + MARGIN_S
        return wanted_hz(length_s) if near else 0.0

    def times_s(self, now_s: float) -> tuple[float, float]:
        """Return time done and time remaining by plan."""
        done = sum(self._durations_s[: self._index]) + min(now_s - self._step_began_s, self._durations_s[self._index])
        return done, sum(self._durations_s) - done

    async def run(self) -> None:
        """Run the script to its end; DeviceRefused if an axis does not get where it was sent."""
        loop = asyncio.get_running_loop()
        for index, (step, duration_s) in enumerate(zip(self._script.steps, self._durations_s, strict=True)):
            self._index, self._step_began_s = index, loop.time()
            self._sent_s = math.inf
            due_s = self._step_began_s + duration_s
            if isinstance(step, Rest):
                await asyncio.sleep(duration_s)
            else:
                await self._drive(step, due_s)
            self._on_step(step.label, round(self._step_began_s * 1e9), round(loop.time() * 1e9))
            if not isinstance(step, Rest):
                self._stands_since_s[step.axis] = loop.time()
            if self.paused:
                await self._hold()

    async def _hold(self) -> None:
        """Leave the table as it is, at rest under power, until told to go on; time done stands still meanwhile."""
        began_s = asyncio.get_running_loop().time()
        self._tell(f"paused after step {self.label!r}")
        self.paused = PAUSED
        await self._resumed.wait()
        self._on_step(_PAUSE, round(began_s * 1e9), round(asyncio.get_running_loop().time() * 1e9))

    def _overdue(self, step: Move | Rotate, angle_rad: float, target_rad: float) -> Overdue:
        """Return the error of a step whose axis has not told in time that it has arrived."""
        at, to = math.degrees(angle_rad), math.degrees(target_rad)
        if abs(at - to) < math.degrees(ON_TARGET_RAD):
            text = sentence("run.never_arrived", axis=step.axis, step=step.label, at_deg=at, to_deg=to)
        else:
            text = sentence("run.overdue", axis=step.axis, step=step.label, at_deg=at, to_deg=to)
        return Overdue("table", text)

    async def _drive(self, step: Move | Rotate, due_s: float) -> None:
        axis = step.axis
        target = step.angle_rad if isinstance(step, Move) else self._target_rad[axis] + step.turn_rad
        self._way_rad = target - self._target_rad[axis]
        self._target_rad[axis] = target
        await self._table.move(axis, target, abs(step.rate_rps), step.acceleration_rps2)
        loop = asyncio.get_running_loop()
        self._sent_s = loop.time()
        await asyncio.sleep(max(due_s - WATCH_S - loop.time(), 0.0))
        while not (await self._table.status(axis)).target_reached:
            if loop.time() > due_s + (self._sent_s - self._step_began_s) + OVERDUE_S:  # a slow line takes long to tell
                raise self._overdue(step, (await self._table.read(axis)).angle_rad, target)
            await asyncio.sleep(WATCH_S)
        await asyncio.sleep(max(due_s - loop.time(), 0.0))
        angle = (await self._table.read(axis)).angle_rad
        if abs(angle - target) > ON_TARGET_RAD:
            at, to = math.degrees(angle), math.degrees(target)
            raise DeviceRefused("table", sentence("run.not_there", axis=axis, step=step.label, at_deg=at, to_deg=to))
