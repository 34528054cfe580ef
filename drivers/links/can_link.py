"""A CAN bus through python-can, with any of its interfaces."""

import asyncio
import threading
import time
from collections import deque
from contextlib import suppress
from typing import Any

import can

from drivers.clocks.loop_scale import call_from_thread, loop_scale, settle
from drivers.errors import LinkLost
from drivers.links.can_buses import SlcanBus, SocketcandBus, open_bus
from drivers.links.can_memory import MemoryBus
from drivers.packaged import sentence
from drivers.types import Frame, LinkCounts

# Interfaces whose stamps are the host's time of day, taken by the kernel before any program gets to see the frame.
_STAMPED_BY_KERNEL = ("socketcan", "udp_multicast")
_OLDEST_S = 1.0
_OPEN_LIMIT_S = 5.0
_WAIT_S = 0.1
_SEND_LIMIT_S = 0.1
_MOST_AT_ONCE = 500
_BUS_OFF = 0x40  # in the identifier of an error frame (linux/can/error.h)
_MOST_WAITING = 100_000  # ten seconds of a full bus; older frames are dropped, and count as lost samples


class CanLink:
    """Frames of one CAN bus, stamped on arrival by a separate thread, so that stamps do not wait for the event loop.

    Interface "memory" is a bus within this event loop and has no thread.
    """

    def __init__(self, device: str, interface: str, channel: str, options: dict[str, Any]) -> None:
        """Store the ``interface``, ``channel`` and ``options`` of a bus in python-can's words; ``open`` opens it.

        ``device`` is for errors.
        """
        self._device, self._interface, self._channel = device, interface, channel
        self._options = options
        self._bus: can.BusABC | None = None
        self._thread: threading.Thread | None = None
        self._closing = threading.Event()
        self._frames: deque[Frame] = deque(maxlen=_MOST_WAITING)
        self._wake = asyncio.Event()
        self._waiting = False
        self._ended = ""
        self._openings = 0  # a reader of an earlier one must not wait in this
        self.counts = LinkCounts()

    @property
    def malformed(self) -> int:
        """Number of lines that began like a frame but could not be read, for text interfaces; else 0."""
        return int(getattr(self._bus, "malformed", 0))

    async def open(self) -> None:
        """Open the bus in a thread that then reads it, after closing one that is open.

        A bus "memory" is joined at once, without a thread. Frames received before and not taken yet are dropped.
        LinkLost if the bus cannot be opened, or not within five seconds.
        """
        self.close()
        self._frames = deque(maxlen=_MOST_WAITING)  # a thread that is late to leave has the one before
        self._ended = ""
        self._openings += 1
        if self._interface == "memory":
            self._bus = MemoryBus(self._channel, self._take_from_memory)
            return
        loop = asyncio.get_running_loop()
        opened: asyncio.Future[can.BusABC] = loop.create_future()
        # A daemon, not an executor's thread: a driver that hangs must not keep the program from ending.
        self._thread = threading.Thread(
            target=self._run, args=(loop, opened, self._closing, self._frames), name=f"can {self._device}", daemon=True
        )
        self._thread.start()
        try:
            async with asyncio.timeout(_OPEN_LIMIT_S * max(loop_scale(loop), 1.0)):
                self._bus = await opened
        except TimeoutError:
            self._give_up()
            raise LinkLost(self._device, f"{self._named} did not open within {_OPEN_LIMIT_S:g} s") from None
        except asyncio.CancelledError:
            self._give_up()
            raise
        except Exception as error:  # interfaces raise any exception of their vendors' libraries
            self._give_up()
            raise LinkLost(self._device, sentence("link.no_can", channel=self._named, why=_plain(error))) from None

    async def receive(self) -> list[Frame]:
        """Return the frames since the last call, waiting for the first; LinkLost once the bus is gone and no frame is
        left, or if the link is opened anew meanwhile.
        """
        opening = self._openings
        while not self._frames:
            if self._ended or self._openings != opening:
                raise LinkLost(self._device, self._ended or "the link was closed")
            self._wake.clear()
            self._waiting = True  # before checking for frames, so that the thread cannot miss it
            if not self._frames and not self._ended:
                await self._wake.wait()
        return [self._frames.popleft() for _ in range(len(self._frames))]

    def send(self, frame: Frame) -> None:
        """Send a frame; LinkLost if the bus is not open or does not accept the frame within 0.1 s."""
        if self._bus is None:
            raise LinkLost(self._device, f"{self._named} is not open")
        message = can.Message(arbitration_id=frame.identifier, is_extended_id=frame.extended, data=frame.data)
        try:
            self._bus.send(message, _SEND_LIMIT_S)
        except (can.CanError, OSError, ValueError) as error:
            raise LinkLost(self._device, f"{self._named} does not accept frames ({_plain(error)})") from None

    def end(self, reason: str) -> None:
        """Mark the link as ended, for the first reason given, and wake up the reader."""
        self._ended = self._ended or reason
        self._wake.set()

    def close(self) -> None:
        """Close the bus, wait at most 0.3 s for its thread, and end the link; harmless if it is closed already."""
        thread = self._give_up()
        if thread is not None and thread is not threading.current_thread():
            thread.join(2 * _WAIT_S + _SEND_LIMIT_S)
        if isinstance(self._bus, MemoryBus):
            self._bus.shutdown()
        self._bus = None

    def _end_if_read(self, closing: threading.Event, reason: str) -> None:
        """End the link, unless the reading thread was told to leave meanwhile, perhaps for a new one."""
        if not closing.is_set():
            self.end(reason)

    @property
    def _named(self) -> str:
        return f"CAN bus {self._interface}:{self._channel}"

    def _give_up(self) -> threading.Thread | None:
        """End the link, tell the reading thread to leave the bus, and return it; each thread has its own event."""
        thread, self._thread = self._thread, None
        self.end("the link was closed")
        self._closing.set()
        self._closing = threading.Event()
        return thread

    def _take_from_memory(self, message: can.Message) -> None:
        if (frame := _frame(message, round(asyncio.get_running_loop().time() * 1e9))) is not None:
            self._frames.append(frame)
            self._wake.set()

    def _run(
        self,
        loop: asyncio.AbstractEventLoop,
        opened: asyncio.Future[can.BusABC],
        closing: threading.Event,
        frames: deque[Frame],
    ) -> None:
        """Open the bus, read it into ``frames`` until ``closing`` is set and shut it down, all in the thread, as
        opening may take seconds.

        ``opened``, a future of ``loop``, gets the bus or the exception. If reading fails later, the link ends with that
        reason, unless closing.
        """
        try:
            bus = open_bus(self._interface, self._channel, self._options)
        except Exception as error:
            call_from_thread(loop, settle, opened, error)
            return
        call_from_thread(loop, settle, opened, bus)
        try:
            self._read(loop, bus, closing, frames)
        except Exception as error:  # as above
            call_from_thread(loop, self._end_if_read, closing, f"{self._named} failed ({_plain(error)})")
        finally:
            with suppress(Exception):  # an adapter that is gone cannot be closed
                bus.shutdown()

    def _read(
        self, loop: asyncio.AbstractEventLoop, bus: can.BusABC, closing: threading.Event, frames: deque[Frame]
    ) -> None:
        """Append to ``frames`` until ``closing`` is set, stamp them in time of ``loop``, and wake up ``receive``.

        Frames of slcan and socketcand are read in batches, which have one stamp. Stamps of interfaces that the kernel
        stamps are corrected for the age of the frame, of at most 1 s. Error frames and bus-off are counted, except with
        slcan and socketcand; error and remote frames are not handed on. Exceptions of the bus pass through.
        """
        scale = loop_scale(loop)
        by_kernel = self._interface in _STAMPED_BY_KERNEL
        if isinstance(bus, (SlcanBus, SocketcandBus)):
            # A thousand times a second four frames: a python-can message for each would take a fifth of a core.
            while not closing.is_set():
                if batch := bus.frames(_WAIT_S):
                    t_ns = round(loop.time() * 1e9)
                    frames.extend([Frame(t_ns, *frame) for frame in batch])
                    self._wake_reader(loop)
            return
        while not closing.is_set():
            message, room = bus.recv(_WAIT_S), _MOST_AT_ONCE
            while message is not None:
                age_s = min(max(time.time() - message.timestamp, 0.0), _OLDEST_S) if by_kernel else 0.0
                if (frame := _frame(message, round((loop.time() - age_s * scale) * 1e9))) is not None:
                    frames.append(frame)
                self.counts.error_frames += message.is_error_frame
                self.counts.bus_off += message.is_error_frame and bool(message.arbitration_id & _BUS_OFF)
                room -= 1
                message = bus.recv(0) if room else None
            self._wake_reader(loop)

    def _wake_reader(self, loop: asyncio.AbstractEventLoop) -> None:
        if self._waiting and self._frames:
            self._waiting = False
            call_from_thread(loop, self._wake.set)


def _frame(message: can.Message, t_ns: int) -> Frame | None:
    """Return the frame of a message; error and remote frames carry no data."""
    if message.is_error_frame or message.is_remote_frame:
        return None
    return Frame(t_ns, message.arbitration_id, message.is_extended_id, bytes(message.data))


def _plain(error: BaseException) -> str:
    """Return the cause of an error in one line; python-can's own texts may hold a traceback."""
    cause = error.__cause__ or error
    lines = str(cause).strip().splitlines()
    return lines[0] if lines else type(cause).__name__
