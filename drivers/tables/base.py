"""What drivers of tables have in common, whatever their controllers speak."""

from collections.abc import Awaitable, Callable, Mapping

from drivers.errors import DeviceFault
from drivers.tables.halting import bring_to_rest
from drivers.types import AxisLimits, AxisState, AxisStatus


class Table:
    """Axes with their limits, and the steps that every controller takes alike."""

    def __init__(self, device: str, limits: Mapping[str, AxisLimits], timeout_s: float) -> None:
        """``limits`` are by axis; a request is tried twice, each for ``timeout_s``."""
        self._device, self.limits, self._timeout_s = device, limits, timeout_s
        self._moved = ""  # the axis that was told last to move
        self.homing: set[str] = set()  # axes that were sent home and are not there yet

    async def status(self, axis: str) -> AxisStatus:
        """Get condition, and the fault in words."""
        raise NotImplementedError

    async def reset_fault(self) -> None:
        """Clear the fault of every axis that has one; DeviceFault if one stays."""
        for axis in self.limits:
            if not (await self.status(axis)).fault:
                continue
            await self._clear_fault(axis)
            if fault := (await self.status(axis)).fault:
                raise DeviceFault(self._device, f"{fault}; it stays after a reset, its cause is still there")

    async def _clear_fault(self, axis: str) -> None:
        raise NotImplementedError

    async def _sound(self, axis: str) -> AxisStatus:
        """Return the status of an axis that is to be enabled; DeviceFault if it is in fault."""
        status = await self.status(axis)
        if status.fault:
            raise DeviceFault(self._device, f"{status.fault}; clear its cause, then start with --reset-fault")
        return status

    async def _at_home(self, axis: str) -> bool:
        """Return whether an axis that was sent home is there; DeviceFault if it is in fault."""
        status = await self.status(axis)
        if status.fault:
            raise DeviceFault(self._device, status.fault)
        return status.target_reached

    async def _bring_to_rest(
        self,
        tell: Callable[[str], Awaitable[None]],
        read: Callable[[str], Awaitable[AxisState]],
        idle: Callable[[str], Awaitable[bool]] | None = None,
    ) -> str:
        """Tell each axis to stop, the one that was moved last first, and return what was seen."""
        axes = sorted(self.limits, key=lambda axis: axis != self._moved)
        return await bring_to_rest(self._device, axes, tell, read, self._timeout_s, idle)
