"""A serial port through pyserial: a device, or one at the far end of a network by pyserial's URLs.

The port is opened, read and closed by a thread of its own: opening and closing may take long (rfc2217 negotiates,
sockets connect), and stamps must not wait for the loop.
"""

import asyncio
import os
import select
import socket
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from drivers.clocks.loop_scale import call_from_thread, loop_scale, settle
from drivers.errors import LinkLost
from drivers.links.inbox import Inbox
from drivers.types import ByteChunk

_MOST_AT_ONCE = 65536
_BACKLOG_S, _BACKLOG_LOOK_S = 0.3, 0.002
_LOOK_S = 0.1  # how often the thread checks whether it should end, where it cannot be woken
_WRITE_LIMIT_S = 0.2
_OPEN_LIMIT_S = 10.0
_CLOSE_LIMIT_S = 0.5


class SerialLink:
    """A serial port, or what pyserial makes look like one.

    ``url`` is a device (/dev/ttyUSB0, COM3), socket://host:port for a plain converter, or rfc2217://host:port for
    one that is told the line's settings.
    """

    def __init__(
        self, device: str, url: str, baud: int, *, parity: str = "N", stop_bits: float = 1, gather_s: float = 0.0
    ) -> None:
        """Store the settings of the port at ``url``, a name or a URL of pyserial; ``open`` opens it.

        It has eight data bits; ``parity`` is N, E, O, M or S. With ``gather_s`` received bytes are handed over at most
        once in that time (wall clock), which saves most of the cost of a stream. What comes after a pause of that
        length is handed over at once. ``device`` is for errors.
        """
        self._device, self._url, self._gather_s = device, url, gather_s
        self._settings: dict[str, Any] = {"baudrate": baud, "parity": parity, "stopbits": stop_bits}
        self._inbox = Inbox(device)
        self._reader: _Reader | None = None

    async def open(self) -> None:
        """Open the port and start reading it in a thread, after closing one that is open.

        Bytes received before and not taken yet are dropped. LinkLost if the port cannot be opened, with the likely
        reason, or not within ten seconds (real time).
        """
        self.close()
        self._inbox.begin()
        loop = asyncio.get_running_loop()
        reader = _Reader(self._url, self._settings, self._gather_s, loop, self._inbox)
        self._reader = reader
        try:
            async with asyncio.timeout(_OPEN_LIMIT_S * max(loop_scale(loop), 1.0)):
                await reader.opened
        except asyncio.CancelledError:
            self.close()
            raise
        except TimeoutError:
            self.close()
            raise LinkLost(self._device, f"serial port {self._url} did not open within {_OPEN_LIMIT_S:g} s") from None
        except Exception as error:  # pyserial has no common base class for errors of a port
            self.close()
            raise LinkLost(self._device, f"cannot open serial port {self._url}: {_why_not(self._url, error)}") from None

    async def receive(self) -> ByteChunk:
        """Return the next bytes; LinkLost once the port is gone."""
        return await self._inbox.get()

    def write(self, data: bytes) -> None:
        """Send bytes; LinkLost if the port is not open, has ended, is gone, or does not accept all bytes within 0.2 s.

        The loop is blocked meanwhile; rfc2217 has no such limit. After a failed write the link has ended; bytes
        received before can still be read.
        """
        if self._reader is None or self._inbox.ended:
            raise LinkLost(self._device, self._inbox.ended or f"serial port {self._url} is not open")
        try:
            self._reader.write(data)
        except OSError as error:
            timeout = isinstance(error, _StuckError) or type(error).__name__ == "SerialTimeoutException"
            reason = "accepts no more bytes. Check its handshake and its cable" if timeout else "is gone"
            self._inbox.fail(f"serial port {self._url} {reason}")

    def close(self) -> None:
        """Stop reading and close the port; twice is once."""
        reader, self._reader = self._reader, None
        if reader is not None:
            reader.end()
            self._inbox.end("the link was closed")


class _StuckError(OSError):
    """The port did not accept all bytes in time."""


