"""STIM300 datagrams on the line (Sensonor TS1524 rev. 31): a pure codec, bytes to blocks and back."""

import re
import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from drivers.imus.stim300.special import SPECIAL_IDS, SPECIAL_LAYOUTS, Special
from drivers.types import Flags, Floats, Ints, Octets

INTERNAL_RATE_HZ = 2000
"""The counter counts samples at this rate, whatever the datagram rate."""
COUNTER_MODULUS = 256
TEMPERATURE_LSB_C = 2.0**-8
INCLINOMETER_LSB_G = 2.0**-22

STATUS_INTEGRITY = 0x80
STATUS_START_UP = 0x40
STATUS_OVERLOAD = 0x10
STATUS_CHANNEL = 0x08
STATUS_AXES = (0x01, 0x02, 0x04)
"""Which of x, y, z an overload or channel error is about."""

ASK_PART_NUMBER = b"N\r"
ASK_SERIAL_NUMBER = b"I\r"
ASK_CONFIGURATION = b"C\r"
ASK_BIAS_TRIM = b"T\r"
ASK_EXTENDED_ERROR = b"E\r"
RESET = b"R\r"
UTILITY_MODE = b"UTILITYMODE\r"

_LINE_END = b"\r\n"
_STATED_CRC = struct.Struct("<I")
_REVERSED = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))


@dataclass(frozen=True)
class Layout:
    """The groups of a datagram besides the gyros, and the padding of its CRC."""

    accelerometer: bool = False
    inclinometer: bool = False
    temperature: bool = False
    extra: bool = False  # PPS or AUX group

    @cached_property
    def groups(self) -> tuple[tuple[str, int, int], ...]:
        """Groups in their order: name, how many numbers, and of how many bytes each. A status byte follows each."""
        clusters = ["gyro", *(name for name in ("accelerometer", "inclinometer") if getattr(self, name))]
        temperatures = [(f"{name}_temperature", 3, 2) for name in clusters if self.temperature]
        return (*((name, 3, 3) for name in clusters), *temperatures, *([("extra", 1, 3)] if self.extra else []))

    @cached_property
    def size(self) -> int:
        """Bytes from the id to the CRC, without line termination."""
        return 1 + sum(numbers * width + 1 for _, numbers, width in self.groups) + 3 + 4


_PLAIN_IDS = (0x90, 0x91, 0x92, 0x93, 0x94, 0xA5, 0xA6, 0xA7)
_PPS_IDS = (0xF0, 0xF1, 0xF2, 0xF3, 0xF4, 0xF5, 0xF6, 0xF7)
_AUX_IDS = (0x98, 0x99, 0x9A, 0x9B, 0x9C, 0xAD, 0xAE, 0xAF)
LAYOUTS = {
    identifier: Layout(bool(i & 1), bool(i & 2), bool(i & 4), extra=ids is not _PLAIN_IDS)
    for ids in (_PLAIN_IDS, _PPS_IDS, _AUX_IDS)
    for i, identifier in enumerate(ids)
}
DATAGRAM_CODES = dict(zip("01234567lmnpqrst", (*_PLAIN_IDS, *_PPS_IDS), strict=True))
"""Ids of normal datagrams by the code that service and utility mode have for them."""

_ANY_ID = re.compile(b"[" + b"".join(re.escape(bytes([i])) for i in (*LAYOUTS, *SPECIAL_LAYOUTS)) + b"]")


@dataclass(frozen=True, slots=True, eq=False)
class Datagrams:
    """Consecutive normal datagrams of one kind, as raw numbers.

    ``groups`` has the numbers (n, k) and the status (n,) of each group of the layout: gyro, accelerometer,
    inclinometer, NAME_temperature of each of these, and extra (PPS, us since the last pulse, or AUX).
    """

    identifier: int
    counter: Ints
    latency_us: Ints
    groups: Mapping[str, tuple[Ints, Ints]]
    ends: Ints | None = None  # (n,) bytes fed to the decoder up to the end of each


