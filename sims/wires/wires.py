"""Wires with a twin of a byte device at the far end: in memory, a pseudo-terminal, a TCP port.

Wires work by the loop alone, without threads. Each can be unplugged by its ``Plug``, and plugged in again. A serial
port that is not open hears nothing, and is empty when it is opened; an open one keeps 4 kB that nobody reads and loses
what comes thereafter, as the buffer of a UART's driver.
"""

import asyncio
import fcntl
import math
import os
import select
import socket
import struct
import tempfile
import termios
import tty
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import ExitStack, asynccontextmanager, contextmanager, suppress
from pathlib import Path
from typing import Any, Protocol

from drivers.clocks.loop_scale import loop_scale
from drivers.links.memory_link import MemoryLink

Write = Callable[[bytes], None]
_MOST_WAITING = 65536
_READ = 4096
_KEPT = 4095  # bytes that Linux keeps of a terminal that nobody reads, and so sends at once
_AGAIN_S = 0.001


class ByteDevice(Protocol):
    """A device at the far end of a byte link.

    If it has a ``hung_up``, that is called when a TCP connection has ended, so that unfinished input can be dropped.
    """

    def received(self, data: bytes) -> None:
        """Take bytes from the host, cut anywhere."""


class Plug:
    """The end of a wire at its device, which can be unplugged and plugged in."""

    def __init__(self) -> None:
        """Start plugged in, on no wire yet."""
        self.out = False
        self._timers: list[asyncio.TimerHandle] = []
        self._pulled: Callable[[], None] = _nothing
        self._put_back: Callable[[], None] = _nothing

    def attach(self, pulled: Callable[[], None], put_back: Callable[[], None]) -> None:
        """Register the functions of a wire that are called when it is unplugged and plugged in."""
        self._pulled, self._put_back = pulled, put_back

    def schedule(self, pull_s: float, push_s: float) -> None:
        """Have it pulled and put back so many seconds of the running loop from now, infinite for never."""
        loop = asyncio.get_running_loop()
        for after_s, act in ((pull_s, self.pull), (push_s, self.push)):
            if after_s < math.inf:
                self._timers.append(loop.call_later(after_s, act))

    def detach(self) -> None:
        """Take the wire away, and all that was still to come."""
        for timer in self._timers:
            timer.cancel()
        self._pulled = self._put_back = _nothing

    def pull(self) -> None:
        """Unplug; twice is once."""
        if not self.out:
            self.out = True
            self._pulled()

    def push(self) -> None:
        """Plug in again; twice is once."""
        if self.out:
            self.out = False
            self._put_back()


@contextmanager
def in_memory(name: str, make: Callable[[Write], ByteDevice], plug: Plug | None = None) -> Iterator[MemoryLink]:
    """Connect a device to a wire in memory; yield the link for a station, which knows the device as ``name``.

    ``make`` builds the device from the function that it writes with. Afterwards the wire is unplugged. ``plug`` can do
    that earlier.
    """
    heard: list[ByteDevice] = []
    link = MemoryLink(name, lambda data: heard[0].received(data))
    plug = plug or Plug()
    plug.attach(link.unplug, link.plug)
    heard.append(make(link.deliver))
    try:
        yield link
    finally:
        plug.detach()
        link.unplug()


@asynccontextmanager
async def on_pty(make: Callable[[Write], ByteDevice], plug: Plug | None = None) -> AsyncIterator[str]:
    """Connect a device to a pseudo-terminal while this context lasts, and yield its path.

    ``make`` builds the device from the function that it writes with. With a ``plug`` the path is a symbolic link,
    dangling while unplugged and then leading to a new terminal.
    """
    with ExitStack() as stack:
        wire = _Pty(stack, plug is not None)
        device = make(wire.write)
        wire.plug_in(device.received)
        if plug is not None:
            plug.attach(wire.unplug, lambda: wire.plug_in(device.received))
            stack.callback(plug.detach)
        stack.callback(wire.unplug)
        yield wire.name


class _Pty:
    """A pseudo-terminal that can be closed, as if unplugged, and opened again."""

    def __init__(self, stack: ExitStack, replaceable: bool) -> None:
        self._end: _PtyEnd | None = None
        self._folder = Path(stack.enter_context(tempfile.TemporaryDirectory())) if replaceable else None
        self.name = ""

    def write(self, data: bytes) -> None:
        if self._end is not None:
            self._end.write(data)

    def plug_in(self, received: Write) -> None:
        self._end = _PtyEnd(received)
        self.name = self._end.name
        if self._folder is not None:
            (self._folder / "tty").symlink_to(self.name)
            self.name = str(self._folder / "tty")

    def unplug(self) -> None:
        end, self._end = self._end, None
        if end is not None:
            end.close()
        if self._folder is not None:
            (self._folder / "tty").unlink(missing_ok=True)