class _Reader:
    """One opening of a port: the thread that opens, reads and closes it."""

    def __init__(
        self, url: str, settings: dict[str, Any], gather_s: float, loop: asyncio.AbstractEventLoop, inbox: Inbox
    ) -> None:
        """Start the thread that opens the port and puts what it reads into ``inbox``, gathered for ``gather_s``.

        ``settings`` are those of pyserial. ``opened``, a future of ``loop``, completes when the port is open or has
        failed to open.
        """
        self._url, self._settings, self._gather_s, self._loop = url, settings, gather_s, loop
        self._inbox = inbox
        self._port: Any = None
        self._closing = threading.Event()
        self._woken, self._wakes = socket.socketpair()
        self.opened: asyncio.Future[None] = loop.create_future()
        # A daemon: a driver that hangs must not keep the program from ending.
        self._thread = threading.Thread(target=self._run, name=f"serial {url}", daemon=True)
        self._thread.start()

    def write(self, data: bytes) -> None:
        """Send bytes; OSError if the port is gone, _StuckError if bytes are left after 0.2 s.

        Ports without a descriptor are left to pyserial and its own exceptions. For others it loops on the descriptor,
        as pyserial raises even where all bytes were written before the host stalled.
        """
        if not self._waits_on_descriptor:
            self._port.write(data)
            return
        descriptor, ends_s = self._port.fileno(), time.monotonic() + _WRITE_LIMIT_S
        left = data
        while left:
            late = time.monotonic() >= ends_s
            with suppress(BlockingIOError):
                left = left[os.write(descriptor, left) :]
            if left and late:
                raise _StuckError
            if left:
                select.select([], [descriptor], [], max(ends_s - time.monotonic(), 0.0))

    def end(self) -> None:
        """Let the thread close the port; wait half a second for that, unless it is behind a URL or not open yet.

        A pending ``opened`` is cancelled. An error of opening that nobody waits for any more is dropped.
        """
        self._closing.set()
        with suppress(OSError):
            self._wakes.send(b"x")
        if self._port is not None and not _is_url(self._url):
            self._thread.join(_CLOSE_LIMIT_S)
        if self.opened.done() and not self.opened.cancelled():
            self.opened.exception()  # not needed if the caller has given up waiting
        else:
            self.opened.cancel()

    def _run(self) -> None:
        """Open the port, report that or the error to ``opened``, read until the end, and close the port.

        An error while reading ends the inbox.
        """
        try:
            port = self._open()
        except Exception as error:  # raised again by the caller of ``open``
            call_from_thread(self._loop, settle, self.opened, error)
        else:
            self._port = port
            call_from_thread(self._loop, settle, self.opened, None)
            try:
                self._read(port)
            except Exception:  # pyserial raises many kinds for a port that is gone
                call_from_thread(self._loop, self._end_inbox)
            _close(port)
        self._woken.close()
        self._wakes.close()

    def _open(self) -> Any:
        """Open the port with pyserial, exclusively, and drop the backlog of a local one; pyserial's exceptions pass
        through.

        Its reads do not wait if there is a descriptor to wait on, else 0.1 s; its writes wait 0.2 s, except for
        rfc2217.
        """
        import serial

        # With a descriptor, wait on that; changing the time-out later would set up the line once more.
        settings = dict(self._settings, timeout=0 if self._waits_on_descriptor else _LOOK_S, exclusive=True)
        if not self._url.startswith("rfc2217:"):  # pyserial's rfc2217 knows no limit for writing
            settings["write_timeout"] = _WRITE_LIMIT_S
        port = serial.serial_for_url(self._url, do_not_open=True, **settings)
        port.open()
        if not _is_url(self._url):
            _drop_backlog(port)
        return port

    def _read(self, port: Any) -> None:
        """Put received bytes into the inbox until closing, gathered for ``gather_s``; exceptions of the port pass
        through.

        Each chunk has the time of the loop at which it was handed over. Bytes read before an exception are handed over;
        those still being gathered on closing are dropped.
        """
        wait, take = self._ways(port)
        handed_over = time.monotonic()
        while not self._closing.is_set():
            data = wait()
            if not data:
                continue
            rest = self._gather_s - (time.monotonic() - handed_over)
            if rest > 0 and self._closing.wait(rest):
                return
            try:
                while len(data) < _MOST_AT_ONCE and (more := take()):
                    data += more
            finally:  # bytes received before the end still count
                handed_over = time.monotonic()
                call_from_thread(self._loop, self._put, ByteChunk(round(self._loop.time() * 1e9), data))

    @property
    def _waits_on_descriptor(self) -> bool:
        scheme = self._url.partition("://")[0] if _is_url(self._url) else ""
        return scheme == "socket" or (scheme not in ("rfc2217", "loop") and os.name != "nt")

    def _ways(self, port: Any) -> tuple[Callable[[], bytes], Callable[[], bytes]]:
        """Return two functions that return bytes: one waits for the first ones, one takes what else has come without
        waiting.

        The first returns nothing if it is woken up or, for ports without a descriptor, after 0.1 s.
        """
        if not self._waits_on_descriptor:
            # A buffer with a count of its bytes; on sockets in_waiting only tells whether there are any.
            return lambda: bytes(port.read(1)), lambda: bytes(port.read(min(port.in_waiting, _MOST_AT_ONCE)))
        descriptor = port.fileno()

        def take() -> bytes:
            return bytes(port.read(_MOST_AT_ONCE))

        def wait() -> bytes:
            ready, _, _ = select.select([descriptor, self._woken], [], [])
            return take() if descriptor in ready else b""

        return wait, take

    def _put(self, chunk: ByteChunk) -> None:
        if not self._closing.is_set():
            self._inbox.put(chunk)

    def _end_inbox(self) -> None:
        if not self._closing.is_set():
            reason = "closed the connection" if _is_url(self._url) else "is gone: unplugged or without power"
            self._inbox.end(f"serial port {self._url} {reason}")


def _drop_backlog(port: Any) -> None:
    """Discard bytes received before opening, as their time is unknown.

    Looks several times, as a second buffer may refill the first: until three looks in a row find nothing, at most 0.3
    s.
    """
    ends = time.monotonic() + _BACKLOG_S
    empty = 0
    while empty < 3 and time.monotonic() < ends:
        waiting = port.in_waiting
        empty = 0 if waiting else empty + 1
        if waiting:
            port.reset_input_buffer()
        time.sleep(_BACKLOG_LOOK_S)


def _close(port: Any) -> None:
    sock = getattr(port, "_socket", None)
    with suppress(Exception):
        port.close()
    if sock is not None:  # pyserial leaves a socket open that the other end has reset
        sock.close()


def _is_url(url: str) -> bool:
    return "://" in url


def _why_not(url: str, error: Exception) -> str:
    """Return in words why a port could not be opened, and what to do about it.

    ``error`` is what pyserial raised: an invalid url, a port in use, a converter that does not answer, a right that is
    missing, or else probably a missing port.
    """
    text = str(error)
    if isinstance(error, ValueError):
        return f"{text}; write a device such as /dev/ttyUSB0, socket://host:port or rfc2217://host:port"
    if "lock" in text:
        return "another program uses it. Close that program first"
    if _is_url(url):
        return f"no valid answer ({text}). Is the converter switched on? Is the address correct?"
    if getattr(error, "errno", None) == 13:
        return "you may not access it. On Linux, join the group dialout"
    return f"is it plugged in and spelled correctly? ({text})"