def crc32_mpeg2(data: bytes) -> int:
    """Return CRC-32/MPEG-2 (poly 04C11DB7, init FFFFFFFF, not reflected, no final xor).

    zlib's CRC-32 is the same polynomial with every bit order reversed, so it does the work at C speed.
    """
    reflected = zlib.crc32(data.translate(_REVERSED)) ^ 0xFFFFFFFF
    return int.from_bytes(reflected.to_bytes(4, "little").translate(_REVERSED), "big")


class Stim300Decoder:
    """Finds normal and special datagrams in a stream. Malformed input is dropped and counted, never raised.

    A CR LF behind a datagram belongs to it, whether or not the device is set to send it.
    """

    def __init__(self) -> None:
        """Start with nothing read."""
        self._buffer = b""
        self._behind_datagram = False
        self._position = 0  # of the buffer in the stream
        self.dropped_bytes = 0
        self.bad_datagrams = 0

    def feed(self, data: bytes) -> list[Datagrams | Special]:
        """Return the datagrams completed by ``data``, in order; consecutive normal ones of a kind are returned
        together.

        Bytes that begin no datagram are counted as dropped. Damaged datagrams are counted and searched again from their
        second byte, which drops the first. A CR LF behind a datagram is skipped. An unfinished datagram at the end is
        kept for the next call.
        """
        view = self._buffer + data
        reversed_view = view.translate(_REVERSED)
        found: list[Datagrams | Special] = []
        at = 0
        while at < len(view):
            if self._behind_datagram:
                if view[at : at + 2] == _LINE_END:
                    at += 2
                elif view[at:] == _LINE_END[:1]:
                    break
                self._behind_datagram = False
                continue
            layout = LAYOUTS.get(view[at])
            special = SPECIAL_LAYOUTS.get(view[at])
            any_layout = layout or special
            if any_layout is None:
                start, at = at, _next_id(view, at)
                self.dropped_bytes += at - start
            elif at + any_layout.size > len(view):
                break
            elif not _intact(reversed_view, at, any_layout.size, _padding(any_layout.size)):
                self.bad_datagrams += 1
                self.dropped_bytes += 1
                at += 1
            elif layout is not None:
                part, at = self._run(view, reversed_view, at, layout)
                found.append(part)
                self._behind_datagram = True
            elif special is not None:
                found.append(special.kind.parse(view[at + 1 : at + 1 + special.length]))
                at += special.size
                self._behind_datagram = True
        self._buffer = view[at:]
        self._position += at
        return found

    def _run(self, view: bytes, reversed_view: bytes, start: int, layout: Layout) -> tuple[Datagrams, int]:
        """Return the intact datagrams of one kind that follow one another from ``start``, and where the last one ends.

        The first is known to be intact and of this ``layout``. The run ends at another kind, a wrong CRC, another line
        termination or an unfinished datagram. The end is without CR LF. ``reversed_view`` is ``view`` with the bits of
        each byte reversed.
        """
        size, identifier, padding = layout.size, view[start], _padding(layout.size)
        step = size + 2 if view[start + size : start + size + 2] == _LINE_END else size
        tail = view[start + size : start + step]
        at = start + step
        while (
            at + size <= len(view)
            and view[at] == identifier
            and view[at - len(tail) : at] == tail
            and _intact(reversed_view, at, size, padding)
        ):
            at += step
        count = (at - start) // step
        last = at - len(tail)
        rows = np.frombuffer(view[start:last] + tail, dtype=np.uint8).reshape(count, step)
        ends = self._position + start + size + step * np.arange(count)
        return _parse(rows, layout, ends), last


def encode(datagrams: Datagrams, *, line_termination: bool = False) -> bytes:
    """Return the bytes of normal datagrams as the device sends them, each with CR LF if ``line_termination``.

    Counters are reduced to their modulus. ValueError if a group of their identifier is missing, KeyError if the
    identifier is not that of a normal datagram.
    """
    layout = LAYOUTS[datagrams.identifier]
    rows = np.zeros((len(datagrams.counter), layout.size - 4), dtype=np.uint8)
    rows[:, 0] = datagrams.identifier
    column = 1
    for name, numbers, width in layout.groups:
        if name not in datagrams.groups:
            raise ValueError(f"this datagram needs values and status of {name}, which its id names")
        values, status = datagrams.groups[name]
        rows[:, column : column + numbers * width] = _big_endian(values, width)
        column += numbers * width + 1
        rows[:, column - 1] = status
    rows[:, column] = datagrams.counter % COUNTER_MODULUS
    rows[:, column + 1 : column + 3] = _big_endian(datagrams.latency_us[:, None], 2)
    padding, tail = _padding(layout.size), _LINE_END if line_termination else b""
    bodies = [row.tobytes() for row in rows]
    return b"".join(body + crc32_mpeg2(body + padding).to_bytes(4, "big") + tail for body in bodies)


