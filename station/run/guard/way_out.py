"""The way out of a run: every device that has to be left in a safe state, the table first."""

from collections.abc import Callable
from typing import Any

from drivers.kind import SafeState
from station.opening import OpenBench, OpenDevice
from station.run.snapshot import EventKind


class WayOut:
    """Makes the devices of one run safe, each once, even if that is interrupted and called again."""

    def __init__(self, opened: OpenBench, time_scale: float, tell: Callable[[EventKind, str], Any]) -> None:
        """``time_scale`` is how fast the clock runs; ``tell`` records events."""
        self._open, self._time_scale, self._tell = opened, time_scale, tell
        self._done: set[str] = set()
        self._troubles: list[str] = []

    async def go(self, *, untrue_readings: bool) -> list[str]:
        """Make safe all devices that are not yet, in their order; return the troubles so far, in words.

        Each that is seen to be safe is told as an event. With ``untrue_readings`` nothing that the table reports of its
        stop is believed. An exception of the table's driver is raised; then it can be called again.
        """
        for device in self._open.in_safe_order():
            if device.name in self._done:
                continue
            is_table = device.driver is self._open.table
            state = await self._made_safe(device, is_table=is_table, untrue_readings=is_table and untrue_readings)
            self._done.add(device.name)
            if state.trouble:
                self._troubles.append(state.trouble)
            if is_table and state.seen:
                self._tell(EventKind.AT_REST, "table at rest")
            elif state.seen:
                self._tell(EventKind.NOTE, f"{device.name}: {device.config.kind.made_safe}")
        return list(self._troubles)

    async def _made_safe(self, device: OpenDevice, *, is_table: bool, untrue_readings: bool) -> SafeState:
        """Make one device safe, and return its state and trouble; attempts that were not confirmed are reported.

        An exception of a driver becomes a trouble, except that of the table, which is raised. ``untrue_readings`` says
        that readings of the table cannot be believed.
        """

        def unconfirmed(trouble: str) -> None:
            if is_table:
                self._tell(EventKind.NOT_AT_REST, f"controlled stop not confirmed: {trouble}")
            else:
                self._tell(EventKind.NOTE, f"{device.name} is not seen to be safe, it is told again: {trouble}")

        try:
            return await device.config.kind.make_safe(
                device.driver,
                time_scale=self._time_scale,
                unconfirmed=unconfirmed,
                untrue_readings=untrue_readings,
            )
        except Exception as error:
            if is_table:  # it is tried again
                raise
            defect = f"{device.name}: defect of its driver ({type(error).__name__}: {error})"
            return SafeState(trouble=defect, seen=False)
