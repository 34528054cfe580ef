"""A CAN bus through python-can, with any of its interfaces."""

from __future__ import annotations

import asyncio
import time
from typing import Any

import can

from drivers.can_memory import MemoryBus
from drivers.errors import LinkLost
from drivers.seams import Frame

# Interfaces whose stamps are the host's time of day, taken before the loop gets to see the frame.
_STAMPED_BY_WALL_CLOCK = ("socketcan", "udp_multicast", "slcan")
_OLDEST_S = 1.0


class CanLink:
    """Frames of one bus, stamped on arrival.

    Buses with a file descriptor (socketcan, slcan, udp_multicast) are read by the loop, others by python-can's
    own thread. Interface "memory" is the bus within this loop.
    """

    def __init__(self, device: str, interface: str, channel: str, options: dict[str, Any]) -> None:
        """Name the bus in python-can's terms; it is opened by ``open``."""
        self._device, self._interface, self._channel = device, interface, channel
        self._options = options
        self._bus: can.BusABC | None = None
        self._notifier: can.Notifier | None = None
        self._frames: list[Frame] = []
        self._wake = asyncio.Event()
        self._ended = ""

    async def open(self) -> None:
        """Open the bus; LinkLost if python-can cannot."""
        if self._interface == "memory":
            self._bus = MemoryBus(self._channel, self.take)
            return
        try:
            self._bus = can.Bus(interface=self._interface, channel=self._channel, **self._options)
        except (can.CanError, OSError, ValueError, TypeError, ImportError) as error:
            raise LinkLost(self._device, f"cannot open CAN bus {self._interface}:{self._channel} ({error})") from None
        self._notifier = can.Notifier(self._bus, [_Listener(self)], loop=asyncio.get_running_loop())

    async def receive(self) -> list[Frame]:
        """Return the frames since the last call, waiting for the first; LinkLost when the bus is gone."""
        while not self._frames:
            if self._ended:
                raise LinkLost(self._device, self._ended)
            self._wake.clear()
            await self._wake.wait()
        frames, self._frames = self._frames, []
        return frames

    def take(self, message: can.Message) -> None:
        """Keep one frame, stamped now; error and remote frames carry no data."""
        if message.is_error_frame or message.is_remote_frame:
            return
        loop = asyncio.get_running_loop()
        arrival_s = loop.time() - self._age_s(message) * getattr(loop, "scale", 1.0)
        self._frames.append(
            Frame(round(arrival_s * 1e9), message.arbitration_id, message.is_extended_id, bytes(message.data))
        )
        self._wake.set()

    def _age_s(self, message: can.Message) -> float:
        """Return how long ago a frame came in, by the wall's clock, where the driver or kernel stamps with it."""
        if self._interface not in _STAMPED_BY_WALL_CLOCK:
            return 0.0
        return min(max(time.time() - message.timestamp, 0.0), _OLDEST_S)

    def end(self, reason: str) -> None:
        """Let the reader know that the bus is gone."""
        self._ended = reason
        self._wake.set()

    def close(self) -> None:
        """Leave the bus."""
        if self._notifier is not None:
            self._notifier.stop(0.5)
            self._notifier = None
        if self._bus is not None:
            self._bus.shutdown()
            self._bus = None


class _Listener(can.Listener):
    def __init__(self, link: CanLink) -> None:
        self._link = link

    def on_message_received(self, msg: can.Message) -> None:
        self._link.take(msg)

    def on_error(self, exc: Exception) -> None:
        self._link.end(f"the CAN bus failed ({exc})")