def encode_special(value: Special, *, line_termination: bool = False) -> bytes:
    """Return the bytes of a special datagram, with CR LF if ``line_termination``.

    The id depends on both. ValueError for a part or serial number of the wrong form.
    """
    identifier = SPECIAL_IDS[type(value), line_termination]
    body = bytes([identifier]) + value.payload()
    crc = crc32_mpeg2(body + _padding(SPECIAL_LAYOUTS[identifier].size))
    return body + crc.to_bytes(4, "big") + (_LINE_END if line_termination else b"")


def invalid_channels(status: Ints) -> Flags:
    """Return as flags (n, 3) which of x, y, z the device declares invalid, by the status (n,) of their cluster.

    Integrity error and start-up concern all axes; channel error and overload the axes named, or all if none is named.
    """
    everything = (status & (STATUS_INTEGRITY | STATUS_START_UP)) != 0
    some = (status & (STATUS_CHANNEL | STATUS_OVERLOAD)) != 0
    named = (status[:, None] & np.array(STATUS_AXES)) != 0
    named |= ~named.any(axis=1)[:, None]  # no axis named: any may be meant
    return np.asarray(everything[:, None] | (some[:, None] & named))


def vouched(raw: Ints, status: Ints) -> Floats:
    """Return raw numbers (n, 3) as floats, NaN where the device itself calls them invalid by their status (n,)."""
    values = raw.astype(np.float64)
    if status.any():
        values[invalid_channels(status)] = np.nan
    return values


def _next_id(view: bytes, start: int) -> int:
    match = _ANY_ID.search(view, start)
    return match.start() if match else len(view)


def _padding(size: int) -> bytes:
    """Return the zero bytes that enter the CRC of a datagram but are not sent."""
    return bytes(-(size - 4) % 4)


def _intact(reversed_view: bytes, start: int, size: int, padding: bytes) -> bool:
    """Return whether the CRC is right, all in reversed bit order: see ``crc32_mpeg2``."""
    end = start + size - 4
    crc = zlib.crc32(padding, zlib.crc32(reversed_view[start:end])) ^ 0xFFFFFFFF
    return bool(crc == _STATED_CRC.unpack_from(reversed_view, end)[0])


def _parse(rows: Octets, layout: Layout, ends: Ints) -> Datagrams:
    """Return the fields of intact datagrams, rows (n, size) of bytes; ``ends`` (n,) are their ends in the stream."""
    column = 1
    groups = {}
    for name, numbers, width in layout.groups:
        values = _signed(rows[:, column : column + numbers * width], width)
        column += numbers * width + 1
        groups[name] = values, rows[:, column - 1].astype(np.int64)
    latency_us = rows[:, column + 1].astype(np.int64) * 256 + rows[:, column + 2]
    return Datagrams(int(rows[0, 0]), rows[:, column].astype(np.int64), latency_us, groups, ends)


def _signed(raw: Octets, width: int) -> Ints:
    """Return big-endian two's complement numbers of ``width`` bytes: from (n, k * width) to (n, k)."""
    numbers = raw.reshape(len(raw), -1, width).astype(np.int64)
    value = numbers[..., 0]
    for byte in range(1, width):
        value = value * 256 + numbers[..., byte]
    top = 1 << (8 * width - 1)
    return (value ^ top) - top


def _big_endian(values: Ints, width: int) -> Octets:
    shifts = 8 * np.arange(width - 1, -1, -1)
    return ((values[..., None] >> shifts) & 0xFF).astype(np.uint8).reshape(len(values), -1)
