"""A turntable of CiA 402 servo drives on Modbus: one drive an axis, told apart by unit id."""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from pymodbus.client import AsyncModbusTcpClient
from pymodbus.exceptions import ModbusException

from drivers.cia402 import (
    BIT_12,
    BIT_13,
    MODE_HOMING,
    MODE_PROFILE_POSITION,
    MODE_PROFILE_VELOCITY,
    TARGET_REACHED,
    DriveState,
    state_of,
)
from drivers.errors import BadReply, DeviceFault, DeviceRefused, LinkLost
from drivers.registers import DriveProfile, Register
from drivers.seams import AxisLimits, AxisState, AxisStatus

# pymodbus dumps its recent frames at ERROR for every time-out; the station says it in one line of its own.
logging.getLogger("pymodbus").setLevel(logging.CRITICAL)

TURN = 2 * math.pi
_POLL_S = 0.02
_STATE_LIMIT_S = 2.0
_HOMING_RATE_RPS = math.radians(30.0)
_HOMING_LIMIT_S = 60.0
_STOP_LIMIT_S = 10.0
_AT_REST_RPS = math.radians(0.02)

_EXCEPTIONS = {
    1: "illegal function",
    2: "illegal register address",
    3: "illegal value",
    4: "device failure",
    5: "acknowledge, still busy",
    6: "device busy",
    10: "gateway path unavailable",
    11: "gateway target does not answer",
}


@dataclass(frozen=True, slots=True)
class DriveAxis:
    """One drive: its unit id on the bus, counts of its encoder per turn of the axis, and its limits."""

    unit_id: int
    counts_per_turn: int
    limits: AxisLimits


