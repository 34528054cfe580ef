"""A table of one's own, and its twin: a controller that is asked by numbered lines of text.

A bench file takes it by ``plugins = ["numbered_table.py"]`` and ``protocol = "numbered"``. "17 read x" is answered by
"17 ok -12.5000 20.0000 done": angle in deg, rate in deg/s, and off, busy, done or fault; what is refused, by "17 no".
"""

import math
import re
from collections.abc import Callable

from drivers.errors import DeviceRefused
from drivers.protocols import ByteLink
from drivers.requests.exchange import Framed, Token
from drivers.specs import TableSetup, TableSpec
from drivers.tables.line_table import LineTable
from drivers.types import AxisState, AxisStatus, Identity
from sims.tables.registry import TableTwinSetup
from sims.wires.line_controller import LineDevice

ANSWER = re.compile(rb"(\d+) (ok|no) ?([^\n]*)\n")
READING = re.compile(r"(-?\d+\.\d+) (-?\d+\.\d+) (off|busy|done|fault)")


class NumberedFraming:
    """Requests and answers as bytes; the number tells which answer is whose, so late ones are never mistaken."""

    idle, settle_s, _number = b"\n", 0.0, 0

    def request(self, line: str) -> bytes:
        self._number += 1
        return f"{self._number} {line}\n".encode() if line else b"\n"  # an empty line ends one that was cut

    def answer(self, line: str, received: bytes) -> Framed | None:
        found = self._numbered(received, self._number)
        return Framed(found[3].decode("ascii", "replace"), found[2] == b"no", found.end()) if found else None

    def token(self) -> Token:
        request, number = self.request("?"), self._number
        return Token(request, lambda received: (found := self._numbered(received, number)) and found.span())

    def _numbered(self, received: bytes, number: int) -> re.Match[bytes] | None:
        return next((found for found in ANSWER.finditer(received) if int(found[1]) == number), None)


class NumberedTable(LineTable):
    """The driver."""

    def __init__(self, setup: TableSetup, link: ByteLink) -> None:
        super().__init__(setup, link, NumberedFraming())

    async def open(self) -> None:
        await self._exchange.open()

    async def identify(self) -> Identity:
        return Identity("numbered table")

    async def enable(self) -> None:
        for axis in self.limits:
            await self._sound(axis)
            await self._order("on", axis)

    async def home(self) -> None:
        for axis, most in self.limits.items():  # angles count from home by themselves
            await self.move(axis, 0.0, most.rate_rps / 2, most.acceleration_rps2)
        await self._wait_for_home(0.05)

    async def jog(self, axis: str, rate_rps: float, acceleration_rps2: float) -> None:
        await self._order("jog", axis, rate_rps, acceleration_rps2)

    async def move(self, axis: str, angle_rad: float, rate_rps: float, acceleration_rps2: float) -> None:
        await self._order("move", axis, angle_rad, rate_rps, acceleration_rps2)

    async def read(self, axis: str) -> AxisState:
        answer = await self._exchange.ask(f"read {axis}", READING)
        *told, self._word = answer.text.split()
        angle, rate = ((answer.sent_s, answer.received_s, math.radians(float(text))) for text in told)
        return AxisState.told(angle, rate)

    async def status(self, axis: str) -> AxisStatus:
        await self.read(axis)
        word = self._word
        return AxisStatus(word in ("busy", "done"), word == "done", f"axis {axis}: {word}" * (word == "fault"), word)

    async def stop(self) -> str:
        return await self._rest(lambda axis: (f"stop {axis}",), self.read)

    async def abort(self) -> None:
        await self._rest(lambda axis: (f"off {axis}",), self.read)

    async def disable(self) -> None:
        for axis in self.limits:
            await self._order("off", axis)

    async def _clear_fault(self, axis: str) -> None:
        await self._order("clear", axis)

    async def _order(self, word: str, axis: str, *values: float) -> None:
        self._moved = axis
        line = " ".join([word, axis, *(f"{math.degrees(value):.6f}" for value in values)])
        if (await self._exchange.ask(line, re.compile(""), repeat=word not in ("jog", "move"))).refused:
            raise DeviceRefused(self._device, f"refuses {line!r}")


class NumberedTwin(LineDevice):
    """The twin: the same lines, over the simulated table."""

    ends, skipped = b"\n", b""

    def __init__(self, seat: TableTwinSetup, write: Callable[[bytes], None]) -> None:
        super().__init__(write)
        self._table, self._on = seat.table, set[str]()

    def _take(self, line: bytes) -> None:
        number, *words = line.decode("ascii", "replace").split() or [""]
        try:
            self._write(f"{number} ok {self._carry_out(*words)}\n".encode())
        except (KeyError, TypeError, ValueError):  # refused, or cut on its way
            self._write(f"{number} no\n".encode())

    def _carry_out(self, word: str, axis: str, *values: str) -> str:
        table, motion = self._table, self._table.motion[axis]
        self._on -= set(table.tripped)
        if word == "read":
            on = "done" if motion.settled(table.clock()) else "busy"
            state = "fault" if axis in table.tripped else on if axis in self._on else "off"
            return " ".join([*(f"{math.degrees(value):.4f}" for value in motion.at(table.clock())), state])
        if word in ("jog", "move") and axis in self._on:
            (motion.jog if word == "jog" else motion.move)(table.clock(), *(math.radians(float(v)) for v in values))
        elif word in ("stop", "off"):
            table.stop(axis)
            self._on -= {axis} if word == "off" else set()
        elif word == "on" and axis not in table.tripped:
            self._on.add(axis)
        elif word == "clear":
            table.tripped.pop(axis, None)
        else:
            raise ValueError(word)
        return ""


_WHAT, _LINK = "a controller with numbered lines, an example", "tcp://192.168.1.10:4001"
SPEC = TableSpec(name="numbered", what=_WHAT, link=_LINK, make=NumberedTable, twin=NumberedTwin)
