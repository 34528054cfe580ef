"""A link that counts its traffic."""

from typing import Any

from drivers.types import ByteChunk, Frame, LinkCounts


class CountedLink:
    """A link to bytes or CAN frames: the one place where its traffic is counted."""

    def __init__(self, link: Any) -> None:
        """Put counts on a link that is not open yet, or take its own."""
        self._link, self.counts = link, getattr(link, "counts", LinkCounts())

    async def open(self) -> None:
        """Open it; LinkLost if there is none."""
        await self._link.open()
        self.counts.opened += 1

    async def receive(self) -> Any:
        """Return the next bytes or frames, and count them; LinkLost when the other end is gone."""
        found = await self._link.receive()
        self.counts.received += len(found.data if isinstance(found, ByteChunk) else found)
        return found

    def write(self, data: bytes) -> None:
        """Send bytes."""
        self._link.write(data)
        self.counts.sent += len(data)

    def send(self, frame: Frame) -> None:
        """Send a frame."""
        self._link.send(frame)
        self.counts.sent += 1

    def __getattr__(self, name: str) -> Any:
        return getattr(self._link, name)
