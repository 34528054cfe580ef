"""A wire in memory: two ends in one event loop, without thread or socket, for virtual time too."""

import asyncio
from collections.abc import Callable

from drivers.links.inbox import Inbox
from drivers.types import ByteChunk


class MemoryLink:
    """One end of a wire in memory; bytes written at one end arrive at the other at the same instant.

    Bytes are lost without an error while the wire is unplugged or either end is closed, as on a cable; ``receive`` then
    raises LinkLost at that end.
    """

    def __init__(self, device: str, send: Callable[[bytes], None] | None = None) -> None:
        """Create an end that sends its bytes to ``send`` and gets those passed to ``deliver``."""
        self._device = device
        self._inbox = Inbox(device)
        self._send = send
        self._unplugged = ""
        self._closed = False

    async def open(self) -> None:
        """Open this end, also after ``close``; LinkLost while the wire is unplugged."""
        self._inbox.begin()
        self._closed = False
        if self._unplugged:
            self._inbox.fail(self._unplugged)

    async def receive(self) -> ByteChunk:
        """Return the next bytes; LinkLost when the wire is unplugged or the other end has closed."""
        return await self._inbox.get()

    def write(self, data: bytes) -> None:
        """Send bytes to the other end."""
        if self._send is not None and not self._closed and not self._unplugged:
            self._send(data)

    def deliver(self, data: bytes) -> None:
        """Let bytes arrive at this end."""
        if not self._closed and not self._unplugged:
            self._inbox.put(ByteChunk(round(asyncio.get_running_loop().time() * 1e9), data))

    def unplug(self, reason: str = "the wire was unplugged") -> None:
        """Break the wire at this end."""
        self._unplugged = reason
        self._inbox.end(reason)

    def plug(self) -> None:
        """Mend the wire; it has to be opened again."""
        self._unplugged = ""

    def close(self) -> None:
        """Let go of this end; twice is once."""
        self._closed = True
        self._inbox.end("the link was closed")
