"""A turntable of CiA 402 servo drives on Modbus, TCP or RTU: one drive an axis, told apart by unit id."""

import asyncio
import math
from collections.abc import Iterable
from dataclasses import astuple, dataclass
from functools import partial

from drivers.errors import BadReply, DeviceError, DeviceFault, DeviceRefused
from drivers.specs import TableSetup
from drivers.tables.base import INTERLOCK_OPEN, Table
from drivers.tables.halting import kept
from drivers.tables.modbus import cia402
from drivers.tables.modbus.line import Address, ModbusLine, Reply
from drivers.tables.modbus.order import Request
from drivers.tables.modbus.registers import DriveProfile
from drivers.types import AxisState, AxisStatus, Identity, LinkCounts

TURN = 2 * math.pi
_POLL_S = 0.02
_STATE_LIMIT_S = 2.0
_HOMING_RATE_RPS = math.radians(30.0)
_TAKEN_S = 0.02  # drives take a mode or a controlword in a cycle of their own, of at most 10 ms
_START_AGAIN_S = 0.5  # if a drive does not show that it took the start of its homing
_HOME_RAD = math.radians(0.05)  # about zero: at home
_ORDERS = ("controlword", "mode", "target_position", "target_rate")
_FAULTS = (cia402.DriveState.FAULT, cia402.DriveState.FAULT_REACTION)


@dataclass(slots=True)
class _HomingStart:
    """Evidence of whether a drive accepted the start of its homing, or still reports the previous one.

    In CiA 402, bits 12 and 13 stay from the last homing until the drive accepts the next start. ``before`` is the
    statusword in homing mode just before the start; ``fallen`` has the bits seen clear since.
    """

    before: int
    angle_rad: float
    first_s: float
    last_s: float
    fallen: int = 0

    def see(self, word: int) -> None:
        """Note which bits are clear."""
        self.fallen |= ~word

    @property
    def taken(self) -> bool:
        """Whether the drive has accepted the start: bit 12 or 10 fell, or no bit of an old homing was set."""
        return not self.before & cia402.BIT_12 or bool(
            self.fallen & (cia402.BIT_12 | self.before & cia402.TARGET_REACHED)
        )


