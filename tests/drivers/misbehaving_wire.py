"""A wire between table and station that does what wires, gateways and other people's firmware do wrong.

A proxy on TCP, or between two pseudo-terminals. It carries requests and replies until ``strike``; then what its
``Kind`` says. What is wrong stays so for the connections there are, with ``lasting`` for later ones, too.
"""

from __future__ import annotations

import asyncio
import random
import socket
import sys
from collections.abc import Callable, Coroutine
from dataclasses import dataclass, field

from pymodbus.framer import FramerRTU

Spoil = Callable[[bytes], bytes]


@dataclass(frozen=True, slots=True)
class Kind:
    """One way to misbehave.

    ``reply`` changes what the table says; ``says`` is what the reason must match, empty where a run may go on.
    """

    name: str
    says: str = ""
    reply: Spoil | None = None
    lasting: bool = False
    deaf: bool = False  # requests vanish
    ends: str = ""  # of the connections at the strike: "close" or "reset"
    refused_s: float = 0.0  # nobody listens for so long
    pieces: bool = False
    late_s: float = 0.0
    once: bool = False
    may_end: bool = False  # a run where answers carry no number


def _put(at: int, change: Callable[[int], int]) -> Spoil:
    def spoil(reply: bytes) -> bytes:
        if len(reply) <= at:
            return reply
        return reply[:at] + bytes((change(reply[at]) & 0xFF,)) + reply[at + 1 :]

    return spoil


def _busy(code: int) -> Spoil:
    return lambda reply: reply[:4] + bytes((0, 3, reply[6], reply[7] | 0x80, code)) if len(reply) > 8 else reply


def _rtu_busy(reply: bytes) -> bytes:
    refusal = bytes((reply[0], reply[1] | 0x80, 6))
    return refusal + FramerRTU.compute_CRC(refusal).to_bytes(2)


_NOISE = random.Random(1).randbytes(40).replace(b":", b";").replace(b"?", b"!")
_LOST = "does not answer|no answer|closed|broke|reset|gone"
_WRONG = "violates Modbus|does not answer|no answer|answers|refuse[sd]|Modbus exception|unknown whether"

