"""Buses of python-can that can be read at the rate of a full bus and report when they are gone.

python-can's own slcan reads one byte a call, half a core for four gyros at 1 kHz, and breaks off at a damaged line; its
socketcand takes a server that has hung up for one that is silent, and tries a refused connection for ten seconds at
full speed. These two are put right here, and an interface of the kernel that is down is refused; all others are
python-can's as they are.
"""

import os
import select
import socket
import time
from typing import Any

import can
from can.interfaces.slcan import slcanBus
from can.interfaces.socketcand.socketcand import convert_can_message_to_ascii_message

SOCKETCAND_PORT = 29536
_READ_LIMIT = 65536
_LONGEST_LINE = 256  # an FD frame of 64 bytes has 138 characters
_HANDSHAKE_S = 2.0
_POLL_S = 0.001

Raw = tuple[int, bool, bytes]
"""A frame without any ado: identifier, whether it is an extended one, data."""


def open_bus(interface: str, channel: str, options: dict[str, Any]) -> can.BusABC:
    """Open a CAN bus by python-can's names of interface and channel; python-can's own exceptions pass through.

    ``options`` go to the interface. slcan and socketcand use the faster readers of this module. OSError if a socketcan
    interface is down.
    """
    if interface == "slcan":
        return SlcanBus(channel, **options)
    if interface == "socketcand":
        return SocketcandBus(channel, **options)
    bus = can.Bus(interface=interface, channel=channel, **options)
    # Linux binds a socket to an interface that is down, and reports this once, afterwards.
    kernel: Any = bus
    if interface == "socketcan" and (code := kernel.socket.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)):
        bus.shutdown()
        raise OSError(code, os.strerror(code))
    return bus


class SlcanBus(slcanBus):
    """A Lawicel adapter on a serial port, read in chunks of all waiting bytes."""

    def __init__(self, channel: str, **options: Any) -> None:
        """Take python-can's options for slcan; the port itself never waits."""
        self.malformed = 0
        """Lines that began like a frame and were none."""
        super().__init__(channel, **{"timeout": 0.0, **options})
        self.serialPortOrig.write_timeout = _HANDSHAKE_S

    def shutdown(self) -> None:
        """Close the adapter's channel and the port; the port even if the adapter is gone."""
        try:
            super().shutdown()
        finally:
            self.serialPortOrig.close()

    def frames(self, timeout: float | None) -> list[Raw]:
        """Return (identifier, whether it has 29 bits, data) of the frames received; may be empty.

        Waits up to ``timeout`` s for the first bytes; None means without limit, on Windows 2 s. An unfinished line is
        kept for the next call. Other lines, such as remote frames and answers, are dropped; damaged lines are counted
        in ``malformed``. CanOperationError if the port fails.
        """
        if timeout != 0:
            self._wait(timeout)
        try:
            self._buffer += self.serialPortOrig.read(_READ_LIMIT)
        except (OSError, TypeError) as error:  # the latter from a port that was closed in the meantime
            raise can.CanOperationError(f"serial port: {error}") from error
        *lines, rest = bytes(self._buffer).replace(self._ERROR, self._OK).split(self._OK)
        self._buffer = bytearray(rest[-_LONGEST_LINE:])
        found = []
        for line in (line.decode("ascii", "replace").lstrip("\n") for line in lines):
            digits = {"t": 3, "T": 8}.get(line[:1])
            if digits is None:
                continue
            try:
                start, size = digits + 2, int(line[digits + 1])
                data = bytes.fromhex(line[start : start + 2 * size])
                if len(data) != size or size > 8:
                    raise ValueError(line)
                found.append((int(line[1 : digits + 1], 16), digits == 8, data))
            except (ValueError, IndexError):
                self.malformed += 1
        return found

    def _wait(self, timeout: float | None) -> None:
        try:
            select.select([self.fileno()], [], [], timeout)
        except NotImplementedError:  # Windows gives a serial port no descriptor
            ends = time.monotonic() + (timeout or _HANDSHAKE_S)
            while not self.serialPortOrig.in_waiting and time.monotonic() < ends:
                time.sleep(_POLL_S)


class SocketcandBus(can.BusABC):
    """One bus of a socketcand server, in raw mode over TCP."""

    def __init__(self, channel: str, host: str, port: int = SOCKETCAND_PORT, **options: Any) -> None:
        """Connect to the server and open its bus ``channel`` in raw mode; if that fails, disconnect and raise OSError
        or CanError.

        Each step may take 2 s. Frames that arrive meanwhile are kept for ``frames``. ``options`` go to python-can's
        bus.
        """
        self.malformed = 0
        """Frames that could not be read."""
        self._rest = b""
        self._stream = socket.create_connection((host, port), _HANDSHAKE_S)
        try:
            self._stream.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._early = self._expect("hi", [])
            for command in (f"open {channel}", "rawmode"):
                self._stream.sendall(f"< {command} >".encode())
                self._early = self._expect("ok", self._early)
        except BaseException:
            self._stream.close()
            raise
        self.channel_info = f"socketcand {channel} at {host}:{port}"
        super().__init__(channel, **options)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send a frame; CanOperationError if the server is gone."""
        self._stream.settimeout(timeout)
        try:
            self._stream.sendall(convert_can_message_to_ascii_message(msg).encode())
        except OSError as error:
            raise can.CanOperationError(str(error)) from error

    def shutdown(self) -> None:
        """Leave the server."""
        super().shutdown()
        self._stream.close()

    def frames(self, timeout: float | None) -> list[Raw]:
        """Return (identifier, whether it has 29 bits, data) of the frames received; may be empty.

        Frames that came while the bus was opened are returned first, at once. Waits up to ``timeout`` s (None: without
        limit) for the first bytes; if they complete no frame, the list is empty. Other elements are dropped; damaged
        frames are counted in ``malformed``. CanOperationError if the connection ends.
        """
        found: list[Raw] = []
        early, self._early = self._early, []
        if not early and not select.select([self._stream], [], [], timeout)[0]:
            return found
        for element in early or self._elements():
            parts = element.split()
            if len(parts) not in (5, 6) or parts[1] != "frame":
                continue
            try:
                float(parts[3])  # an invalid stamp means damage
                data = bytes.fromhex(parts[4]) if len(parts) == 6 else b""
                found.append((int(parts[2], 16), len(parts[2]) != 3, data))
            except ValueError:
                self.malformed += 1
        return found

    def _elements(self) -> list[str]:
        """Receive once and return the complete elements ``< ... >``, with brackets; keep up to 256 bytes behind them.

        Waits for bytes without limit; empty if they complete no element.

        CanOperationError if the connection fails or the server has closed it.
        """
        try:
            data = self._stream.recv(_READ_LIMIT)
        except OSError as error:
            raise can.CanOperationError(str(error)) from error
        if not data:
            raise can.CanOperationError("the server closed the connection")
        if hasattr(socket, "TCP_QUICKACK"):  # a server that waits for our acknowledgement would send in bursts
            self._stream.setsockopt(socket.IPPROTO_TCP, socket.TCP_QUICKACK, 1)
        *whole, rest = (self._rest + data).split(b">")
        self._rest = rest[-_LONGEST_LINE:]
        return [part[part.rfind(b"<") :].decode("ascii", "replace") + ">" for part in whole]

    def _expect(self, word: str, early: list[str]) -> list[str]:
        """Wait for a word of the server and return the elements after it; CanInitializationError for another word."""
        while not early:
            early = self._elements()
        if early[0] != f"< {word} >":
            raise can.CanInitializationError(f"the socketcand server answered {early[0]!r}, not '< {word} >'")
        return early[1:]
