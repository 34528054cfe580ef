"""Byte links: a serial port or pseudo-terminal (pyserial), a TCP stream, and a pair joined in memory."""

from __future__ import annotations

import asyncio
import threading
from collections import deque
from typing import Any

from drivers.errors import LinkLost
from drivers.seams import ByteChunk

_READ_LIMIT = 65536


class _Inbox:
    """Chunks that have arrived, and the end of the link."""

    def __init__(self, device: str) -> None:
        self._device = device
        self._chunks: deque[ByteChunk] = deque()
        self._wake = asyncio.Event()
        self._ended = ""

    def put(self, chunk: ByteChunk) -> None:
        self._chunks.append(chunk)
        self._wake.set()

    def end(self, reason: str) -> None:
        self._ended = reason
        self._wake.set()

    async def get(self) -> ByteChunk:
        while not self._chunks:
            if self._ended:
                raise LinkLost(self._device, self._ended)
            self._wake.clear()
            await self._wake.wait()
        return self._chunks.popleft()


class MemoryLink:
    """One end of a wire in memory; bytes written at one end arrive at the other in the same instant."""

    def __init__(self, device: str) -> None:
        """Make an end that is joined to nothing yet."""
        self._inbox = _Inbox(device)
        self._other: MemoryLink | None = None

    @classmethod
    def pair(cls, device: str) -> tuple[MemoryLink, MemoryLink]:
        """Return the two ends of a wire; must be called within a running loop."""
        near, far = cls(device), cls(device)
        near._other, far._other = far, near
        return near, far

    async def open(self) -> None:
        """Nothing to open."""

    async def receive(self) -> ByteChunk:
        """Return the next bytes; LinkLost when the other end has closed."""
        return await self._inbox.get()

    def write(self, data: bytes) -> None:
        """Send bytes to the other end."""
        if self._other is not None:
            now_ns = round(asyncio.get_running_loop().time() * 1e9)
            self._other._inbox.put(ByteChunk(now_ns, data))

    def close(self) -> None:
        """End the wire for both."""
        other, self._other = self._other, None
        if other is not None:
            other._inbox.end("the wire was unplugged")
            other.close()


class SerialLink:
    """A serial port through pyserial, read by a thread of its own so that stamps do not wait for the loop."""

    def __init__(self, device: str, port: str, baud: int) -> None:
        """Name the port; it is opened by ``open``."""
        self._device, self._port_name, self._baud = device, port, baud
        self._inbox = _Inbox(device)
        self._port: Any = None
        self._thread: threading.Thread | None = None
        self._closing = threading.Event()

    async def open(self) -> None:
        """Open the port and start to read; LinkLost if it cannot be opened."""
        import serial

        try:
            self._port = serial.Serial(self._port_name, self._baud, timeout=0.05, exclusive=True)
        except (OSError, ValueError) as error:
            raise LinkLost(
                self._device,
                f"cannot open serial port {self._port_name} ({error}); is it plugged in, free, and allowed to you?",
            ) from None
        loop = asyncio.get_running_loop()
        self._thread = threading.Thread(target=self._read, args=(loop,), name=f"read {self._device}", daemon=True)
        self._thread.start()

    async def receive(self) -> ByteChunk:
        """Return the next bytes; LinkLost when the port is gone."""
        return await self._inbox.get()

    def write(self, data: bytes) -> None:
        """Send bytes."""
        self._port.write(data)

    def close(self) -> None:
        """Stop reading and close the port."""
        self._closing.set()
        if self._thread is not None:
            self._thread.join(1.0)
            self._thread = None
        if self._port is not None:
            self._port.close()
            self._port = None

    def _read(self, loop: asyncio.AbstractEventLoop) -> None:
        while not self._closing.is_set():
            try:
                data = self._port.read(max(1, min(self._port.in_waiting, _READ_LIMIT)))
            except (OSError, TypeError) as error:  # pyserial's SerialException is an OSError
                reason = f"serial port {self._port_name} is gone ({error})"
                _call(loop, self._inbox.end, reason)
                return
            if data:
                _call(loop, self._inbox.put, ByteChunk(round(loop.time() * 1e9), data))


class TcpLink:
    """A TCP stream, for instance a serial-to-Ethernet converter."""

    def __init__(self, device: str, host: str, port: int, timeout_s: float) -> None:
        """Name the peer; it is connected by ``open``."""
        self._device, self._host, self._port, self._timeout_s = device, host, port, timeout_s
        self._reader: asyncio.StreamReader | None = None
        self._writer: asyncio.StreamWriter | None = None

    async def open(self) -> None:
        """Connect; LinkLost if nobody listens."""
        try:
            async with asyncio.timeout(self._timeout_s):
                self._reader, self._writer = await asyncio.open_connection(self._host, self._port)
        except (OSError, TimeoutError) as error:
            raise LinkLost(self._device, f"no connection to {self._host}:{self._port} ({error})") from None

    async def receive(self) -> ByteChunk:
        """Return the next bytes; LinkLost when the peer has closed."""
        if self._reader is None:
            raise LinkLost(self._device, "the link is not open")
        try:
            data = await self._reader.read(_READ_LIMIT)
        except OSError as error:
            raise LinkLost(self._device, f"{self._host}:{self._port} broke the connection ({error})") from None
        if not data:
            raise LinkLost(self._device, f"{self._host}:{self._port} closed the connection")
        return ByteChunk(round(asyncio.get_running_loop().time() * 1e9), data)

    def write(self, data: bytes) -> None:
        """Send bytes."""
        if self._writer is not None:
            self._writer.write(data)

    def close(self) -> None:
        """Close the connection."""
        if self._writer is not None:
            self._writer.close()
            self._writer = None


def _call(loop: asyncio.AbstractEventLoop, function: Any, argument: Any) -> None:
    """Call from the reader thread; a loop that has closed needs no more news."""
    if not loop.is_closed():
        loop.call_soon_threadsafe(function, argument)
