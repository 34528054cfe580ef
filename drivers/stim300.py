"""STIM300 datagrams on the line (Sensonor TS1524 rev. 31): a pure codec, bytes to blocks and back."""

import re
import struct
import zlib
from dataclasses import dataclass

import numpy as np

from drivers.arrays import Flags, Floats, Ints, Octets
from drivers.stim300_special import SPECIAL_IDS, SPECIAL_LAYOUTS, Special

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
SERVICE_MODE = b"SERVICEMODE\r"
UTILITY_MODE = b"UTILITYMODE\r"

_LINE_END = b"\r\n"
_STATED_CRC = struct.Struct("<I")
_REVERSED = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))


@dataclass(frozen=True, slots=True)
class Layout:
    """What a datagram holds besides the gyro cluster, and how it pads its CRC."""

    accelerometer: bool = False
    inclinometer: bool = False
    temperature: bool = False
    extra: bool = False  # PPS or AUX group

    @property
    def clusters(self) -> int:
        """Number of three-axis clusters."""
        return 1 + self.accelerometer + self.inclinometer

    @property
    def size(self) -> int:
        """Bytes from the id to the CRC, without line termination."""
        temperatures = 7 * self.clusters if self.temperature else 0
        return 1 + 10 * self.clusters + temperatures + (4 if self.extra else 0) + 3 + 4

    @property
    def padding(self) -> int:
        """Zero bytes that enter the CRC but are not sent."""
        return -(self.size - 4) % 4


def _layouts() -> dict[int, Layout]:
    kinds = [Layout(bool(i & 1), bool(i & 2), bool(i & 4)) for i in range(8)]
    plain = (0x90, 0x91, 0x92, 0x93, 0x94, 0xA5, 0xA6, 0xA7)
    pps = (0xF0, 0xF1, 0xF2, 0xF3, 0xF4, 0xF5, 0xF6, 0xF7)
    aux = (0x98, 0x99, 0x9A, 0x9B, 0x9C, 0xAD, 0xAE, 0xAF)
    table = dict(zip(plain, kinds, strict=True))
    for ids in (pps, aux):
        for identifier, kind in zip(ids, kinds, strict=True):
            table[identifier] = Layout(kind.accelerometer, kind.inclinometer, kind.temperature, extra=True)
    return table


LAYOUTS = _layouts()

_ANY_ID = re.compile(b"[" + b"".join(re.escape(bytes([i])) for i in (*LAYOUTS, *SPECIAL_LAYOUTS)) + b"]")


@dataclass(frozen=True, slots=True, eq=False)
class Datagrams:
    """Consecutive normal datagrams of one kind, raw: clusters (n, 3) and their status (n,); None where absent."""

    identifier: int
    gyro: Ints
    gyro_status: Ints
    counter: Ints
    latency_us: Ints
    accelerometer: Ints | None = None
    accelerometer_status: Ints | None = None
    inclinometer: Ints | None = None
    inclinometer_status: Ints | None = None
    temperatures: Ints | None = None  # (n, clusters, 3)
    temperature_status: Ints | None = None  # (n, clusters)
    extra: Ints | None = None  # (n,) PPS, us since the last pulse, or AUX
    extra_status: Ints | None = None
    ends: Ints | None = None  # (n,) bytes fed to the decoder up to the end of each


def crc32_mpeg2(data: bytes) -> int:
    """Return CRC-32/MPEG-2 (poly 04C11DB7, init FFFFFFFF, not reflected, no final xor).

    zlib's CRC-32 is the same polynomial with every bit order reversed, so it does the work at C speed.
    """
    reflected = zlib.crc32(data.translate(_REVERSED)) ^ 0xFFFFFFFF
    return int.from_bytes(reflected.to_bytes(4, "little").translate(_REVERSED), "big")


