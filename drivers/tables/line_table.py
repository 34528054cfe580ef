"""What drivers of tables have in common."""

import asyncio
from collections.abc import Awaitable, Callable, Mapping, Sequence

from drivers.errors import DeviceRefused
from drivers.protocols import ByteLink
from drivers.requests.exchange import Exchange, Framing
from drivers.tables.halting import bring_to_rest
from drivers.types import AxisLimits, AxisState

_HOMING_LIMIT_S = 60.0


class LineTable:
    """A table whose controller speaks lines of text."""

    def __init__(
        self, device: str, link: ByteLink, framing: Framing, timeout_s: float, limits: Mapping[str, AxisLimits]
    ) -> None:
        """A request is tried twice, each for ``timeout_s``; ``limits`` are by axis."""
        self._device, self.limits, self._timeout_s = device, limits, timeout_s
        self._moved = ""  # the axis that was told last to move
        self.homing: set[str] = set()
        self._exchange = Exchange(device, link, framing, timeout_s)
        self.counts = self._exchange.counts
        """Counts of what went wrong on the link."""

    async def _rest(
        self,
        lines: Callable[[str], Sequence[str]],
        read: Callable[[str], Awaitable[AxisState]],
        idle: Callable[[str], Awaitable[bool]] | None = None,
    ) -> str:
        """Bring all axes to rest by the lines that stop one, and return what was seen (``bring_to_rest``)."""
        axes = sorted(self.limits, key=lambda axis: axis != self._moved)

        return await bring_to_rest(
            self._device, axes, lambda axis: self._exchange.tell_all(lines(axis)), read, self._timeout_s, idle
        )

    def close(self) -> None:
        """Drop the link."""
        self._exchange.close()

    async def _wait_for_home(self, at_home: Callable[[str], Awaitable[bool]], poll_s: float) -> None:
        """Ask the axes until all are at home; after a minute ``_give_up_homing`` and DeviceRefused."""
        loop = asyncio.get_running_loop()
        deadline = loop.time() + _HOMING_LIMIT_S
        while self.homing:
            for axis in sorted(self.homing):
                if await at_home(axis):
                    self.homing.discard(axis)
            if self.homing and loop.time() > deadline:
                await self._give_up_homing()
                said = f"axis {', '.join(sorted(self.homing))} found no home within {_HOMING_LIMIT_S:.0f} s"
                raise DeviceRefused(self._device, said)
            await asyncio.sleep(poll_s)

    async def _give_up_homing(self) -> None:
        """End a homing that the controller does by itself."""
