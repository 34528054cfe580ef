"""A rate table on an ACUTROL controller: up to three axes on one controller, told apart by number.

The language has no command that takes an axis over several turns, and its controllers tell angles within one turn.
So angles are counted on here, and a long way is made in rate mode, watched over, with its last part as a change of
position. While an axis turns, a task reads it often enough to count its turns.
"""

import asyncio
import math
import re
from dataclasses import dataclass, field

from drivers.errors import BadReply, DeviceError, DeviceFault, DeviceRefused
from drivers.packaged import sentence
from drivers.protocols import ByteLink
from drivers.requests.exchange import Answer, Unanswered, UnexpectedReply
from drivers.specs import AxisSetup, TableSetup, TableSpec, described
from drivers.tables.acutrol import language as acutrol
from drivers.tables.base import INTERLOCK_OPEN
from drivers.tables.halting import kept
from drivers.tables.line_table import LineTable, unwrapped
from drivers.tables.unwrap import Unwrapper
from drivers.types import AxisState, AxisStatus, Identity

_POLL_S = 0.02
_TRACK_S = 0.1
_AT_REST_DPS = 0.02
_ON_TARGET_DEG = 0.0005
_NEAR_TARGET_DEG = 0.02  # good enough when another change of position has not brought it nearer
_LONGEST_CHANGE_DEG = 170.0  # of position at once; the language allows 180
_QUIET_S = 0.3  # an axis that stands so long will not go on
_STUCK_S = 1.0  # an axis that has not begun to turn by then will not
_LEAD_S = 0.06  # braking begins earlier by this time, which the command needs to reach the axis
_MOST_LEGS = 8
_HOMING_RATE_DPS = 30.0
_MODE_LIMIT_S = 1.0


@dataclass(slots=True)
class _Task:
    """The command an axis carries out: a target to reach, or a rate to keep."""

    rate_dps: float
    acceleration_dps2: float
    target_deg: float | None = None
    reached: bool = False


@dataclass(slots=True)
class _Axis:
    """What the driver knows about one axis."""

    own: AxisSetup
    unwrapper: Unwrapper = field(default_factory=lambda: Unwrapper(360.0))
    task: _Task | None = None