class ModbusTable:
    """Turntable driver over a stock pymodbus client."""

    def __init__(
        self,
        device: str,
        address: tuple[str, int],
        profile: DriveProfile,
        axes: Mapping[str, DriveAxis],
        timeout_s: float,
        *,
        client: Callable[..., Any] = AsyncModbusTcpClient,
    ) -> None:
        """Name the peer; it is connected by ``open``. A request is tried twice, each for ``timeout_s``."""
        self._device, self._address, self._profile = device, address, profile
        self._axes = dict(axes)
        self._timeout_s = timeout_s
        self._make_client = client
        self._client: Any = None

    @property
    def limits(self) -> Mapping[str, AxisLimits]:
        """Limits by axis."""
        return {name: axis.limits for name, axis in self._axes.items()}

    async def open(self) -> None:
        """Connect and read every drive's statusword; LinkLost if one does not answer."""
        host, port = self._address
        self._client = self._make_client(
            host, port=port, timeout=self._timeout_s, retries=1, reconnect_delay=0, name=self._device
        )
        if not await self._client.connect():
            raise LinkLost(
                self._device,
                f"nothing answers at {host}:{port}; is the table's controller on, and the address right?",
            )
        for axis in self._axes:
            await self.status(axis)

    async def enable(self) -> None:
        """Walk every drive to Operation enabled; DeviceFault if it is in fault, DeviceRefused if it stays."""
        for axis in self._axes:
            status = await self.status(axis)
            if status.fault:
                raise DeviceFault(self._device, f"{status.fault}; clear its cause, then start with --reset-fault")
            steps = (
                ("shutdown", DriveState.READY_TO_SWITCH_ON),
                ("switch_on", DriveState.SWITCHED_ON),
                ("enable", DriveState.OPERATION_ENABLED),
            )
            for command, state in steps:
                if await self._state(axis) is DriveState.OPERATION_ENABLED:
                    break
                await self._command(axis, command)
                await self._wait_for_state(axis, state)

    async def home(self) -> None:
        """Run the drives' own homing on all axes at once; DeviceRefused if one does not end."""
        for axis in self._axes:
            await self._write(axis, "mode", MODE_HOMING)
            await self._write(axis, "homing_method", self._profile.homing_method)
            await self._write_motion(axis, "homing_rate_1", _HOMING_RATE_RPS)
            await self._write_motion(axis, "homing_rate_2", _HOMING_RATE_RPS / 4)
            await self._command(axis, "enable")
            await self._command(axis, "home")
        deadline = asyncio.get_running_loop().time() + _HOMING_LIMIT_S
        waiting = set(self._axes)
        while waiting:
            for axis in self._axes:  # also those at home: each drive watches for its master's silence by itself
                word = int(await self._read(axis, "statusword"))
                self._check_fault(axis, word)
                if axis not in waiting:
                    continue
                if word & BIT_13:
                    raise DeviceRefused(self._device, f"axis {axis} reports a homing error")
                if word & BIT_12 and word & TARGET_REACHED:
                    waiting.discard(axis)
                    await self._command(axis, "enable")  # takes the start bit back
            if waiting and asyncio.get_running_loop().time() > deadline:
                raise DeviceRefused(
                    self._device, f"axis {', '.join(sorted(waiting))} found no home within {_HOMING_LIMIT_S:.0f} s"
                )
            await asyncio.sleep(_POLL_S)

    async def jog(self, axis: str, rate_rps: float, acceleration_rps2: float) -> None:
        """Turn an axis at a rate (profile-velocity mode) until told otherwise."""
        await self._write(axis, "mode", MODE_PROFILE_VELOCITY)
        await self._write_motion(axis, "acceleration", acceleration_rps2)
        await self._write_motion(axis, "deceleration", acceleration_rps2)
        await self._write_motion(axis, "target_rate", rate_rps)
        await self._command(axis, "enable")

    async def move(self, axis: str, angle_rad: float, rate_rps: float, acceleration_rps2: float) -> None:
        """Start a move to an angle from home (profile-position mode)."""
        await self._write(axis, "mode", MODE_PROFILE_POSITION)
        await self._write_motion(axis, "profile_rate", abs(rate_rps))
        await self._write_motion(axis, "acceleration", acceleration_rps2)
        await self._write_motion(axis, "deceleration", acceleration_rps2)
        await self._write_motion(axis, "target_position", angle_rad)
        await self._command(axis, "move_arm")
        await self._command(axis, "move_go")

    async def read(self, axis: str) -> AxisState:
        """Measure angle and rate; each is stamped with the middle of its own round trip."""
        loop = asyncio.get_running_loop()
        t0 = loop.time()
        turns = await self._read(axis, "position")
        t1 = loop.time()
        turns_per_s = await self._read(axis, "rate")
        t2 = loop.time()
        half_width = max(t1 - t0, t2 - t1) / 2
        return AxisState(
            round((t0 + t1) / 2 * 1e9),
            turns * TURN,
            round((t1 + t2) / 2 * 1e9),
            turns_per_s * TURN,
            round(half_width * 1e9),
        )

    async def status(self, axis: str) -> AxisStatus:
        """Get state, target reached, and the fault in words."""
        word = int(await self._read(axis, "statusword"))
        state = state_of(word)
        fault = ""
        if state in (DriveState.FAULT, DriveState.FAULT_REACTION):
            fault = f"axis {axis} is in {state.text} (statusword 0x{word:04X})"
        elif state is None:
            raise BadReply(self._device, f"axis {axis} has statusword 0x{word:04X}, which is no CiA 402 state")
        return AxisStatus(
            enabled=state is DriveState.OPERATION_ENABLED,
            target_reached=bool(word & TARGET_REACHED),
            fault=fault,
            text=state.text,
        )

    async def stop(self) -> None:
        """Quick-stop every drive along its ramp and wait until all are at rest.

        All are told before any is waited for. What one drive answers does not keep the others from being
        told; the first failure is raised at the end.
        """
        failure: Exception | None = None
        for axis in self._axes:
            try:
                if await self._state(axis) is DriveState.OPERATION_ENABLED:
                    await self._command(axis, "quick_stop")
            except (LinkLost, BadReply, DeviceRefused) as error:
                failure = failure or error
        deadline = asyncio.get_running_loop().time() + _STOP_LIMIT_S
        for axis in self._axes:
            try:
                while abs(await self._read(axis, "rate")) * TURN > _AT_REST_RPS:
                    if asyncio.get_running_loop().time() > deadline:
                        raise DeviceRefused(self._device, f"axis {axis} keeps turning after quick stop: cut its power")
                    await asyncio.sleep(_POLL_S)
            except (LinkLost, BadReply, DeviceRefused) as error:
                failure = failure or error
        if failure is not None:
            raise failure

    async def reset_fault(self) -> None:
        """Clear the fault of every drive that has one; DeviceFault if one stays."""
        for axis in self._axes:
            if not (await self.status(axis)).fault:
                continue
            await self._write(axis, "controlword", 0)  # the reset acts on a rising edge
            await self._command(axis, "fault_reset")
            try:
                await self._wait_for_state(axis, DriveState.SWITCH_ON_DISABLED)
            except DeviceRefused:
                raise DeviceFault(self._device, f"axis {axis} stays in fault: its cause is still there") from None

    async def disable(self) -> None:
        """Take power off every drive."""
        for axis in self._axes:
            await self._command(axis, "shutdown")

    def close(self) -> None:
        """Drop the connection."""
        if self._client is not None:
            self._client.close()
            self._client = None

    async def _state(self, axis: str) -> DriveState | None:
        return state_of(int(await self._read(axis, "statusword")))

    async def _wait_for_state(self, axis: str, wanted: DriveState) -> None:
        deadline = asyncio.get_running_loop().time() + _STATE_LIMIT_S
        while (state := await self._state(axis)) is not wanted:
            if asyncio.get_running_loop().time() > deadline:
                now = state.text if state else "no known state"
                raise DeviceRefused(self._device, f"axis {axis} stays in {now} and does not reach {wanted.text}")
            await asyncio.sleep(_POLL_S)

    def _check_fault(self, axis: str, statusword: int) -> None:
        if state_of(statusword) in (DriveState.FAULT, DriveState.FAULT_REACTION):
            raise DeviceFault(self._device, f"axis {axis} is in fault (statusword 0x{statusword:04X})")

    async def _command(self, axis: str, command: str) -> None:
        await self._write(axis, "controlword", self._profile.commands[command])

    async def _write_motion(self, axis: str, register: str, value_rad: float) -> None:
        await self._write(axis, register, value_rad / TURN)

    async def _write(self, axis: str, name: str, value: float) -> None:
        drive, register = self._axes[axis], self._profile[name]
        try:
            words = register.encode(value, drive.counts_per_turn)
        except ValueError as error:
            raise DeviceRefused(self._device, f"axis {axis}: {error}") from None
        if len(words) == 1:
            await self._call(axis, register, "write_register", value=words[0])
        else:
            await self._call(axis, register, "write_registers", values=words)

    async def _read(self, axis: str, name: str) -> float:
        register = self._profile[name]
        reply = await self._call(axis, register, "read_holding_registers", count=register.words)
        if len(reply.registers) != register.words:
            raise BadReply(self._device, f"axis {axis}: {len(reply.registers)} words for {name}")
        return register.decode(reply.registers, self._axes[axis].counts_per_turn)

    async def _call(self, axis: str, register: Register, function: str, **arguments: Any) -> Any:
        unit_id = self._axes[axis].unit_id
        if self._client is None or not self._client.connected:
            raise LinkLost(self._device, f"the connection to {self._address[0]}:{self._address[1]} is gone")
        task = asyncio.current_task()
        cancels = task.cancelling() if task else 0
        try:
            reply = await getattr(self._client, function)(register.address, device_id=unit_id, **arguments)
        except ModbusException as error:
            raise LinkLost(
                self._device,
                f"axis {axis} (unit id {unit_id}) does not answer within {2 * self._timeout_s:g} s, twice asked "
                f"({_brief(error)})",
            ) from None
        if task is not None and task.cancelling() > cancels:
            # asyncio.wait_for of Python 3.11, within pymodbus, forgets a cancel that comes together with the reply.
            raise asyncio.CancelledError
        if reply.isError():
            code = int(getattr(reply, "exception_code", 0))
            meaning = _EXCEPTIONS.get(code, "unknown exception")
            raise DeviceRefused(
                self._device,
                f"axis {axis} (unit id {unit_id}) refuses {function.replace('_', ' ')} at 0x{register.address:04X} "
                f"({register.name}): Modbus exception {code}, {meaning}",
            )
        return reply


def _brief(error: Exception) -> str:
    return str(error).removeprefix("Modbus Error: ").split(", continue")[0]
