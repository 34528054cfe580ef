"""Wires at whose far end a twin of a byte device sits: a pseudo-terminal, a TCP port.

What nobody reads is dropped, oldest first, as the buffer of a serial port would.
"""

from __future__ import annotations

import asyncio
import os
import socket
import tty
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from typing import Protocol

Write = Callable[[bytes], None]
_MOST_WAITING = 65536
_READ = 4096


class ByteDevice(Protocol):
    """A device at the far end of a byte link."""

    def received(self, data: bytes) -> None:
        """Take bytes from the host, cut anywhere."""


@asynccontextmanager
async def pty_pair() -> AsyncIterator[tuple[int, str]]:
    """Open a pseudo-terminal that passes bytes as they are; yield our end's descriptor, and the name of the other."""
    ours, theirs = os.openpty()
    try:
        tty.setraw(ours)
        tty.setraw(theirs)
        os.set_blocking(ours, False)
        # The far end is kept open, so that ours sees no error when a station leaves.
        yield ours, os.ttyname(theirs)
    finally:
        os.close(ours)
        os.close(theirs)


@asynccontextmanager
async def pty_joint() -> AsyncIterator[tuple[str, str]]:
    """Join two pseudo-terminals like two serial ports by a cable; yield their names."""
    loop = asyncio.get_running_loop()
    async with pty_pair() as (one, first), pty_pair() as (other, second):

        def hand_on(source: int, sink: int) -> None:
            with suppress(BlockingIOError):
                os.write(sink, os.read(source, _READ))

        loop.add_reader(one, hand_on, one, other)
        loop.add_reader(other, hand_on, other, one)
        try:
            yield first, second
        finally:
            loop.remove_reader(one)
            loop.remove_reader(other)


@asynccontextmanager
async def on_pty(make: Callable[[Write], ByteDevice]) -> AsyncIterator[str]:
    """Put a device on a pseudo-terminal; yield the name that a station opens. ``make`` is given what it writes by."""
    loop = asyncio.get_running_loop()
    async with pty_pair() as (ours, name):
        waiting = bytearray()

        def write(data: bytes) -> None:
            waiting.extend(data)
            if len(waiting) > _MOST_WAITING:
                del waiting[: len(waiting) - _MOST_WAITING]
            send()

        def send() -> None:
            with suppress(BlockingIOError):
                while waiting:
                    del waiting[: os.write(ours, waiting)]
            if waiting:
                loop.add_writer(ours, send)
            else:
                loop.remove_writer(ours)

        device = make(write)

        def hear() -> None:
            with suppress(BlockingIOError):
                device.received(os.read(ours, _READ))

        loop.add_reader(ours, hear)
        try:
            yield name
        finally:
            loop.remove_reader(ours)
            loop.remove_writer(ours)


@asynccontextmanager
async def on_tcp(make: Callable[[Write], ByteDevice], host: str, port: int = 0) -> AsyncIterator[tuple[str, int]]:
    """Put a device on a TCP port, for one station at a time; yield host and port. OSError if the port is taken."""
    client: asyncio.StreamWriter | None = None

    def write(data: bytes) -> None:
        if client is None or client.is_closing() or client.transport.get_write_buffer_size() > _MOST_WAITING:
            return
        client.write(data)

    device = make(write)

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        nonlocal client
        before, client = client, writer
        if before is not None:
            before.close()
        writer.get_extra_info("socket").setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        with suppress(OSError):
            while data := await reader.read(_READ):
                device.received(data)
        if client is writer:
            client = None
        writer.close()

    server = await asyncio.start_server(serve, host, port)
    try:
        name = server.sockets[0].getsockname()
        yield str(name[0]), int(name[1])
    finally:
        server.close()
        if client is not None:
            client.close()
