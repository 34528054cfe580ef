"""Which Modbus reply belongs to which request: filters of received bytes, without I/O.

TCP numbers its requests, so a reply tells which one it answers. RTU does not: a reply that comes after its time-out
looks like the answer to the next request of the same kind. So the requests of each unit that may still be answered are
kept in their order, by how their replies would begin. Devices answer in order: a reply belongs at the earliest to the
first of those that it fits; what was asked before that one is past, what was asked after it may still come. A reply can
be believed when it leaves nothing that may still come.
"""

import struct
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

from pymodbus.framer import FramerRTU

from drivers.types import LinkCounts

READ, WRITE_ONE, WRITE_MORE = 3, 6, 16
_KINCO_BAD_READ = 0x81  # in Kinco's manuals, where the standard has 0x83
_TCP_HEADER = 6
_LONGEST_PDU = 253
_FIELDS = (
    ("protocol number", 2, 4),
    ("unit id", 6, 7),
    ("function code", 7, 8),
    ("length", 4, 6),
    ("byte count", 8, 9),
)


@dataclass(kw_only=True, frozen=True, slots=True)
class Request:
    """A read of ``count`` registers, or a write of ``words`` if there are any; ``axis`` and ``register`` are for
    messages.
    """

    axis: str
    unit_id: int
    register: str
    address: int
    count: int
    words: tuple[int, ...] = ()

    @property
    def function(self) -> int:
        """Modbus function code."""
        if not self.words:
            return READ
        return WRITE_ONE if self.count == 1 else WRITE_MORE

    @property
    def head(self) -> bytes:
        """First bytes of its RTU reply; data and CRC follow, so this also determines the length."""
        if not self.words:
            return bytes((self.unit_id, READ, 2 * self.count))
        echoed = self.words[0] if self.count == 1 else self.count
        return struct.pack(">BBHH", self.unit_id, self.function, self.address, echoed)

    @property
    def refusals(self) -> tuple[bytes, ...]:
        """First bytes that an exception reply to it may have on RTU."""
        codes = (READ | 0x80, _KINCO_BAD_READ) if self.function == READ else (self.function | 0x80,)
        return tuple(bytes((self.unit_id, code)) for code in codes)


class Pending:
    """Requests of one unit that may still be answered, oldest first, by the heads of their replies."""

    def __init__(self) -> None:
        """Begin without requests."""
        self._asked: deque[tuple[bytes, float]] = deque()

    def __len__(self) -> int:
        return len(self._asked)

    def __contains__(self, head: object) -> bool:
        return any(asked == head for asked, _ in self._asked)

    def add(self, head: bytes, now_s: float) -> None:
        """Note that something was asked."""
        self._asked.append((head, now_s))

    def answered(self, head: bytes) -> None:
        """Strike off the first that a reply fits, and all before it."""
        while self._asked and self._asked.popleft()[0] != head:
            pass

    def forget(self, before_s: float) -> None:
        """Remove requests sent before ``before_s``, whose replies cannot come any more."""
        while self._asked and self._asked[0][1] < before_s:
            self._asked.popleft()

    def last(self, head: bytes) -> int:
        """Return the place of the last that a reply fits, -1 without one."""
        return max((place for place, (asked, _) in enumerate(self._asked) if asked == head), default=-1)


class RtuGate:
    """A ``trace_packet`` hook of the client that lets only the awaited frame through.

    With each new byte, the client shows everything received since it last sent.
    """

    def __init__(self, counts: LinkCounts) -> None:
        """Let no frame through until ``expect`` has named one; dropped frames are counted in ``counts``."""
        self._counts = counts
        self._armed: tuple[bytes, ...] = ()
        self._expected: tuple[bytes, ...] = ()
        self._seen = 0
        self._damaged = False
        self.heard = False
        """Whether anything has come since the last request."""
        self.refusal: int | None = None
        """Code of the last refusal that came; to which request nobody can tell. To be reset by who asks."""

    @property
    def answered(self) -> bool:
        """Whether the reply to the last request has come."""
        return not self._expected

    def expect(self, *heads: bytes) -> None:
        """After the next request, let through the first frame that begins with one of these heads."""
        self._armed = heads

    def __call__(self, sending: bool, data: bytes) -> bytes:
        """Return the bytes the client may send, or the awaited frame if it has come, else nothing.

        ``data`` are bytes to send if ``sending``, else all bytes received since. Frames that are not awaited count as
        late; bytes outside frames count as one corrupt frame, once the next request is sent. The code of a refusal is
        kept.
        """
        if sending:
            self._counts.corrupt += self._damaged
            self._expected, self._seen, self._damaged, self.heard = self._armed, 0, False, False
            return data
        self.heard = True
        frames = list(rtu_frames(data))
        if self._expected:
            self._damaged = len(data) > sum(map(len, frames))
        if len(frames) < self._seen:  # the client emptied its buffer
            self._seen = 0
        accepted = b""
        for frame in frames[self._seen :]:
            if self._expected and frame.startswith(self._expected):
                accepted, self._expected = frame, ()
            else:
                self._counts.late += 1
            if frame[1] & 0x80:
                self.refusal = frame[2]
        self._seen = len(frames)
        return accepted


