"""Common parts of table drivers, for any language of the controller."""

import asyncio
from collections.abc import Awaitable, Callable, Mapping

from drivers.errors import DeviceFault, DeviceRefused
from drivers.tables.halting import bring_to_rest
from drivers.types import AxisLimits, AxisState, AxisStatus

INTERLOCK_OPEN = "interlock open, or emergency stop pressed: close it"
_HOMING_LIMIT_S = 60.0


class Table:
    """Axes with their limits, and the procedures that all controllers share."""

    def __init__(self, device: str, limits: Mapping[str, AxisLimits], timeout_s: float) -> None:
        """``limits`` are by axis; a request is tried twice, each for ``timeout_s``."""
        self._device, self.limits, self._timeout_s = device, limits, timeout_s
        self._moved = ""  # the axis of the last motion command
        self.homing: set[str] = set()  # axes that were sent home and are not there yet

    async def status(self, axis: str) -> AxisStatus:
        """Get condition, and the fault in words."""
        raise NotImplementedError

    async def reset_fault(self) -> None:
        """Clear the fault of every axis that has one.

        DeviceFault at the first axis that has a fault or an open interlock afterwards; the next ones are left then.
        """
        for axis in self.limits:
            if not (await self.status(axis)).fault:
                continue
            await self._clear_fault(axis)
            if trouble := (await self.status(axis)).trouble:
                raise DeviceFault(self._device, f"{trouble}; a reset does not clear it, so its cause is still present")

    async def _clear_fault(self, axis: str) -> None:
        raise NotImplementedError

    async def _sound(self, axis: str) -> AxisStatus:
        """Return the status of an axis that is to be enabled; DeviceFault in a fault or interlock."""
        status = await self.status(axis)
        if status.trouble:
            raise DeviceFault(self._device, f"{status.trouble}; clear the cause, then start with --reset-fault")
        return status

    async def _at_home(self, axis: str) -> bool:
        """Return whether an axis that was sent home has arrived; DeviceFault if it is in fault."""
        status = await self.status(axis)
        if status.trouble:
            raise DeviceFault(self._device, status.trouble)
        return status.target_reached

    async def _wait_for_home(self, poll_s: float) -> None:
        """Poll all axes every ``poll_s``, also those at home, until each is; ``homing`` has those that are not yet.

        After a minute ``_give_up_homing`` is called, and DeviceRefused raised, naming the axes that are not home.
        Raises as ``_at_home`` before.
        """
        loop = asyncio.get_running_loop()
        deadline = loop.time() + _HOMING_LIMIT_S
        while self.homing:
            for axis in self.limits:  # also those at home: one may trip, and may watch for its master's silence
                if await self._at_home(axis):
                    self.homing.discard(axis)
            if self.homing and loop.time() > deadline:
                await self._give_up_homing()
                reason = f"axis {', '.join(sorted(self.homing))} did not complete homing within {_HOMING_LIMIT_S:.0f} s"
                raise DeviceRefused(self._device, reason)
            await asyncio.sleep(poll_s)

    async def _give_up_homing(self) -> None:
        """End a homing that the controller does by itself."""

    async def _bring_to_rest(
        self,
        tell: Callable[[str], Awaitable[None]],
        read: Callable[[str], Awaitable[AxisState]],
        idle: Callable[[str], Awaitable[bool]] | None = None,
    ) -> str:
        """Stop all axes, the one moved last first, wait until they stand, and return in words what was seen.

        ``tell(axis)`` sends the stop, ``read(axis)`` reads the axis, ``idle(axis)`` is true if the controller carries
        out no motion of it; see ``bring_to_rest``, also for what is raised.
        """
        axes = sorted(self.limits, key=lambda axis: axis != self._moved)
        return await bring_to_rest(self._device, axes, tell, read, self._timeout_s, idle)
