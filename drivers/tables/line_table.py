"""Common parts of drivers for tables whose controllers use lines of text."""

import math
import re
from collections.abc import Awaitable, Callable, Sequence

from drivers.errors import DeviceRefused
from drivers.protocols import ByteLink
from drivers.requests.exchange import Answer, Exchange, Framing
from drivers.specs import TableSetup
from drivers.tables.base import Table
from drivers.tables.unwrap import Unwrapper
from drivers.types import AxisState


class LineTable(Table):
    """A table whose controller accepts lines of text."""

    _done = re.compile("")
    """What a command is answered with that is carried out."""

    def __init__(self, setup: TableSetup, link: ByteLink, framing: Framing) -> None:
        """Take the bench's settings, a link that is not open yet, and the framing of requests and answers."""
        super().__init__("table", {name: axis.limits for name, axis in setup.axes.items()}, setup.timeout_s)
        self._exchange = Exchange(self._device, link, framing, setup.timeout_s)
        self.counts = self._exchange.counts
        """Counts of what went wrong on the link."""

    def close(self) -> None:
        """Drop the link."""
        self._exchange.close()

    async def _rest(
        self,
        lines: Callable[[str], Sequence[str]],
        read: Callable[[str], Awaitable[AxisState]],
        idle: Callable[[str], Awaitable[bool]] | None = None,
    ) -> str:
        """Stop all axes, each with the lines that ``lines(axis)`` returns, and return in words what was seen.

        The lines are sent as by ``Exchange.tell_all``, without waiting for answers. ``read(axis)`` and ``idle(axis)``,
        and what is raised: see ``bring_to_rest``.
        """
        return await self._bring_to_rest(lambda axis: self._exchange.tell_all(lines(axis)), read, idle)

    async def _tell(self, line: str) -> None:
        """Send a command that answers nothing but that it is done; DeviceRefused if it is refused."""
        await self._ask(line, self._done)

    async def _ask(self, line: str, pattern: re.Pattern[str]) -> Answer:
        answer = await self._exchange.ask(line, pattern)
        if answer.refused:
            raise await self._refusal(line, answer)
        return answer

    async def _refusal(self, line: str, answer: Answer) -> DeviceRefused:
        """Return why a line was refused."""
        raise NotImplementedError


def unwrapped(unwrapper: Unwrapper, position: tuple[Answer, float], rate: tuple[Answer, float]) -> AxisState:
    """Return the state of two answers, each with its number in deg or deg/s; the angle is counted on over the turns."""
    (at, angle_deg), (turns, rate_dps) = position, rate
    angle_deg = unwrapper.place((at.sent_s + at.received_s) / 2, angle_deg, rate_dps)
    return AxisState.told(
        (at.sent_s, at.received_s, math.radians(angle_deg)), (turns.sent_s, turns.received_s, math.radians(rate_dps))
    )
