"""A TCP stream, for instance to a serial-to-Ethernet converter or a motion controller."""

import asyncio
import socket

from drivers.errors import LinkLost
from drivers.packaged import sentence
from drivers.types import ByteChunk

_READ_LIMIT = 65536
_MOST_UNSENT = 1 << 18
# A peer without power is silent: probe after two silent seconds, give up five seconds later.
_KEEPALIVE = {"TCP_KEEPIDLE": 2, "TCP_KEEPINTVL": 1, "TCP_KEEPCNT": 5}


class TcpLink:
    """A TCP stream without delay, with keep-alive probes while the peer is silent."""

    def __init__(self, device: str, host: str, port: int, timeout_s: float) -> None:
        """Name the peer; it is connected by ``open`` within ``timeout_s``."""
        self._device, self._host, self._port, self._timeout_s = device, host, port, timeout_s
        self._reader: asyncio.StreamReader | None = None
        self._writer: asyncio.StreamWriter | None = None
        self._ended = ""

    async def open(self) -> None:
        """Connect, closing an open connection first; LinkLost if nobody listens or answers within the time-out."""
        self.close()
        peer = f"{self._host}:{self._port}"
        try:
            async with asyncio.timeout(self._timeout_s):
                self._reader, self._writer = await asyncio.open_connection(self._host, self._port)
        except TimeoutError:
            raise LinkLost(self._device, sentence("link.silent", peer=peer, limit_s=self._timeout_s)) from None
        except OSError as error:
            raise LinkLost(self._device, sentence("link.unreachable", peer=peer, why=_plain(error))) from None
        self._ended = ""
        _set_up(self._writer.get_extra_info("socket"))

    async def receive(self) -> ByteChunk:
        """Return the next bytes with their time of arrival; LinkLost if the link is not open, fails or was closed by
        the peer.
        """
        if self._reader is None:
            raise LinkLost(self._device, self._ended or "the link is not open")
        try:
            data = await self._reader.read(_READ_LIMIT)
        except OSError as error:
            raise self._end(f"broke the connection ({_plain(error)})") from None
        if not data:
            raise self._end("closed the connection")
        return ByteChunk(round(asyncio.get_running_loop().time() * 1e9), data)

    def write(self, data: bytes) -> None:
        """Send bytes; LinkLost if the link is not open, is closing, or holds more than 256 KiB of unsent bytes.

        In the latter two cases the link has ended.
        """
        if self._writer is None:
            raise LinkLost(self._device, self._ended or "the link is not open")
        if self._writer.is_closing():
            raise self._end("closed the connection")
        if self._writer.transport.get_write_buffer_size() > _MOST_UNSENT:
            raise self._end("accepts no more bytes")
        self._writer.write(data)

    def close(self) -> None:
        """Close the connection; twice is once."""
        if self._writer is not None:
            self._writer.close()
            self._writer = self._reader = None
            self._ended = self._ended or "the link was closed"

    def _end(self, reason: str) -> LinkLost:
        self._ended = self._ended or f"{self._host}:{self._port} {reason}"
        if self._writer is not None:
            self._writer.transport.abort()
        self._writer = self._reader = None
        return LinkLost(self._device, self._ended)


def _set_up(sock: socket.socket) -> None:
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in _KEEPALIVE.items():
        if hasattr(socket, name):
            sock.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)


def _plain(error: OSError) -> str:
    return error.strerror or str(error) or type(error).__name__
