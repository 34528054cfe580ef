"""Frames and lines of text in a stream of bytes, as a file describes them: a pure codec.

A frame is a message as a DBC describes them: cantools reads and writes its signals. A line becomes such a message:
8 bytes a column.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from drivers.imus.described.checks import Check

MESSAGE = "frame"
"""Name of the message that is in each frame."""
LONGEST = 4096
"""Bytes of the longest frame or line: what would be longer is none."""
TIME_TICK_S = 1e-6
"""Times in lines of text are kept to this."""
_DIGITS = 9  # after the point, where numbers are written
_NUMBER = rb"[ \t]*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d{1,2})?)[ \t]*"


@dataclass(frozen=True, slots=True)
class Number:
    """A number in a frame: "i", "u" or "f", and how many bytes it takes from ``at`` on, from the end if below 0.

    What it stands for is number * ``scale`` + ``offset``.
    """

    at: int
    kind: str
    size: int
    big: bool = False
    scale: float = 1.0
    offset: float = 0.0

    def bounds(self, frame: bytes | bytearray) -> tuple[int, int]:
        """Return its first byte and the one behind it."""
        start = self.at % len(frame)
        return start, start + self.size

    def read(self, frame: bytes) -> int:
        """Return the number, which has no sign."""
        return int.from_bytes(frame[slice(*self.bounds(frame))], "big" if self.big else "little")

    def write(self, frame: bytearray, number: int) -> None:
        """Put a number without sign there."""
        frame[slice(*self.bounds(frame))] = number.to_bytes(self.size, "big" if self.big else "little")


def database_of(numbers: Mapping[str, Number], size: int) -> Any:
    """Return cantools' database of one message of ``size`` bytes that has these numbers; ValueError if they overlap."""
    import cantools.database as dbc
    from cantools.database.conversion import BaseConversion

    signals = []
    for name, of in numbers.items():
        limits: list[float | None] = [None, None]
        bits = 8 * of.size
        if of.kind != "f":
            lowest = -(1 << bits - 1) if of.kind == "i" else 0
            limits[:] = sorted(end * of.scale + of.offset for end in (lowest, lowest + (1 << bits) - 1))
        signal = dbc.Signal(
            name,
            8 * (of.at % size) + 7 * of.big,
            bits,
            "big_endian" if of.big else "little_endian",
            of.kind == "i",
            conversion=BaseConversion.factory(of.scale, of.offset, is_float=of.kind == "f"),
            minimum=limits[0],
            maximum=limits[1],
        )
        signals.append(signal)
    try:
        return dbc.Database([dbc.Message(0, MESSAGE, size, signals)])
    except dbc.errors.Error as error:
        raise ValueError(str(error)) from None


@dataclass(frozen=True, slots=True)
class FrameCheck:
    """Where the check of a frame is, and which bytes it is over: from ``first`` to ``end``, less its own."""

    rule: Check
    place: Number
    first: int = 0
    end: int | None = None

    def of(self, frame: bytes | bytearray) -> int:
        """Return the check that a frame should carry."""
        start, stop = self.place.bounds(frame)
        end = len(frame) if self.end is None else self.end % len(frame)
        return self.rule.of(bytes(frame[self.first : min(start, end)] + frame[max(stop, self.first) : end]))


@dataclass(frozen=True, slots=True)
class Frames:
    """Binary frames of ``size`` bytes that have the bytes ``equals`` at their places and begin with ``sync``.

    Where a ``length`` field says how many bytes a frame has beside ``plus`` others, messages of other sizes may lie
    between; where there is a check, other messages of the same size.
    """

    sync: bytes
    size: int
    equals: tuple[tuple[int, bytes], ...] = ()
    length: Number | None = None
    plus: int = 0
    check: FrameCheck | None = None

    def scan(self, view: bytes) -> tuple[list[bytes], int, int]:
        """Return the frames, how many places began like one and are none, and how many bytes are done with."""
        found: list[bytes] = []
        damaged = at = 0
        while (start := view.find(self.sync, at)) >= 0:
            size = self._size(view[start : start + LONGEST])
            if start + size > len(view):
                return found, damaged, start
            frame = view[start : start + size]
            if frame and self._right(frame):
                found += [frame] if self._ours(frame) else []
                at = start + size
            else:
                damaged += 1
                at = start + 1
        return found, damaged, max(at, len(view) - len(self.sync) + 1)

    def written(self, message: bytes) -> bytes:
        """Return the frame with the signals of a message."""
        frame = bytearray(message)
        for at, same in ((0, self.sync), *self.equals):
            frame[at % self.size : at % self.size + len(same)] = same
        if self.length is not None:
            self.length.write(frame, self.size - self.plus)
        if self.check is not None:
            self.check.place.write(frame, self.check.of(frame))
        return bytes(frame)

    def _size(self, view: bytes) -> int:
        """Return the size of the frame that begins here, beyond the view if more is needed to tell; 0 if it is none."""
        if self.length is None:
            return self.size
        header = self.length.at + self.length.size
        if header > len(view):
            return header
        size = self.length.read(view) + self.plus
        return size if header <= size <= LONGEST else 0

    def _right(self, frame: bytes) -> bool:
        if self.check is not None and len(frame) >= self.check.place.size:
            return self.check.place.read(frame) == self.check.of(frame)
        return self.check is None and (self.length is not None or self._ours(frame))

    def _ours(self, frame: bytes) -> bool:
        return len(frame) == self.size and all(frame.startswith(same, at % self.size) for at, same in self.equals)


