"""A python-can bus within one loop: frames arrive by a call, without the thread that python-can's own needs."""

from collections.abc import Callable
from typing import Any

import can


class MemoryBus(can.BusABC):
    """One node of a bus in memory; ``on_message`` is called for each frame of the others."""

    _buses: "dict[str, list[MemoryBus]]" = {}  # noqa: RUF012  # nodes find each other by channel, within a process

    def __init__(self, channel: str, on_message: Callable[[can.Message], None] | None = None) -> None:
        """Join the bus of this name."""
        super().__init__(channel)
        self.channel_info = f"memory bus {channel}"
        self._channel, self._on_message = channel, on_message
        self._buses.setdefault(channel, []).append(self)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Hand a frame to all other nodes; it must not be changed afterwards."""
        for bus in self._buses[self._channel]:
            if bus is not self and bus._on_message is not None:
                bus._on_message(msg)

    def shutdown(self) -> None:
        """Leave the bus."""
        nodes: list[Any] = self._buses.get(self._channel, [])
        if self in nodes:
            nodes.remove(self)
        super().shutdown()