class _PtyEnd:
    """The near end of a new raw pseudo-terminal, read and written by the loop; ``name`` is that of the far end.

    The far end is open only while a station has it open.
    """

    def __init__(self, received: Write) -> None:
        """Open the pseudo-terminal and start reading; ``received`` gets the bytes that a station writes.

        The far end is closed again. Reading is edge-triggered, as the terminal is hung up without a station.
        """
        self._descriptor, theirs = os.openpty()
        tty.setraw(self._descriptor)
        tty.setraw(theirs)
        self.name, self._received = os.ttyname(theirs), received
        os.close(theirs)
        os.set_blocking(self._descriptor, False)
        self._waiting = bytearray()
        self._loop = asyncio.get_running_loop()
        self._scale = max(loop_scale(self._loop), 1.0)
        self._soon: asyncio.Handle | None = None
        self._holds_some = False
        # By its edges: a terminal without a station is hung up all the time.
        self._events = select.epoll()
        self._events.register(self._descriptor, select.EPOLLIN | select.EPOLLET)
        self._hung_up = select.poll()
        self._hung_up.register(self._descriptor, 0)
        self._loop.add_reader(self._events.fileno(), self._read)

    def _read(self) -> None:
        self._events.poll(0)
        with suppress(OSError):  # no more bytes, or no reader
            while data := os.read(self._descriptor, _READ):
                self._received(data)
        self._is_open()

    def write(self, data: bytes) -> None:
        self._waiting.extend(data)
        if self._soon is None:  # bytes written at one instant are sent together
            self._soon = self._loop.call_soon(self._send)

    def _send(self) -> None:
        """Write waiting bytes, as many as the station's buffer should hold, and try again soon if some are left.

        All are dropped if no station has the port open, and bytes beyond what a real line would hold.
        """
        self._soon = None
        if not self._is_open():
            self._waiting.clear()
            return
        unread = 0
        with suppress(OSError), self._other_end() as port:
            (unread,) = struct.unpack("i", fcntl.ioctl(port, termios.FIONREAD, bytes(4)))
        now = self._waiting[: max(_KEPT - unread, 0)]
        with suppress(BlockingIOError):
            del self._waiting[: os.write(self._descriptor, now)]
            self._holds_some = True
        # At a multiple of real time as many times the bytes come at one instant, and are no more than 4 kB of the line.
        del self._waiting[max(round(_KEPT * self._scale) - unread - len(now), 0) :]
        if self._waiting:
            self._soon = self._loop.call_later(_AGAIN_S * self._scale, self._send)

    def _is_open(self) -> bool:
        """Return whether a station has the port open; if not, flush what the last one left unread."""
        if not self._hung_up.poll(0):
            return True
        if self._holds_some:
            self._holds_some = False
            with suppress(OSError, termios.error), self._other_end() as port:  # the latter while slcand has it
                termios.tcflush(port, termios.TCIFLUSH)
        return False

    @contextmanager
    def _other_end(self) -> Iterator[int]:
        """Open the station's end for a moment; OSError if it is locked."""
        port = os.open(self.name, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        try:
            yield port
        finally:
            os.close(port)

    def close(self) -> None:
        if self._soon is not None:
            self._soon.cancel()
        self._loop.remove_reader(self._events.fileno())
        self._events.close()
        os.close(self._descriptor)


@asynccontextmanager
async def on_tcp(
    make: Callable[[Write], ByteDevice], host: str, port: int = 0, plug: Plug | None = None
) -> AsyncIterator[tuple[str, int]]:
    """Connect a device to a TCP port while this context lasts, and yield host and port; OSError if the port is taken.

    ``make`` builds the device from the function that it writes with. Port 0 takes any free one. One station is served
    at a time, the one that connected last. ``plug`` resets the connection and closes the port until it is put back.
    """
    wire = _Tcp()
    device = make(wire.write)
    wire.received, wire.hung_up = device.received, getattr(device, "hung_up", _nothing)
    bound = await wire.listen(host, port)
    plug = plug or Plug()
    plug.attach(wire.unplug, lambda: wire.plug_in(bound))
    try:
        yield bound
    finally:
        plug.detach()
        await wire.close()


class _Tcp:
    """A TCP port; the station that connected last is served."""

    def __init__(self) -> None:
        self.received: Write = _nothing
        self.hung_up: Callable[[], None] = _nothing
        self._server: asyncio.Server | None = None
        self._client: asyncio.StreamWriter | None = None
        self._tasks: set[asyncio.Task[object]] = set()

    def write(self, data: bytes) -> None:
        client = self._client
        if client is None or client.is_closing() or client.transport.get_write_buffer_size() > _MOST_WAITING:
            return
        client.write(data)

    async def listen(self, host: str, port: int) -> tuple[str, int]:
        self._server = await asyncio.start_server(self._welcome, host, port)
        name = self._server.sockets[0].getsockname()
        return str(name[0]), int(name[1])

    def unplug(self) -> None:
        """Reset the connection, of which the device is told, and stop listening; nothing if neither is there."""
        if self._server is not None:
            self._server.close()
            self._server = None
        if self._client is not None:
            self._client.transport.abort()
            self._client = None
            self.hung_up()

    def plug_in(self, bound: tuple[str, int]) -> None:
        self._keep(asyncio.get_running_loop().create_task(self.listen(*bound)))

    async def close(self) -> None:
        """Release the port, and wait until all connections are gone."""
        self.unplug()
        await asyncio.gather(*self._tasks)
        self.unplug()  # the link that was just put back

    def _keep(self, task: asyncio.Task[Any]) -> None:
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    def _welcome(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Serve a new station; an earlier connection is aborted, of which the device is told."""
        # The task is ours: asyncio's own would be reported with a traceback if it were cancelled at the end.
        before, self._client = self._client, writer
        if before is not None:
            before.transport.abort()  # it may never read the remaining bytes
            self.hung_up()
        writer.get_extra_info("socket").setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._keep(asyncio.get_running_loop().create_task(self._serve(reader, writer)))

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Pass received bytes to the device until the station leaves, of which the device is then told.

        It is not told if another station has connected meanwhile.
        """
        with suppress(OSError):
            while data := await reader.read(_READ):
                self.received(data)
        if self._client is writer:
            self._client = None
            self.hung_up()
        writer.close()
        with suppress(OSError):
            await writer.wait_closed()


def _nothing(data: bytes = b"") -> None:
    """Do nothing."""