class Stim300Decoder:
    """Finds datagrams, normal and special, in a stream. Malformed input is dropped and counted, never raised.

    CR LF behind a datagram belongs to it, whether the device is set to send it or not.
    """

    def __init__(self) -> None:
        """Start with nothing read."""
        self._buffer = b""
        self._behind_datagram = False
        self._position = 0  # of the buffer in the stream
        self.dropped_bytes = 0
        self.bad_datagrams = 0

    def feed(self, data: bytes) -> list[Datagrams | Special]:
        """Return what was completed by these bytes, in order; consecutive normal datagrams of a kind together."""
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
            elif not _intact(reversed_view, at, any_layout.size, bytes(any_layout.padding)):
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
        """Return the datagrams of one kind from here on, the first of which is intact, and the end of the last."""
        size, identifier, padding = layout.size, view[start], bytes(layout.padding)
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
    """Return the bytes of normal datagrams as the device sends them; ValueError if a cluster of the id is missing."""
    layout = LAYOUTS[datagrams.identifier]
    rows = np.zeros((len(datagrams.gyro), layout.size - 4), dtype=np.uint8)
    rows[:, 0] = datagrams.identifier
    column = 1
    clusters = [(datagrams.gyro, datagrams.gyro_status)]
    if layout.accelerometer:
        clusters.append(_present(datagrams.accelerometer, datagrams.accelerometer_status))
    if layout.inclinometer:
        clusters.append(_present(datagrams.inclinometer, datagrams.inclinometer_status))
    for values, status in clusters:
        rows[:, column : column + 9] = _big_endian(values, 3)
        rows[:, column + 9] = status
        column += 10
    if layout.temperature:
        temperatures, statuses = _present(datagrams.temperatures, datagrams.temperature_status)
        for cluster in range(layout.clusters):
            rows[:, column : column + 6] = _big_endian(temperatures[:, cluster], 2)
            rows[:, column + 6] = statuses[:, cluster]
            column += 7
    if layout.extra:
        extra, status = _present(datagrams.extra, datagrams.extra_status)
        rows[:, column : column + 3] = _big_endian(extra[:, None], 3)
        rows[:, column + 3] = status
        column += 4
    rows[:, column] = datagrams.counter % COUNTER_MODULUS
    rows[:, column + 1 : column + 3] = _big_endian(datagrams.latency_us[:, None], 2)
    padding, tail = bytes(layout.padding), _LINE_END if line_termination else b""
    bodies = [row.tobytes() for row in rows]
    return b"".join(body + crc32_mpeg2(body + padding).to_bytes(4, "big") + tail for body in bodies)


def encode_special(value: Special, *, line_termination: bool = False) -> bytes:
    """Return the bytes of a special datagram; ValueError if the value cannot be one."""
    identifier = SPECIAL_IDS[type(value), line_termination]
    body = bytes([identifier]) + value.payload()
    crc = crc32_mpeg2(body + bytes(SPECIAL_LAYOUTS[identifier].padding))
    return body + crc.to_bytes(4, "big") + (_LINE_END if line_termination else b"")


def invalid_channels(status: Ints) -> Flags:
    """Return which of x, y, z (n, 3) the device does not vouch for, by the status (n,) of their cluster.

    Integrity error and start-up are about all; channel error and overload about the axes they name.
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


def _intact(reversed_view: bytes, start: int, size: int, padding: bytes) -> bool:
    """Return whether the CRC is right, all in reversed bit order: see ``crc32_mpeg2``."""
    end = start + size - 4
    crc = zlib.crc32(padding, zlib.crc32(reversed_view[start:end])) ^ 0xFFFFFFFF
    return bool(crc == _STATED_CRC.unpack_from(reversed_view, end)[0])


def _parse(rows: Octets, layout: Layout, ends: Ints) -> Datagrams:
    column = 1
    values: list[Ints | None] = [None, None, None]
    status: list[Ints | None] = [None, None, None]
    for slot, present in enumerate((True, layout.accelerometer, layout.inclinometer)):
        if present:
            values[slot] = _signed(rows[:, column : column + 9], 3)
            status[slot] = rows[:, column + 9].astype(np.int64)
            column += 10
    temperatures = temperature_status = extra = extra_status = None
    if layout.temperature:
        groups = rows[:, column : column + 7 * layout.clusters].reshape(len(rows), layout.clusters, 7)
        temperatures = _signed(groups[:, :, :6].reshape(len(rows), -1), 2).reshape(len(rows), layout.clusters, 3)
        temperature_status = groups[:, :, 6].astype(np.int64)
        column += 7 * layout.clusters
    if layout.extra:
        extra, extra_status = _signed(rows[:, column : column + 3], 3)[:, 0], rows[:, column + 3].astype(np.int64)
        column += 4
    gyro, gyro_status = _present(values[0], status[0])
    return Datagrams(
        identifier=int(rows[0, 0]),
        gyro=gyro,
        gyro_status=gyro_status,
        counter=rows[:, column].astype(np.int64),
        latency_us=rows[:, column + 1].astype(np.int64) * 256 + rows[:, column + 2],
        accelerometer=values[1],
        accelerometer_status=status[1],
        inclinometer=values[2],
        inclinometer_status=status[2],
        temperatures=temperatures,
        temperature_status=temperature_status,
        extra=extra,
        extra_status=extra_status,
        ends=ends,
    )


def _present(values: Ints | None, status: Ints | None) -> tuple[Ints, Ints]:
    if values is None or status is None:
        raise ValueError("this datagram needs values and status of every group that its id names")
    return values, status


def _signed(raw: Octets, width: int) -> Ints:
    """Return big-endian two's complement numbers of ``width`` bytes: (n, k * width) to (n, k)."""
    numbers = raw.reshape(len(raw), -1, width).astype(np.int64)
    value = numbers[..., 0]
    for byte in range(1, width):
        value = value * 256 + numbers[..., byte]
    top = 1 << (8 * width - 1)
    return (value ^ top) - top


def _big_endian(values: Ints, width: int) -> Octets:
    shifts = 8 * np.arange(width - 1, -1, -1)
    return ((values[..., None] >> shifts) & 0xFF).astype(np.uint8).reshape(len(values), -1)