class ModbusTable(Table):
    """Turntable driver over a stock pymodbus client."""

    def __init__(self, setup: TableSetup, address: Address) -> None:
        """Prepare for drives whose addresses are unit ids, at ``address`` unless an axis has its own ``link``.

        Axes with the same address share a line. The option ``profile`` describes the drives.
        """
        super().__init__("table", {name: axis.limits for name, axis in setup.axes.items()}, setup.timeout_s)
        self._profile: DriveProfile = setup.options["profile"]
        self._axes = setup.axes
        probes: dict[Address, dict[int, list[Request]]] = {}
        for axis, drive in self._axes.items():
            harmless = [self._reading(axis, name) for name in ("statusword", "position")]
            probes.setdefault(drive.link or address, {})[int(drive.address)] = harmless
        lines = {where: ModbusLine(self._device, where, setup.timeout_s, reads) for where, reads in probes.items()}
        self._lines = {axis: lines[drive.link or address] for axis, drive in self._axes.items()}
        self._starts: dict[str, _HomingStart] = {}  # of axes that were sent home
        self._ready: set[str] = set()  # axes that have got the profile's first values since their line was opened

    @property
    def counts(self) -> LinkCounts:
        """Requests without an answer, and replies dropped, on all lines."""
        each = [astuple(line.counts) for line in set(self._lines.values())]
        return LinkCounts(*map(sum, zip(*each, strict=True)))

    async def open(self) -> None:
        """Connect all lines, read the state of every drive and write the profile's values to those that are not
        enabled.

        A drive that is enabled may be driven by another program: it is not written to before the first command.
        LinkLost if one does not answer, BadReply if its state is none, DeviceRefused if it refuses a value.
        """
        self._ready.clear()
        for line in dict.fromkeys(self._lines.values()):
            await line.open()
        idle = [axis for axis in self._axes if not (await self.status(axis)).enabled]
        for axis in idle:
            await self._make_ready(axis)

    async def _make_ready(self, axis: str) -> None:
        """Write the registers that the profile requires on a new connection, before the first command over it.

        That is tried once for each connection: after a failure, which is raised, the axis counts as ready all the same.
        """
        if axis not in self._ready:
            self._ready.add(axis)
            for name, value in self._profile.on_open:
                await self._write(axis, name, value)

    async def identify(self) -> Identity:
        """Return the make of the drives, and serial number and firmware of each where the profile knows them."""
        return Identity(self._profile.name, await self._numbers("serial_number"), await self._numbers("firmware"))

    async def enable(self) -> None:
        """Step every drive to Operation enabled; one that is enabled already is left so.

        A drive in quick stop loses its power first. The drives before it are read meanwhile, as each watches for its
        master's silence. DeviceFault if a drive is in fault or its interlock is open, DeviceRefused if it does not
        change state within 2 s.
        """
        for axis in self._axes:
            await self._sound(axis)
            await self._leave_quick_stop(axis)
            steps = (
                ("shutdown", cia402.DriveState.READY_TO_SWITCH_ON),
                ("switch_on", cia402.DriveState.SWITCHED_ON),
                ("enable", cia402.DriveState.OPERATION_ENABLED),
            )
            for command, state in steps:
                if await self._state(axis) is cia402.DriveState.OPERATION_ENABLED:
                    break
                await self._command(axis, command)
                await self._wait_for_state(axis, state)
                await self._hail(list(self._axes)[: list(self._axes).index(axis)])

    async def home(self) -> None:
        """Run the drives' homing on all axes at once, by the profile's method, and wait for it.

        Its rates are 30 deg/s, or the largest of the axis if that is less, and a quarter of that. DeviceRefused if one
        does not start, reports an error of homing or takes more than a minute; DeviceFault for a fault.
        """
        self.homing = set(self._axes)
        self._starts.clear()
        for axis in self._axes:
            await self._command(axis, "enable")  # without the start bit, before the mode gives that a new meaning
            await self._write(axis, "mode", cia402.MODE_HOMING)
            await self._write(axis, "homing_method", self._profile.homing_method)
            rate_rps = min(_HOMING_RATE_RPS, self.limits[axis].rate_rps)
            await self._write_motion(axis, "homing_rate_1", rate_rps)
            await self._write_motion(axis, "homing_rate_2", rate_rps / 4)
            await self._hail(self._axes)
        await asyncio.sleep(_TAKEN_S)
        for axis in self._axes:
            angle_rad = await self._read(axis, "position") * TURN
            word = int(await self._read(axis, "statusword"))
            now_s = asyncio.get_running_loop().time()
            self._starts[axis] = _HomingStart(word, angle_rad, first_s=now_s, last_s=now_s)
            await self._command(axis, "home")
            await self._hail(self._axes)
        await self._wait_for_home(_POLL_S)

    async def _at_home(self, axis: str) -> bool:
        """Return whether an axis has finished homing; one that had is still asked for a fault.

        A finished homing has its start bit taken back. A start that the drive has not accepted within 0.5 s is
        repeated. DeviceFault for a fault, DeviceRefused for a homing error or a start that is never accepted.
        """
        word = int(await self._read(axis, "statusword"))
        if cia402.state_of(word) in _FAULTS:
            raise DeviceFault(self._device, await self._fault_text(axis, word))
        if axis not in self.homing:
            return True
        start = self._starts[axis]
        start.see(word)
        if word & cia402.BIT_13 and start.fallen & cia402.BIT_13:
            raise DeviceRefused(self._device, f"axis {axis} reports a homing error")
        there = bool(word & cia402.BIT_12 and word & cia402.TARGET_REACHED)
        there = there and (start.taken or await self._homed_unseen(axis, start))
        if there:
            await self._command(axis, "enable")  # takes the start bit back
        elif not start.taken and asyncio.get_running_loop().time() >= start.last_s + _START_AGAIN_S:
            await self._start_homing_again(axis, start)
        return there

    async def _homed_unseen(self, axis: str, start: _HomingStart) -> bool:
        """Return whether a drive was homed so fast that its bits were never seen to fall.

        That is so if it reads zero now and did not at the start. A drive that was at home already is believed 2 s after
        the first start; DeviceRefused if it is not at home by then.
        """
        loop = asyncio.get_running_loop()
        state = await self.read(axis)
        at_home = abs(state.angle_rad) <= _HOME_RAD
        if at_home and abs(start.angle_rad) > 2 * _HOME_RAD:
            return True
        if loop.time() < start.first_s + _STATE_LIMIT_S:
            return False
        if not at_home:
            raise DeviceRefused(
                self._device,
                f"axis {axis} did not start homing within {_STATE_LIMIT_S:g} s: it still reports the "
                f"previous homing (bit 12) at {math.degrees(state.angle_rad):.2f} deg. "
                "Switch the drive off and on, and check that it accepts commands over Modbus",
            )
        return True

    async def _start_homing_again(self, axis: str, start: _HomingStart) -> None:
        """Clear the start bit long enough for the drive to see it, then set it again, as its rise counts."""
        await self._command(axis, "enable")
        await asyncio.sleep(_TAKEN_S)
        await self._command(axis, "home")
        start.last_s = asyncio.get_running_loop().time()

    async def _hail(self, axes: Iterable[str]) -> None:
        """Ask drives for no more than a sign of life from us: each watches for its master's silence by itself."""
        for axis in axes:
            await self._read(axis, "statusword")

    async def jog(self, axis: str, rate_rps: float, acceleration_rps2: float) -> None:
        """Turn an axis at a rate (profile velocity mode) until its next command, with this acceleration on both ramps.

        The limits of the bench file are not checked. DeviceRefused for a value that does not fit its register.
        """
        self._moved = axis
        await self._write(axis, "mode", cia402.MODE_PROFILE_VELOCITY)
        await self._write_motion(axis, "acceleration", acceleration_rps2)
        await self._write_motion(axis, "deceleration", acceleration_rps2)
        await self._write_motion(axis, "target_rate", rate_rps)
        await self._command(axis, "enable")

    async def move(self, axis: str, angle_rad: float, rate_rps: float, acceleration_rps2: float) -> None:
        """Start a move to an angle from home (profile position mode), and wait until the drive has taken the set point.

        ``rate_rps`` is a speed, of which the sign is ignored; the acceleration is that of both ramps; the limits of the
        bench file are not checked. A drive that does not show in 20 ms that it has taken the set point counts as having
        taken it. DeviceRefused for a value that does not fit its register.
        """
        self._moved = axis
        await self._write(axis, "mode", cia402.MODE_PROFILE_POSITION)
        await self._write_motion(axis, "profile_rate", abs(rate_rps))
        await self._write_motion(axis, "acceleration", acceleration_rps2)
        await self._write_motion(axis, "deceleration", acceleration_rps2)
        await self._write_motion(axis, "target_position", angle_rad)
        await self._command(axis, "move_arm")
        await self._wait_for_acknowledgement(axis, set_point_taken=False)
        await self._command(axis, "move_go")
        await self._wait_for_acknowledgement(axis, set_point_taken=True)

    async def _wait_for_acknowledgement(self, axis: str, *, set_point_taken: bool) -> None:
        """Wait until bit 12 shows that a drive has taken (``set_point_taken``) or released a set point, 20 ms at most.

        That it does not show it is no error. A drive acts on the rise of bit 4 of the controlword and must have seen it
        low before; until then, bit 10 belongs to the previous move. A drive that handles bit 12 differently has had a
        cycle all the same.
        """
        loop = asyncio.get_running_loop()
        ends_s = loop.time() + _TAKEN_S
        while bool(int(await self._read(axis, "statusword")) & cia402.BIT_12) is not set_point_taken:
            if loop.time() > ends_s:
                return
            await asyncio.sleep(_TAKEN_S / 10)

    async def read(self, axis: str) -> AxisState:
        """Measure angle and rate; each is stamped with the middle of its own round trip."""
        replies = {name: await self._lines[axis].ask(self._reading(axis, name)) for name in ("position", "rate")}
        angle, rate = (
            (one.sent_s, one.received_s, self._value(axis, name, one) * TURN) for name, one in replies.items()
        )
        return AxisState.told(angle, rate)

    async def orders(self, axis: str) -> dict[str, float]:
        """Read back the drive's last commands by register name; registers that cannot be read are left out."""
        found = {}
        for name in _ORDERS:
            with kept([]):
                found[name] = await self._read(axis, name)
        return found

    async def status(self, axis: str) -> AxisStatus:
        """Read the state of an axis and describe a fault in words.

        Enabled is Operation enabled alone; whether the target is reached is the drive's word (bit 10). Quick stop
        active is no fault but a caution; an internal limit is only named in the text. The interlock is read where the
        profile knows its inputs, except in operation. BadReply for a statusword that is no CiA 402 state.
        """
        word = int(await self._read(axis, "statusword"))
        state = cia402.state_of(word)
        if state is None:
            raise BadReply(self._device, f"axis {axis} has statusword 0x{word:04X}, which is no CiA 402 state")
        return AxisStatus(
            enabled=state is cia402.DriveState.OPERATION_ENABLED,
            target_reached=bool(word & cia402.TARGET_REACHED),
            fault=await self._fault_text(axis, word) if state in _FAULTS else "",
            caution=f"axis {axis} was left in quick stop active, energised and holding. A run clears this state"
            if state is cia402.DriveState.QUICK_STOP_ACTIVE
            else "",
            text=f"{state.text}, internal limit active" if word & cia402.INTERNAL_LIMIT else state.text,
            interlock=INTERLOCK_OPEN if await self._interlock_open(axis, state) else "",
        )

    async def _interlock_open(self, axis: str, state: cia402.DriveState) -> bool:
        """Return whether an input that enables the power stage is off, where the profile knows; not so in operation."""
        register, closed = self._profile.interlock
        asked = register and state is not cia402.DriveState.OPERATION_ENABLED
        return bool(asked) and int(await self._read(axis, register)) != closed

    async def stop(self) -> str:
        """Quick-stop every drive along its ramp, over a new connection if necessary, as ``_rest``; return its words."""
        return await self._rest("quick_stop")

    async def abort(self) -> None:
        """Stop every axis at once by the profile's abort command, as ``stop`` does."""
        await self._rest("abort")

    async def _rest(self, command: str) -> str:
        """Send a stop command to all drives without asking first, wait for rest, and return what was seen.

        An error of one drive does not delay the others. Raises as ``bring_to_rest``.
        """
        return await self._bring_to_rest(partial(self._tell, command), self.read)

    async def _tell(self, command: str, axis: str) -> None:
        """Send a command once, ahead of replies that others wait for, and await its echo; reopen a line that failed.

        The profile's values are written first after a new connection, but their failure does not keep the command back.
        LinkLost if the line cannot be reopened; raises as ``ModbusLine.tell`` for the command itself.
        """
        line = self._lines[axis]
        if not line.sound:
            self._ready -= {other for other in self._axes if self._lines[other] is line}
            await line.open()
        with kept([]):
            await self._make_ready(axis)
        await line.tell(self._writing(axis, "controlword", self._profile.commands[command]))

    async def _clear_fault(self, axis: str) -> None:
        """Send a fault reset and wait for the drive to leave its fault; DeviceFault if it does not within 2 s."""
        await self._write(axis, "controlword", 0)  # the reset acts on a rising edge
        await self._command(axis, "fault_reset")
        try:
            await self._wait_for_state(axis, cia402.DriveState.SWITCH_ON_DISABLED)
        except DeviceRefused:
            raise DeviceFault(
                self._device, f"axis {axis} remains in fault because its cause is still present"
            ) from None

    async def disable(self) -> None:
        """Switch the power of every drive off and check that it is off.

        The first failure is raised after all have been tried: DeviceRefused if a drive stays energised, or what its
        line raised.
        """
        failures: list[DeviceError] = []
        for axis in self._axes:
            with kept(failures):
                await self._leave_quick_stop(axis)
                await self._command(axis, "shutdown")
                state = await self._state(axis)
                if state in (cia402.DriveState.OPERATION_ENABLED, cia402.DriveState.QUICK_STOP_ACTIVE):
                    raise DeviceRefused(self._device, f"axis {axis} stays in {state.text} and is still energised")
        if failures:
            raise failures[0]

    async def _leave_quick_stop(self, axis: str) -> None:
        """Take power off a drive that stays in quick stop, as it does for 605Ah = 5 to 8 (CiA 402 transition 12).

        DeviceRefused if it does not leave quick stop within 2 s; others are left alone.
        """
        if await self._state(axis) is cia402.DriveState.QUICK_STOP_ACTIVE:
            await self._write(axis, "controlword", cia402.DISABLE_VOLTAGE)
            await self._wait_for_state(axis, cia402.DriveState.SWITCH_ON_DISABLED)

    def close(self) -> None:
        """Drop the connection."""
        for line in self._lines.values():
            line.close()

    async def _state(self, axis: str) -> cia402.DriveState | None:
        return cia402.state_of(int(await self._read(axis, "statusword")))

    async def _wait_for_state(self, axis: str, wanted: cia402.DriveState) -> None:
        deadline = asyncio.get_running_loop().time() + _STATE_LIMIT_S
        while (state := await self._state(axis)) is not wanted:
            if asyncio.get_running_loop().time() > deadline:
                now = state.text if state else "no known state"
                raise DeviceRefused(self._device, f"axis {axis} stays in {now} and does not reach {wanted.text}")
            await asyncio.sleep(_POLL_S)

    async def _fault_text(self, axis: str, statusword: int) -> str:
        """Return the state and ``statusword`` of an axis in words, with the drive's error code.

        Without the code if the profile has no register for it, or the drive refuses to read it.
        """
        state = cia402.state_of(statusword)
        text = f"axis {axis} is in {state.text if state else 'no known state'} (statusword 0x{statusword:04X}"
        text += ", internal limit active)" if statusword & cia402.INTERNAL_LIMIT else ")"
        if "error_code" not in self._profile.registers:
            return text
        try:
            code = int(await self._read(axis, "error_code"))
        except DeviceRefused:
            return text  # a firmware that lacks the register
        return f"{text}: {self._profile.error_text(code)}"

    async def _numbers(self, name: str) -> str:
        if name not in self._profile.registers:
            return ""
        return ", ".join([f"{axis} {await self._read(axis, name):.0f}" for axis in self._axes])

    async def _command(self, axis: str, command: str) -> None:
        await self._write(axis, "controlword", self._profile.commands[command])

    async def _write_motion(self, axis: str, register: str, value_rad: float) -> None:
        await self._write(axis, register, value_rad / TURN)

    async def _write(self, axis: str, name: str, value: float) -> None:
        await self._make_ready(axis)
        await self._lines[axis].ask(self._writing(axis, name, value))

    async def _read(self, axis: str, name: str) -> float:
        return self._value(axis, name, await self._lines[axis].ask(self._reading(axis, name)))

    def _value(self, axis: str, name: str, reply: Reply) -> float:
        return self._profile[name].decode(reply.words, self._axes[axis].counts_per_turn)

    def _reading(self, axis: str, name: str) -> Request:
        """Return the request that reads the profile's register ``name`` of an axis; KeyError if there is none."""
        register = self._profile[name]
        return Request(
            axis=axis,
            unit_id=int(self._axes[axis].address),
            register=name,
            address=register.address,
            count=register.words,
        )

    def _writing(self, axis: str, name: str, value: float) -> Request:
        """Return the request that writes ``value`` to the profile's register ``name``; DeviceRefused if it does not
        fit.
        """
        drive, register = self._axes[axis], self._profile[name]
        try:
            words = register.encode(value, drive.counts_per_turn)
        except ValueError as error:
            raise DeviceRefused(self._device, f"axis {axis}: {error}") from None
        return Request(
            axis=axis,
            unit_id=int(drive.address),
            register=name,
            address=register.address,
            count=len(words),
            words=tuple(words),
        )