COMMON = (
    Kind("closed", "closed|reset|broke", ends="close"),  # reset, if something was on its way
    Kind("reset", "reset|broke|closed", ends="reset"),
    Kind("reset and gone for 0.3 s", "reset|broke|closed|no connection|nothing answers", ends="reset", refused_s=0.3),
    Kind("half-open", _LOST, lambda reply: b"", deaf=True),
    Kind("replies lost", _LOST, lambda reply: b""),
    Kind("replies lost for good", _LOST, lambda reply: b"", lasting=True),
    Kind("requests lost", _LOST, deaf=True),
    Kind("truncated", _WRONG, lambda reply: reply[: len(reply) // 2]),
    Kind("garbage for replies", _WRONG, lambda reply: _NOISE),
    Kind("garbage for good", _WRONG, lambda reply: _NOISE, lasting=True),
    Kind("flood", _WRONG, lambda reply: _NOISE * 500),
    Kind("one reply lost", reply=lambda reply: b"", once=True),
    Kind("byte by byte", pieces=True),
    Kind("doubled", reply=lambda reply: reply + reply, may_end=True),
    Kind("late by 60 ms", late_s=0.06),
)
MODBUS = (
    Kind("byte count too large", "byte count|an echo of different data", _put(8, lambda count: count + 2)),
    Kind("byte count too large once", reply=_put(8, lambda count: count + 2), once=True),
    Kind("byte count too small", "byte count|an echo of different data", _put(8, lambda count: count - 2)),
    Kind("wrong function code", "function code", _put(7, lambda code: 4)),
    Kind("wrong function code for good", "function code", _put(7, lambda code: 4), lasting=True),
    Kind("unknown function code", "function code", _put(7, lambda code: 0x2B)),
    Kind("wrong unit", "unit id", _put(6, lambda unit: unit + 5)),
    Kind("wrong transaction", "transaction number", _put(1, lambda number: number + 7)),
    Kind("wrong protocol", "protocol", _put(3, lambda number: 1)),
    Kind("oversize length", _WRONG, _put(4, lambda length: 0xFF)),
    Kind("length too large", _WRONG, _put(5, lambda length: length + 20)),
    Kind("length zero", _WRONG, _put(5, lambda length: 0)),
    Kind("header alone", _WRONG, lambda reply: reply[:5] + bytes((1, reply[6]))),
    Kind("nothing but a function code", _WRONG, lambda reply: reply[:5] + bytes((2, reply[6], reply[7]))),
    Kind("busy once", reply=_busy(6), once=True),
    Kind("acknowledge once", reply=_busy(5), once=True),
    Kind("gateway target dumb once", reply=_busy(11), once=True),
    Kind("gateway target dumb", "exception 11", _busy(11)),
)
LINES = (
    Kind("line end lost", _WRONG, lambda reply: reply.translate(None, b":\r\n")),
    Kind("letters for digits", _WRONG, lambda reply: reply.translate(bytes.maketrans(b"0123456789", b"OlZEASGTBg"))),
    Kind("numbers without end", _WRONG, lambda reply: reply.replace(b"0", b"0" * 700)),
    Kind("refusals", _WRONG, lambda reply: b"?"),
    Kind("bytes of eight bits", _WRONG, lambda reply: bytes(one | 0x80 for one in reply)),
    Kind("zeros between", _WRONG, lambda reply: b"\0".join(reply[i : i + 1] for i in range(len(reply)))),
    Kind("a line of 5000 characters", _WRONG, lambda reply: b"9" * 5000 + reply),
)
RTU = (
    *(kind for kind in COMMON if not kind.ends and not kind.lasting and not kind.deaf),
    Kind("byte count too large", _LOST, _put(2, lambda count: count + 2)),
    Kind("wrong function code", _LOST, _put(1, lambda code: 4)),
    Kind("wrong unit", _LOST, _put(0, lambda unit: unit + 5)),
    Kind("a bit flipped", _LOST, _put(3, lambda one: one ^ 0x10)),
    Kind("busy", "Modbus exception 6, device busy", _rtu_busy),
    Kind("busy once", reply=_rtu_busy, once=True),
    Kind("busy as TCP has it", _LOST, lambda reply: b"\0\1\0\0\0\3" + reply[:3]),
)
KINDS = {"modbus": COMMON + MODBUS, "galil": COMMON + LINES, "acutrol": COMMON + LINES, "rtu": RTU}


class _End(asyncio.Protocol):
    """One end of a connection through the proxy; what comes before the other end is there waits for it."""

    def __init__(self, take: Callable[[_End, bytes], None], gone: Callable[[_End], None]) -> None:
        self._take, self._gone = take, gone
        self.transport: asyncio.Transport | None = None
        self.other: _End | None = None
        self.spoilt, self.ends_at_once = False, ""
        self._waiting = b""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = transport  # type: ignore[assignment]
        self.write(b"")
        if self.ends_at_once:
            self.end(reset=self.ends_at_once == "reset")

    def data_received(self, data: bytes) -> None:
        self._take(self, data)

    def connection_lost(self, error: Exception | None) -> None:
        self._gone(self)

    def write(self, data: bytes) -> None:
        self._waiting += data
        if self.transport is not None and not self.transport.is_closing():
            self.transport.write(self._waiting)
            self._waiting = b""

    def end(self, *, reset: bool = False) -> None:
        if self.transport is None:
            return
        if reset:
            linger = b"\1\0\0\0\0\0\0\0"
            self.transport.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, linger)
        self.transport.close()


@dataclass
class Proxy:
    """Carries bytes to a port of this machine, well until ``strike``."""

    port: int = 0
    kind: Kind | None = None
    struck_s: float = float("inf")
    # An address of its own, where Linux has more than one: a port that is closed for a while is not lent to others.
    where: tuple[str, int] = ("127.0.0.2" if sys.platform == "linux" else "127.0.0.1", 0)
    _spoilt: int = 0
    _closed: bool = False
    _known: bool = False  # whether a station has connected
    _server: asyncio.Server | None = None
    _ends: set[_End] = field(default_factory=set)  # those of the station
    _tasks: set[asyncio.Task[object]] = field(default_factory=set)

    async def listen(self) -> None:
        """Take connections."""
        loop = asyncio.get_running_loop()
        self._server = await loop.create_server(self._welcome, *self.where)
        self.where = self._server.sockets[0].getsockname()[:2]
        if self._closed:
            self._server.close()

    def strike(self, kind: Kind) -> None:
        """Misbehave from now on."""
        loop = asyncio.get_running_loop()
        self.kind, self.struck_s = kind, loop.time()
        if kind.refused_s and self._server is not None:
            self._server.close()
            loop.call_later(kind.refused_s, lambda: None if self._closed else self._keep(self.listen()))
        for end in tuple(self._ends):
            end.spoilt = True
            if kind.ends:
                end.end(reset=kind.ends == "reset")

    async def close(self) -> None:
        """Leave nothing behind."""
        self._closed = True
        if self._server is not None:
            self._server.close()
        for task in tuple(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        for end in tuple(self._ends):
            for side in (end, end.other):
                if side is not None and side.transport is not None:
                    side.transport.abort()
        await asyncio.sleep(0.01)

    def _keep(self, work: Coroutine[object, object, object]) -> None:
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    def _welcome(self) -> _End:
        near = _End(self._up, self._part)
        near.spoilt = self.kind is not None and (self.kind.lasting or not self._known)
        near.ends_at_once = self.kind.ends if self.kind is not None and not self._known else ""
        self._known = True
        near.other = _End(self._down, self._part)
        near.other.other = near
        self._ends.add(near)
        self._keep(asyncio.get_running_loop().create_connection(lambda: near.other, "127.0.0.1", self.port))  # type: ignore[arg-type, return-value]
        return near

    def _part(self, end: _End) -> None:
        self._ends.discard(end)
        if end.other is not None:
            end.other.end()

    def _up(self, end: _End, data: bytes) -> None:
        for piece in self.requests(data, end.spoilt):
            self._carry(end, piece)

    def _down(self, end: _End, data: bytes) -> None:
        assert end.other is not None
        for piece in self.replies(data, end.other.spoilt):
            self._carry(end, piece)

    def _carry(self, end: _End, data: bytes) -> None:
        assert end.other is not None
        if self.kind is not None and self.kind.late_s:
            asyncio.get_running_loop().call_later(self.kind.late_s / 2, end.other.write, data)
        else:
            end.other.write(data)

    def requests(self, data: bytes, spoilt: bool = True) -> list[bytes]:
        """Return what reaches the table of a request."""
        return [] if self.kind is not None and spoilt and self.kind.deaf else [data]

    def replies(self, data: bytes, spoilt: bool = True) -> list[bytes]:
        """Return what reaches the station of a reply."""
        kind = self.kind
        if kind is None or not spoilt or (kind.once and self._spoilt):
            return [data]
        self._spoilt += 1
        data = kind.reply(data) if kind.reply is not None else data
        return [data[i : i + 1] for i in range(len(data))] if kind.pieces else [data] if data else []
