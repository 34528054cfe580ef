"""Chunks that have arrived on a byte link and wait to be taken."""

import asyncio
from collections import deque

from drivers.errors import LinkLost
from drivers.types import ByteChunk

_MOST_BYTES = 1 << 22  # half a minute of the fastest serial line


class Inbox:
    """Queue of received chunks and the end of the link. When too much waits, the oldest chunks are dropped."""

    def __init__(self, device: str) -> None:
        """Start empty and open."""
        self._device = device
        self._chunks: deque[ByteChunk] = deque()
        self._bytes = 0
        self._wake = asyncio.Event()
        self.ended = ""
        """Why nothing more will come; empty while it may."""

    def begin(self) -> None:
        """Drop all chunks, for a link that is opened again."""
        self._chunks.clear()
        self._bytes = 0
        self.ended = ""

    def put(self, chunk: ByteChunk) -> None:
        """Append a chunk; ignored after the end of the link. Beyond ``_MOST_BYTES`` the oldest chunks are dropped."""
        if self.ended:
            return
        self._chunks.append(chunk)
        self._bytes += len(chunk.data)
        while self._bytes > _MOST_BYTES:
            self._bytes -= len(self._chunks.popleft().data)
        self._wake.set()

    def end(self, reason: str) -> None:
        """Let no more come, for the first reason given."""
        self.ended = self.ended or reason
        self._wake.set()

    def fail(self, reason: str) -> None:
        """End, and raise LinkLost."""
        self.end(reason)
        raise LinkLost(self._device, reason)

    async def get(self) -> ByteChunk:
        """Return the next chunk, waiting for it; LinkLost once the link has ended and no chunk is left."""
        while not self._chunks:
            if self.ended:
                raise LinkLost(self._device, self.ended)
            self._wake.clear()
            await self._wake.wait()
        chunk = self._chunks.popleft()
        self._bytes -= len(chunk.data)
        return chunk