class TcpGate:
    """A ``trace_packet`` hook that passes only the exact answer to the last request: the client fails on anything else.

    Header, unit id, function code, and the byte count or echo, are all known before the reply comes (Modbus Messaging
    on TCP/IP V1.0b, 3.1.3; Application Protocol V1.1b3, 6).
    """

    def __init__(self, counts: LinkCounts) -> None:
        """Start before the first request; dropped frames are counted in ``counts``."""
        self._counts = counts
        self._heads: tuple[bytes, ...] = ()
        self._seen = 0
        self._unanswered: set[int] = set()  # transaction numbers whose replies may still come
        self.answered = True
        """Whether the reply to the last request has come."""
        self.wrong = ""
        """What was wrong with what came last in its place."""

    def __call__(self, sending: bool, data: bytes) -> bytes:
        """Return the bytes the client may send, or the complete answer if it has come, else nothing.

        ``data`` are bytes to send if ``sending``, else all bytes received since. Other frames are counted; after the
        answer nothing passes until the next request.
        """
        if sending:
            if not self.answered:
                self._unanswered.add(int.from_bytes(self._heads[0][:2]))
            self._heads = tuple(_tcp_heads(data))
            self._seen, self.answered, self.wrong = 0, False, ""
            return data
        self._seen = 0 if len(data) < self._seen else self._seen  # the client emptied its buffer
        if self.answered:
            return b""
        for head in self._heads:
            at = data.find(head)
            end = at + _TCP_HEADER + int.from_bytes(head[4:6])
            if at >= 0 and end <= len(data):
                self.answered = True
                self._count(data[:at])
                return data[at:end]
        self._count(data)
        return b""

    def _count(self, data: bytes) -> None:
        """Count complete frames that are not the answer, as late, foreign or corrupt; describe the last in ``wrong``.

        Late is an answer to an earlier request, which is not described; foreign one that nobody asked for; corrupt one
        with the number of the request. A header that is not Modbus makes all bytes received so far corrupt. An
        incomplete frame is left for later.
        """
        while self._seen + _TCP_HEADER + 1 < len(data):
            frame = data[self._seen :]
            size = int.from_bytes(frame[4:6])
            if frame[2:4] != bytes(2) or not 2 <= size <= _LONGEST_PDU + 1:
                self._counts.corrupt += 1
                self.wrong = _difference(frame, self._heads[0])
                self._seen = len(data)
                return
            if len(frame) < _TCP_HEADER + size:
                return
            self._seen += _TCP_HEADER + size
            number, asked = int.from_bytes(frame[:2]), int.from_bytes(self._heads[0][:2])
            if number != asked and number in self._unanswered:
                self._counts.late += 1
            else:
                self._counts.foreign += number != asked
                self._counts.corrupt += number == asked
                self.wrong = _difference(frame, self._heads[0])


def _tcp_heads(request: bytes) -> Iterator[bytes]:
    """Yield the possible beginnings of the reply to a request on TCP: that of the answer, then of one or two refusals.

    That of a write's answer is all of it.
    """
    function = request[7]
    if function == READ:
        count = 2 * int.from_bytes(request[10:12])
        yield request[:4] + struct.pack(">HBBB", 3 + count, request[6], READ, count)
    else:
        yield request[:4] + struct.pack(">H", 6) + request[6:12]
    for code in (function | 0x80, *((_KINCO_BAD_READ,) if function == READ else ())):
        yield request[:4] + struct.pack(">HBB", 3, request[6], code)


def _difference(frame: bytes, head: bytes) -> str:
    """Return in words the first field in which a frame differs from the awaited head; else that its data do."""
    if frame[:2] != head[:2]:
        return "transaction numbers that were not requested. Does a gateway change them?"
    for name, start, end in _FIELDS[: None if head[7] == READ else -1]:
        if frame[start:end] != head[start:end]:
            return f"{name} {int.from_bytes(frame[start:end])} in place of {int.from_bytes(head[start:end])}"
    return "an echo of different data"


def rtu_frames(data: bytes) -> Iterator[bytes]:
    """Yield the frames in ``data`` that are replies with a valid CRC, skipping other bytes and an unfinished frame."""
    at = 0
    while at + 5 <= len(data):
        size = _reply_size(data, at)
        frame = data[at : at + size]
        if size and len(frame) == size and FramerRTU.check_CRC(frame[:-2], int.from_bytes(frame[-2:])):
            yield frame
            at += size
        else:
            at += 1


def _reply_size(data: bytes, at: int) -> int:
    function = data[at + 1]
    if function & 0x80:
        return 5
    if function in (WRITE_ONE, WRITE_MORE):
        return 8
    return 5 + data[at + 2] if function == READ else 0
