"""Frames and lines of text in a stream of bytes, as a file describes them: a pure codec.

A frame is a message as a DBC describes them: cantools reads and writes its signals. A line becomes such a message:
8 bytes a column.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from drivers.imus.checks import Check

MESSAGE = "frame"
"""Name of the message that is in each frame."""
RESOLUTION, TIME_TICK_S = 1e-9, 1e-6
"""Numbers and times in lines of text are kept to this."""
_LONGEST_LINE = 4096
_MOST = 2.0**62
_DIGITS = 9  # after the point, where numbers are written
_NUMBER = rb"([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d{1,2})?)"


@dataclass(kw_only=True, frozen=True)
class Frames:
    """Binary frames of ``size`` bytes that begin with ``sync`` (None: any byte) and end with ``end``.

    The ``check``, if any, stands at ``at`` and covers the bytes from ``first`` to ``last``, except itself.
    """

    size: int
    sync: tuple[int | None, ...]
    end: bytes = b""
    check: Check | None = None
    at: int = 0
    big: bool = False
    first: int = 0
    last: int = 0

    def scan(self, view: bytes) -> tuple[list[bytes], int, int]:
        """Return the valid frames, the number of false starts (damaged frames), and how many bytes are consumed.

        A frame that is cut off at the end is not consumed, nor are the last bytes, where a sync may begin. Bytes
        between frames are skipped. After a false start (wrong end or check) the search goes on one byte later.
        """
        found: list[bytes] = []
        damaged = at = 0
        while (sync := self._sync.search(view, at)) is not None:
            start = sync.start()
            frame = view[start : start + self.size]
            if len(frame) < self.size:
                return found, damaged, start
            right = frame.endswith(self.end) and frame == self._checked(frame)
            found += [frame] if right else []
            damaged += not right
            at = start + (self.size if right else 1)
        return found, damaged, max(at, len(view) - len(self.sync) + 1)

    def written(self, message: bytes) -> bytes:
        """Return the frame with the signals of a message."""
        begin = bytes(old if new is None else new for old, new in zip(message, self.sync, strict=False))
        return self._checked(begin + message[len(begin) : self.size - len(self.end)] + self.end)

    def _checked(self, frame: bytes) -> bytes:
        """Return the frame with its check, over the bytes from ``first`` to ``last`` without it, made right.

        Unchanged if there is no check.
        """
        if self.check is None:
            return frame
        stop = self.at + self.check.bits // 8
        over = frame[self.first : min(self.at, self.last)] + frame[max(stop, self.first) : self.last]
        check = self.check.of(over).to_bytes(stop - self.at, "big" if self.big else "little")
        return frame[: self.at] + check + frame[stop:]

    @cached_property
    def _sync(self) -> re.Pattern[bytes]:
        return re.compile(b"".join(b"." if byte is None else re.escape(bytes([byte])) for byte in self.sync), re.DOTALL)


@dataclass(frozen=True)
class Lines:
    """Lines of text that begin with ``prefix`` and hold numbers in ``columns``; None stands for a field to skip.

    In the message a number is an integer: its value times the column's factor. A check stands in hex behind the last
    "*" and covers the text before that from character ``first`` on. A blank separator matches any number of blanks.
    """

    columns: tuple[float | None, ...]
    separator: bytes = b","
    prefix: bytes = b""
    check: Check | None = None
    first: int = 0

    def scan(self, view: bytes) -> tuple[list[bytes], int, int]:
        """Return the messages, the number of damaged lines, and how many bytes are consumed.

        A message is not the text but the numbers of a line times their columns' factors, each rounded to a
        little-endian integer of 8 bytes. Text before the first line end is skipped, as it may be half a line; the last
        line end is therefore not consumed. A line counts from its last prefix on. Skipped without being counted are
        blank lines, those without the prefix and those above 4096 bytes. Damaged lines have other columns, a wrong
        check or a number that is too large. Unfinished text is kept for the next call, unless it is above 4096 bytes.
        """
        _, *lines = view.split(b"\n")
        rest = lines.pop() if lines else view
        found, damaged = [], 0
        for line in lines:
            start = line.rfind(self.prefix) if self.prefix else 0
            text = line[start:].strip()
            if start >= 0 and text and len(line) <= _LONGEST_LINE:
                match = self._pattern.fullmatch(text)
                body, _, digits = text.rpartition(b"*")
                sound = match is not None and (self.check is None or digits.upper() == self._digits(body, self.check))
                if match is not None and sound and (message := self._packed(match.groups())):
                    found.append(message)
                else:
                    damaged += 1
        kept = 0 if len(rest) > _LONGEST_LINE else len(rest) + (rest is not view)
        return found, damaged, len(view) - kept

    def written(self, message: bytes) -> bytes:
        """Return the line with the signals of a message, and 0 in the columns that are passed over."""
        numbers = (number / by for number, by in zip(np.frombuffer(message, "<i8"), self._factors, strict=True))
        values = (0.0 if by is None else next(numbers) for by in self.columns)
        texts = (np.format_float_positional(value, _DIGITS, trim="-").encode() for value in values)
        line = self.prefix + self.separator.join(texts)
        return line + (b"" if self.check is None else b"*" + self._digits(line, self.check)) + b"\r\n"

    def _digits(self, body: bytes, check: Check) -> bytes:
        return b"%0*X" % (check.bits // 4, check.of(body[self.first :]))

    def _packed(self, texts: Sequence[bytes]) -> bytes:
        """Return the message, empty if it has no place for a number."""
        numbers = np.array([float(text) * by for text, by in zip(texts, self._factors, strict=True)])
        return bytes(np.rint(numbers).astype("<i8")) if (abs(numbers) <= _MOST).all() else b""

    @property
    def _factors(self) -> list[float]:
        return [by for by in self.columns if by is not None]

    @cached_property
    def _pattern(self) -> re.Pattern[bytes]:
        blank = self.separator.isspace()
        anything = rb"[^ \t]*" if blank else b"[^" + re.escape(self.separator[:1]) + b"]*"
        columns = [anything if by is None else _NUMBER for by in self.columns]
        check = b"" if self.check is None else rb"\*[0-9A-Fa-f]+"
        between = rb"[ \t]+" if blank else rb"[ \t]*" + re.escape(self.separator) + rb"[ \t]*"
        return re.compile(re.escape(self.prefix) + rb"[ \t]*" + between.join(columns) + check)


class Decoder:
    """Finds messages in a stream that may be cut anywhere; damaged ones are dropped and counted."""

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


def signal(name: str, at: int, kind: str, big: bool, scale: float, offset: float) -> Any:
    """Return a cantools signal that starts at byte ``at``; ``kind`` is i, u or f and the number of bits, as in "i16".

    The value is number * scale + offset; ``big`` means big-endian. The range is that of the integer; none for floats.
    """
    from cantools.database import Signal
    from cantools.database.conversion import BaseConversion

    bits, signed, real = int(kind[1:]), kind[0] == "i", kind[0] == "f"
    lowest = -(1 << bits - 1) if signed else 0
    low, high = sorted(end * scale + offset for end in (lowest, lowest + (1 << bits) - 1))
    return Signal(
        name,
        8 * at + 7 * big,
        bits,
        "big_endian" if big else "little_endian",
        signed,
        conversion=BaseConversion.factory(scale, offset, is_float=real),
        minimum=None if real else low,
        maximum=None if real else high,
    )
