"""Carries out a script on a table."""

import asyncio
import math
from collections.abc import Callable, Mapping
from typing import Any

from drivers.errors import DeviceRefused
from drivers.protocols import Turntable
from station.errors import ScriptError, UsageError, sentence
from station.run.event_loop.host import Overdue
from station.run.snapshot import AFTER_THIS_STEP, PAUSED
from station.run.uncommanded import Commanded, Course
from station.scripts.polling import MARGIN_S, wanted_hz
from station.scripts.script import Script, check_turn
from station.scripts.steps.kind import Span, Turn, total
from station.views.figures import seconds_between

WATCH_S = 0.05  # how often arrival is checked, from this long before it is due
OVERDUE_S = 5.0
ON_TARGET_RAD = math.radians(0.05)
_PAUSE = "pause"


class Sequencer:
    """Carries out the steps of a script in order, and reports their beginnings and ends. The table must be homed."""

    def __init__(
        self,
        table: Turntable,
        script: Script,
        on_step: Callable[[str, int, int], None],
        tell: Callable[[str], None] = lambda text: None,
        newest: Callable[[str], Mapping[str, float]] = lambda quantity: {},
    ) -> None:
        """Prepare to carry out ``script`` on the running loop; all axes of the table must stand at home (0 rad).

        ``on_step(label, start_ns, end_ns)`` is called after each step, part and pause, in ns of the loop's clock.
        ``tell`` gets a sentence for each event. ``newest(quantity)`` returns the newest value of a quantity by source.
        """
        self._table, self._script, self._on_step, self._tell = table, script, on_step, tell
        self._newest = newest
        self._target_rad: dict[str, float] = dict.fromkeys(table.limits, 0.0)
        self._stands_since_s = dict.fromkeys(table.limits, asyncio.get_running_loop().time())
        self._spans = script.spans()
        self._index = 0
        self._step_began_s = 0.0
        self._done_s: list[float] = []
        """Of each step that has ended, how much of the planned time it stands for."""
        self._in_parts = False
        """Whether the step under way has several parts, which are recorded one by one."""
        self._standing: tuple[str, float] | None = None
        """What the axes stand for, and since when."""
        self._turn: Turn | None = None
        """The turn under way."""
        self._turn_began_s = 0.0
        self._sent_s = math.inf  # when the table had got the command
        self.paused = ""
        """Empty, AFTER_THIS_STEP or PAUSED."""
        self._resumed = asyncio.Event()

    @property
    def driven_axis(self) -> str | None:
        """The axis being turned, None if none is."""
        return None if self._turn is None else self._turn.axis

    @property
    def label(self) -> str:
        return _PAUSE if self.paused == PAUSED else self._script.steps[self._index].label

    def pause(self) -> None:
        """Pause after the present step until ``resume``, and tell so; UsageError in the last step.

        Ignored if asked for already.
        """
        if self.paused:
            return
        if self._index == len(self._spans) - 1:
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
        """Return the last command to an axis: range of angles, largest rate, and since when.

        For the axis that turns, the range is from its start to its target, and the course is the planned one, from when
        the table had got the command. Any other is to stand at its last target, without a course.
        """
        target, turn = self._target_rad[axis], self._turn
        if turn is None or axis != turn.axis:
            return Commanded(target, target, 0.0, self._stands_since_s[axis])
        low, high = min(turn.from_rad, target), max(turn.from_rad, target)
        return Commanded(low, high, abs(turn.rate_rps), self._turn_began_s, self._course(turn, self._sent_s))

    def _course(self, turn: Turn, from_s: float) -> Course:
        """Return the planned rate of a turn over time if it begins at ``from_s`` (loop time)."""
        return Course(
            sent_s=from_s,
            duration_s=turn.duration_s,
            rate_rps=turn.rate_rps,
            acceleration_rps2=turn.acceleration_rps2,
            way_rad=turn.way_rad,
            target_rad=turn.to_rad,
        )

    async def going_on(self) -> None:
        """Wait for the end of a pause, if there is one."""
        if self.paused == PAUSED:
            await self._resumed.wait()

    def setpoint_rps(self, axis: str, now_s: float) -> float:
        """Return the rate, with its sign, planned for an axis at ``now_s`` (loop time); 0 if it is not driven."""
        turn = self._turn
        if turn is None or turn.axis != axis:
            return 0.0
        return math.copysign(self._course(turn, self._turn_began_s).speed_rps(now_s), turn.way_rad)

    def target_rad(self, axis: str) -> float:
        """Return the target angle of the axis being turned, NaN for any other."""
        return self._turn.to_rad if self._turn is not None and self._turn.axis == axis else math.nan

    def wanted_hz(self, now_s: float) -> float:
        """Return how often (Hz) the table should be read at ``now_s`` (loop time) for the sake of a ramp.

        The first ramp counts from the beginning of a turn until 0.1 s after its end, the last from 0.1 s before its
        beginning, and on if the turn lasts longer than planned. 0 at other times, without a turn under way, and for a
        turn without ramps.
        """
        turn = self._turn
        if turn is None:
            return 0.0
        since_s = now_s - self._turn_began_s
        near = min(since_s, turn.duration_s - since_s) < turn.ramp_s + MARGIN_S
        return wanted_hz(turn.ramp_s) if near else 0.0

    def times(self, now_s: float) -> tuple[float, Span]:
        """Return how much of the planned time is done (s), and the span of it that remains, at ``now_s`` (loop time).

        The step under way counts as done in part. A step that took longer or less than planned counts with what was
        planned.
        """
        done_s, ahead = sum(self._done_s), self._spans[len(self._done_s) :]
        if len(self._done_s) > self._index:  # the step has ended
            return done_s, total(ahead)
        since_s = now_s - self._step_began_s
        under_way, *later = ahead
        return done_s + under_way.elapsed_s(since_s), total([under_way.remaining(since_s), *later])

    def where(self, now_s: float) -> str:
        """Return in words how far the script is at ``now_s`` (loop time): "after 12.0 s of 360.0 s, in step LABEL"."""
        done_s, left = self.times(now_s)
        planned = seconds_between(done_s + left.least_s, done_s + left.most_s, ".1f")
        return f"after {done_s:.1f} s of {planned}, in step {self.label!r}"

    async def run(self) -> None:
        """Carry out the script and record each step, or each part of a step that has several.

        A pause asked for begins at the end of a step, and is recorded. Errors of the steps and of ``turn`` pass
        through.
        """
        loop = asyncio.get_running_loop()
        for index, (step, span) in enumerate(zip(self._script.steps, self._spans, strict=True)):
            self._index, self._step_began_s = index, loop.time()
            parts = step.parts(self._target_rad)
            self._in_parts, self._standing = len(parts) > 1, None
            await step.carry_out(self, parts)
            ended_s = loop.time()
            if self._in_parts:
                self._record_standing()
            else:
                self._record(step.label, self._step_began_s)
            self._done_s.append(min(max(ended_s - self._step_began_s, span.least_s), span.most_s))
            if self.paused:
                await self._hold()

    async def stand(self, duration_s: float, label: str = "") -> None:
        """Leave all axes at rest for a time; ``label`` gives its purpose. Successive ones with one label are one."""
        if self._standing is None or self._standing[0] != label:
            self._record_standing()
            self._standing = label, asyncio.get_running_loop().time()
        await asyncio.sleep(duration_s)

    def _record_standing(self) -> None:
        """Record the standstill that has ended as a part of the step, if there was one."""
        if self._standing is not None and self._in_parts:
            label, began_s = self._standing
            self._record(f"{self.label}: {label}" if label else self.label, began_s)
        self._standing = None

    def _record(self, label: str, began_s: float) -> None:
        """Record a step, or a part of one, that ends now."""
        self._on_step(label, round(began_s * 1e9), round(asyncio.get_running_loop().time() * 1e9))

    def newest(self, quantity: str) -> Mapping[str, float]:
        """Return the newest value of a quantity by source; sources that do not measure it are left out."""
        return self._newest(quantity)

    def tell(self, text: str) -> None:
        """Keep a sentence with the events of the run."""
        self._tell(text)

    async def _hold(self) -> None:
        """Pause with the table at rest under power until resumed, and record the pause."""
        began_s = asyncio.get_running_loop().time()
        self._tell(f"paused after step {self.label!r}")
        self.paused = PAUSED
        await self._resumed.wait()
        self._record(_PAUSE, began_s)

    def _overdue(self, turn: Turn, angle_rad: float) -> Overdue:
        """Return the error for an axis that did not report its arrival in time.

        Its text depends on ``angle_rad``: the axis is not at its target, or it is there and does not say so.
        """
        at, to = math.degrees(angle_rad), math.degrees(turn.to_rad)
        if abs(at - to) < math.degrees(ON_TARGET_RAD):
            text = sentence("run.never_arrived", axis=turn.axis, step=self.label, at_deg=at, to_deg=to)
        else:
            text = sentence("run.overdue", axis=turn.axis, step=self.label, at_deg=at, to_deg=to)
        return Overdue("table", text)

    async def turn(self, turn: Turn) -> None:
        """Turn an axis and wait for its arrival and the planned time; record it if the step has several parts.

        The standstill before it is recorded first. DeviceRefused if the turn is beyond a limit, as a step may differ
        from its plan, or if the axis stops more than 0.05 deg off; Overdue if it is not there 5 s after it should be,
        in which time the sending of the command is not counted.
        """
        loop = asyncio.get_running_loop()
        axis = turn.axis
        try:
            check_turn(turn, self._table.limits)
        except ScriptError as error:
            raise DeviceRefused("table", f"step {self.label!r}: {error}") from None
        self._record_standing()
        due_s = self._begin_turn(turn) + turn.duration_s
        await self._table.move(axis, turn.to_rad, abs(turn.rate_rps), turn.acceleration_rps2)
        self._sent_s = loop.time()
        await asyncio.sleep(max(due_s - WATCH_S - loop.time(), 0.0))
        while not (await self._table.status(axis)).target_reached:
            # A slow line needs long to report it.
            if loop.time() > due_s + (self._sent_s - self._turn_began_s) + OVERDUE_S:
                raise self._overdue(turn, (await self._table.read(axis)).angle_rad)
            await asyncio.sleep(WATCH_S)
        await asyncio.sleep(max(due_s - loop.time(), 0.0))
        angle = (await self._table.read(axis)).angle_rad
        if abs(angle - turn.to_rad) > ON_TARGET_RAD:
            at, to = math.degrees(angle), math.degrees(turn.to_rad)
            raise DeviceRefused("table", sentence("run.not_there", axis=axis, step=self.label, at_deg=at, to_deg=to))
        self._end_turn(axis)
        if self._in_parts:
            self._record(f"{self.label}: {axis} to {math.degrees(turn.to_rad):g} deg", self._turn_began_s)

    def _begin_turn(self, turn: Turn) -> float:
        """Take it that a turn is under way; return when it began, by the loop's clock."""
        self._turn, self._turn_began_s = turn, asyncio.get_running_loop().time()
        self._sent_s = math.inf
        self._target_rad[turn.axis] = turn.to_rad
        return self._turn_began_s

    def _end_turn(self, axis: str) -> None:
        """Take it that an axis stands from now on."""
        self._turn = None
        self._stands_since_s[axis] = asyncio.get_running_loop().time()