class AcutrolTable(LineTable):
    """Turntable driver over a byte link, TCP or serial."""

    _done = acutrol.OK

    def __init__(self, setup: TableSetup, link: ByteLink) -> None:
        """Prepare for axes whose addresses are numbers; ValueError if two axes have the same one.

        The option ``reply_prefix`` is the number of bytes before each answer. To resynchronise, the synthesis mode of
        the first axis is used.
        """
        self._axes = {name: _Axis(axis) for name, axis in setup.axes.items()}
        numbers = [axis.address for axis in setup.axes.values()]
        if len(set(numbers)) != len(numbers):
            raise ValueError(f"two axes have the same number: {numbers}")
        first = next(iter(setup.axes.values()))
        most_dps, prefix_length = math.degrees(first.limits.rate_rps), setup.options["reply_prefix"]
        super().__init__(setup, link, acutrol.AcutrolFraming(int(first.address), most_dps, prefix_length))
        self._watchers: set[asyncio.Task[None]] = set()
        self._failure: DeviceError | None = None

    async def open(self) -> None:
        """Open the link, resynchronise, and compare limits; DeviceRefused if the bench file allows more than the
        controller.

        A tenth of a percent more is no difference; an axis whose limits are answered with a single number is not
        checked. The turns counted so far are forgotten. LinkLost if the controller does not answer.
        """
        await self._exchange.open()
        for name, axis in self._axes.items():
            axis.unwrapper.restart()
            text = (await self._ask(f":limit:absolute? {axis.own.address}", acutrol.NUMBERS)).text
            absolute, limits = acutrol.absolute_limits(text), axis.own.limits
            asked = math.degrees(limits.rate_rps), math.degrees(limits.acceleration_rps2)
            if absolute is not None and any(ours > 1.001 * most for ours, most in zip(asked, absolute, strict=True)):
                raise DeviceRefused(
                    self._device,
                    f"axis {name} has limits of {absolute[0]:g} deg/s and {absolute[1]:g} deg/s2, "
                    f"but the bench file allows {asked[0]:g} deg/s and {asked[1]:g} deg/s2: lower "
                    "max_rate, max_acceleration",
                )

    async def identify(self) -> Identity:
        """Ask ``*idn?``: maker, model, serial number, firmware, as IEEE 488.2 has it."""
        parts = [part.strip() for part in (await self._ask("*idn?", acutrol.TEXT)).text.split(",")]
        if len(parts) < 4:
            return Identity(model=", ".join(parts))
        return Identity(f"{parts[0]} {parts[1]}", parts[2], parts[3])

    async def enable(self) -> None:
        """Lock the local panel, close the interlock of every axis that is not enabled, and hold every axis at zero
        rate.

        The interlock of an enabled axis stays closed: opening it would cut the power of an axis that may turn. Such an
        axis is braked with its allowed acceleration. DeviceFault if an axis is in fault or does not become enabled,
        DeviceRefused if rate mode is not entered within 1 s; raises as ``status`` if a move failed before.
        """
        await self._tell(":utility:lockout on")
        for name, axis in self._axes.items():
            if not (await self._sound(name)).enabled:
                for line in (":interlock:open", ":interlock:reset", ":interlock:close"):
                    await self._tell(f"{line} {axis.own.address}")
            await self._turn(name, 0.0, math.degrees(axis.own.limits.acceleration_rps2))
            status = await self.status(name)
            if status.fault or not status.enabled:
                raise DeviceFault(self._device, status.fault or f"axis {name} stays {status.text}")

    async def home(self) -> None:
        """Move every axis to the zero of its encoder by the shorter way, at 30 deg/s at most, and wait; angles count
        from there.

        DeviceFault for an axis in fault, DeviceRefused if homing takes more than a minute; raises as ``status`` if a
        move fails.
        """
        self.homing = set(self.limits)
        for name, axis in self._axes.items():
            axis.unwrapper.restart()
            limits = axis.own.limits
            rate = min(math.radians(_HOMING_RATE_DPS), limits.rate_rps)
            await self.move(name, 0.0, rate, limits.acceleration_rps2)
        await self._wait_for_home(_POLL_S)

    async def jog(self, axis: str, rate_rps: float, acceleration_rps2: float) -> None:
        """Turn an axis at a rate (rate mode) until the next command, in place of its last move or jog.

        Its angle is read in the background, to count its turns. The limits of the bench file are not checked.
        DeviceRefused if rate mode is not entered within 1 s. A failure later is raised by ``read`` or ``status``.
        """
        self._moved, task = axis, _Task(math.degrees(rate_rps), math.degrees(acceleration_rps2))
        self._axes[axis].task = task
        await self._turn(axis, task.rate_dps, task.acceleration_dps2)
        self._watch(axis, task)

    async def move(self, axis: str, angle_rad: float, rate_rps: float, acceleration_rps2: float) -> None:
        """Start a move to an angle from home; it continues in the background, over any number of turns.

        ``rate_rps`` is a speed, of which the sign is ignored. It takes the place of the axis's last move or jog; the
        limits of the bench file are not checked. DeviceRefused if a mode is not entered within 1 s. A failure later is
        raised by ``read`` or ``status``.
        """
        self._moved = axis
        task = _Task(abs(math.degrees(rate_rps)), math.degrees(acceleration_rps2), math.degrees(angle_rad))
        self._axes[axis].task = task
        self._watch(axis, task, await self._begin_leg(axis, task))

    async def read(self, axis: str) -> AxisState:
        """Measure angle and rate; each is stamped with the middle of its own round trip.

        The DeviceError of a move or jog that failed, of whichever axis, is raised once instead.
        """
        self._raise_failure()
        return await self._read(axis)

    async def status(self, axis: str) -> AxisStatus:
        """Read mode and interlock of an axis, and the status byte for the text of a fault.

        A fault is one of the interlock, which only then is reported as open, too. Enabled means any mode but off, with
        the interlock neither open nor in fault. An enabled axis has reached its target at the end of its move, at the
        rate of its jog to 0.02 deg/s, and always without either. The DeviceError of a move or jog that failed, of
        whichever axis, is raised once instead.
        """
        self._raise_failure()
        interlock, mode = await self._interlock(axis), await self._mode(axis)
        fault = ""
        if interlock == "fault":
            byte = round(float((await self._ask("*stb?", acutrol.NUMBER)).text))
            summary = ", interlock summary set" if byte & acutrol.INTERLOCK_SUMMARY else ""
            fault = f"axis {axis}: its interlock says {interlock.capitalize()} (status byte {byte}{summary})"
        enabled = interlock not in ("fault", "open") and mode != "off"
        text = f"mode {mode}, interlock {interlock}"
        open_now = f"{INTERLOCK_OPEN} (or the axis has tripped; the controller reports both alike)" if fault else ""
        return AxisStatus(enabled, enabled and await self._reached(axis), fault, text, interlock=open_now)

    async def stop(self) -> str:
        """Brake every axis in rate mode with its allowed acceleration, on a new connection if necessary.

        Returns in words what was seen. Moves and jogs in progress are given up, and a failure of one is forgotten. An
        axis that is switched off refuses rate mode, which does no harm. Raises as ``bring_to_rest``.
        """
        self._drop_tasks()

        def lines(axis: str) -> tuple[str, ...]:
            own = self._axes[axis].own
            still, most_dps2 = f":demand:rate {own.address},0", math.degrees(own.limits.acceleration_rps2)
            return f":lim:acc rate,{own.address},{most_dps2:.6f}", still, f":mode:rate {own.address}", still

        return await self._rest(lines, self._read)

    async def abort(self) -> None:
        """Open every interlock at once, so that the drives lose their power, and wait for rest.

        Moves and jogs in progress are given up, and a failure of one is forgotten. Raises as ``bring_to_rest``.
        """
        self._drop_tasks()
        await self._rest(lambda axis: (f":interlock:open {self._axes[axis].own.address}",), self._read)

    def _drop_tasks(self) -> None:
        self._failure = None
        for axis in self._axes.values():
            axis.task = None

    async def _clear_fault(self, axis: str) -> None:
        self._axes[axis].task = None
        await self._tell(f":interlock:reset {self._axes[axis].own.address}")

    async def disable(self) -> None:
        """Switch every axis off and open its interlock; moves and jogs in progress are given up.

        The first DeviceError is raised after all have been tried.
        """
        failures: list[DeviceError] = []
        for axis in self._axes.values():
            axis.task = None
            for line in (":mode:off", ":interlock:open"):
                with kept(failures):
                    await self._tell(f"{line} {axis.own.address}")
        if failures:
            raise failures[0]

    def close(self) -> None:
        """Stop the tasks that watch axes, and close the link."""
        for watcher in self._watchers:
            watcher.cancel()
        super().close()

    def _watch(self, axis: str, task: _Task, leg: str = "") -> None:
        watcher = asyncio.get_running_loop().create_task(self._guard(axis, task, leg), name=f"{self._device} {axis}")
        self._watchers.add(watcher)
        watcher.add_done_callback(self._watchers.discard)

    async def _guard(self, axis: str, task: _Task, leg: str) -> None:
        """Carry out a task until it ends; ``leg`` is the kind of leg that a move has begun with, as ``_begin_leg``
        returns it.

        A DeviceError is kept, for the next ``read`` or ``status`` to raise, unless the axis has a new task or another
        error is kept already.
        """
        try:
            if task.target_deg is None:
                await self._follow(axis, task)
            else:
                await self._travel(axis, task, leg)
        except DeviceError as error:
            if self._axes[axis].task is task:
                self._failure = self._failure or error

    def _raise_failure(self) -> None:
        failure, self._failure = self._failure, None
        if failure is not None:
            raise failure

    async def _follow(self, axis: str, task: _Task) -> None:
        """Read the angle of a jogging axis often enough to count its turns, until it has a new task.

        A jog at rate zero also ends when the axis stands.
        """
        own, loop = self._axes[axis], asyncio.get_running_loop()
        rate = math.inf
        while own.task is task and (task.rate_dps or abs(rate) > _AT_REST_DPS):
            if loop.time() - own.unwrapper.last_s >= _TRACK_S:
                rate = math.degrees((await self._read(axis)).rate_rps)
            await asyncio.sleep(_TRACK_S / 2)

    async def _travel(self, axis: str, task: _Task, leg: str) -> None:
        """Move on, leg by leg, until the target is reached, which sets ``task.reached``, or the axis has a new task.

        ``leg`` is the kind of leg in progress, as ``_begin_leg`` returns it. After two changes of position, 0.02 deg
        from the target is near enough. DeviceRefused if it is not reached after eight legs; if the interlock is open or
        in fault then, it just ends.
        """
        changes = 0
        for _ in range(_MOST_LEGS):
            if leg == "done":
                task.reached = True
                return
            if leg == "run" and not await self._run_to_braking(axis, task):
                return
            if not await self._until_rest(axis, task):
                return
            changes += leg == "change"
            leg = await self._begin_leg(axis, task, _NEAR_TARGET_DEG if changes > 1 else _ON_TARGET_DEG)
        if (await self._interlock(axis)) not in ("fault", "open"):
            angle = math.degrees((await self._read(axis)).angle_rad)
            raise DeviceRefused(self._device, sentence("table.stays", axis=axis, at_deg=angle, to_deg=task.target_deg))

    async def _begin_leg(self, axis: str, task: _Task, near_deg: float = _ON_TARGET_DEG) -> str:
        """Start the next leg of a move and return its kind: "brake", "run", "change" or "done".

        "brake": the axis turns, and is brought to rate zero. "run": the target is more than 170 deg away, and it is
        approached in rate mode. "change": a change of position is sent. "done": within ``near_deg`` of the target, or
        the axis has a new task.
        """
        assert task.target_deg is not None
        state = await self._read(axis)
        way = task.target_deg - math.degrees(state.angle_rad)
        if self._axes[axis].task is not task:
            return "done"
        if abs(math.degrees(state.rate_rps)) > _AT_REST_DPS:
            await self._turn(axis, 0.0, task.acceleration_dps2)
            return "brake"
        if abs(way) > _LONGEST_CHANGE_DEG:
            await self._turn(axis, math.copysign(task.rate_dps, way), task.acceleration_dps2)
            return "run"
        if abs(way) <= near_deg:
            return "done"
        await self._change_position(axis, way, task)
        return "change"

    async def _run_to_braking(self, axis: str, task: _Task) -> bool:
        """Wait until a run in rate mode has to brake, then set the rate to zero; False if the axis has a new task.

        True as well if the axis does not turn after 1 s: it is braked, too.
        """
        assert task.target_deg is not None
        own = self._axes[axis]
        began = asyncio.get_running_loop().time()
        while True:
            state = await self._read(axis)
            if own.task is not task:
                return False
            rate = abs(math.degrees(state.rate_rps))
            left = abs(task.target_deg - math.degrees(state.angle_rad)) - rate * (
                rate / (2 * task.acceleration_dps2) + _LEAD_S
            )
            if left <= 0.0:
                break
            if rate <= _AT_REST_DPS and asyncio.get_running_loop().time() - began > _STUCK_S:
                break
            await asyncio.sleep(min(max(left / (2 * task.rate_dps), 0.002), _TRACK_S / 2))
        await self._tell(f":demand:rate {own.own.address},0")
        return True

    async def _until_rest(self, axis: str, task: _Task) -> bool:
        """Wait until an axis stands; False if it has a new task.

        It stands at rate zero on its target, or at rate zero for 0.3 s. Waits without limit.
        """
        own, loop = self._axes[axis], asyncio.get_running_loop()
        stands_since = math.inf
        while own.task is task:
            state = await self._read(axis)
            if abs(math.degrees(state.rate_rps)) > _AT_REST_DPS:
                stands_since = math.inf
            else:
                stands_since = min(stands_since, loop.time())
                on_target = abs(math.degrees(state.angle_rad) - (task.target_deg or 0.0)) <= _ON_TARGET_DEG
                if on_target or loop.time() - stands_since >= _QUIET_S:
                    return True
            await asyncio.sleep(_POLL_S)
        return False

    async def _change_position(self, axis: str, way_deg: float, task: _Task) -> None:
        """Set rate and acceleration limits of position mode, enter it, and change the position demand by ``way_deg``.

        If the answer to the change is lost or wrong, it is not repeated and nothing is raised: the next leg sees the
        result. Refusals are raised, and so is what ``_enter`` raises.
        """
        number = self._axes[axis].own.address
        await self._tell(f":lim:rate pos,{number},{task.rate_dps:.6f}")
        await self._tell(f":lim:acc pos,{number},{task.acceleration_dps2:.6f}")
        await self._enter(axis, "position")
        try:
            await self._ask(f":dem:delta {number},{way_deg:.6f}", acutrol.OK, repeat=False)
        except (Unanswered, BadReply):
            return

    async def _turn(self, axis: str, rate_dps: float, acceleration_dps2: float) -> None:
        number = self._axes[axis].own.address
        await self._tell(f":lim:acc rate,{number},{acceleration_dps2:.6f}")
        await self._enter(axis, "rate")
        await self._tell(f":demand:rate {number},{rate_dps:.6f}")

    async def _enter(self, axis: str, mode: str) -> None:
        """Change the mode of an axis to ``mode``, "rate" or "position", and wait for it.

        Nothing is sent if it is in that mode. Rate mode begins with zero rate. DeviceRefused if the mode is not entered
        within 1 s.
        """
        if await self._mode(axis) == mode:
            return
        number = self._axes[axis].own.address
        if mode == "rate":
            await self._tell(f":demand:rate {number},0")
        await self._tell(f":mode:{mode} {number}")
        loop = asyncio.get_running_loop()
        deadline = loop.time() + _MODE_LIMIT_S
        while (now := await self._mode(axis)) != mode:
            if loop.time() > deadline:
                raise DeviceRefused(self._device, f"axis {axis} stays in mode {now} and does not enter mode {mode}")
            await asyncio.sleep(_POLL_S)

    async def _reached(self, axis: str) -> bool:
        task = self._axes[axis].task
        if task is None or task.target_deg is not None:
            return task is None or task.reached
        rate = math.degrees((await self._read(axis)).rate_rps)
        return abs(rate - task.rate_dps) <= _AT_REST_DPS

    async def _read(self, axis: str) -> AxisState:
        own = self._axes[axis]
        position = await self._ask(f":read:position {own.own.address}", acutrol.NUMBER)
        rate = await self._ask(f":read:rate {own.own.address}", acutrol.NUMBER)
        return unwrapped(own.unwrapper, (position, float(position.text)), (rate, float(rate.text)))

    async def _mode(self, axis: str) -> str:
        return (await self._ask(f":mode? {self._axes[axis].own.address}", acutrol.WORD)).text.lower()

    async def _interlock(self, axis: str) -> str:
        return (await self._ask(f":interlock? {self._axes[axis].own.address}", acutrol.WORD)).text.lower()

    async def _ask(self, line: str, pattern: re.Pattern[str], *, repeat: bool = True) -> Answer:
        try:
            return await self._exchange.ask(line, pattern, repeat=repeat)
        except UnexpectedReply as error:
            if acutrol.refusal(error.text):
                raise DeviceRefused(self._device, f"refuses {line!r}: {error.text}") from None
            raise


SPEC = described(TableSpec, __package__, make=AcutrolTable)