@dataclass(frozen=True)
class Lines:
    """Lines of text that begin with ``prefix``; columns "-" are passed over, ``whole`` ones are kept as integers.

    These are multiplied by what ``whole`` says. A check stands behind the last "*", in hex, and is over what stands
    before that, from character ``first`` on. A separator of blanks is any number of them.
    """

    columns: tuple[str, ...]
    separator: bytes = b","
    prefix: bytes = b""
    check: Check | None = None
    first: int = 0
    whole: dict[str, float] = field(default_factory=dict)

    def scan(self, view: bytes) -> tuple[list[bytes], int, int]:
        """Return the messages, how many lines were damaged, and how many bytes are done with.

        The end of the last line is not: what stands before the first end of a line may be half of one.
        """
        _, *lines = view.split(b"\n")
        rest = lines.pop() if lines else view
        found, damaged = [], 0
        for line in lines:
            start = line.rfind(self.prefix) if self.prefix else 0
            text = line[start:].rstrip(b"\r")
            if start >= 0 and text and len(line) <= LONGEST:
                match = self._pattern.fullmatch(text)
                if match is not None and self._checked(text):
                    found.append(self._packed.pack(*map(self._number, self._names, match.groups())))
                else:
                    damaged += 1
        kept = 0 if len(rest) > LONGEST else len(rest) + (rest is not view)
        return found, damaged, len(view) - kept

    def written(self, message: bytes) -> bytes:
        """Return the line with the signals of a message, and 0 in the columns that are passed over."""
        numbers = dict(zip(self._names, self._packed.unpack(message), strict=True))
        numbers |= {name: numbers[name] / by for name, by in self.whole.items()}
        texts = (np.format_float_positional(numbers.get(name, 0.0), _DIGITS, trim="-") for name in self.columns)
        line = self.prefix + self.separator.join(text.encode() for text in texts)
        if self.check is not None:
            line += b"*%0*X" % (self.check.bits // 4, self.check.of(line[self.first :]))
        return line + b"\r\n"

    @property
    def _names(self) -> list[str]:
        return [name for name in self.columns if name != "-"]

    @cached_property
    def _packed(self) -> struct.Struct:
        return struct.Struct("<" + "".join("q" if name in self.whole else "d" for name in self._names))

    @cached_property
    def _pattern(self) -> re.Pattern[bytes]:
        blank = self.separator.isspace()
        anything = rb"[^ \t]*" if blank else b"[^" + re.escape(self.separator[:1]) + b"]*"
        columns = [anything if name == "-" else _NUMBER for name in self.columns]
        check = b"" if self.check is None else rb"\*[0-9A-Fa-f]{%d}" % (self.check.bits // 4)
        between = rb"[ \t]+" if blank else re.escape(self.separator)
        return re.compile(re.escape(self.prefix) + between.join(columns) + check)

    def _number(self, name: str, text: bytes) -> float | int:
        return round(float(text) * self.whole[name]) % (1 << 63) if name in self.whole else float(text)

    def _checked(self, line: bytes) -> bool:
        body, _, check = line.rpartition(b"*")
        return self.check is None or self.check.of(body[self.first :]) == int(check, 16)


class Decoder:
    """Finds messages in a stream that is cut anywhere. What is damaged is dropped and counted."""

    def __init__(self, framing: Frames | Lines) -> None:
        """Start in the middle of a stream."""
        self._framing, self._rest = framing, b""
        self.damaged = 0

    def feed(self, data: bytes) -> list[bytes]:
        """Return the messages that these bytes complete."""
        view = self._rest + data
        found, damaged, done = self._framing.scan(view)
        self._rest = view[done:]
        self.damaged += damaged
        return found
