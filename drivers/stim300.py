"""STIM300 normal-mode datagrams (Sensonor TS1524 rev. 31): a pure codec, bytes to blocks and back."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Ints = NDArray[np.int64]

INTERNAL_RATE_HZ = 2000
"""The counter counts samples at this rate, whatever the datagram rate."""
COUNTER_MODULUS = 256
RATES_HZ = (125, 250, 500, 1000, 2000)
GYRO_LSB_DPS = 2.0**-14
TEMPERATURE_LSB_C = 2.0**-8
ACCEL_LSB_G = {5: 2.0**-20, 10: 2.0**-19, 30: 2.0**-18, 80: 2.0**-16}

STATUS_START_UP = 0x40
STATUS_INVALID = 0xC8  # integrity error, start-up, channel error

_MAX_BUFFER = 65536
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


@dataclass(frozen=True, slots=True, eq=False)
class Datagrams:
    """Consecutive datagrams of one kind, raw values: ``gyro`` (n, 3); clusters that are absent are None."""

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


def crc32_mpeg2(data: bytes) -> int:
    """Return CRC-32/MPEG-2 (poly 04C11DB7, init FFFFFFFF, not reflected, no final xor).

    zlib's CRC-32 is the same polynomial with every bit order reversed, so it does the work at C speed.
    """
    reflected = zlib.crc32(data.translate(_REVERSED)) ^ 0xFFFFFFFF
    return int.from_bytes(reflected.to_bytes(4, "little").translate(_REVERSED), "big")


class Stim300Decoder:
    """Finds datagrams in a stream. Malformed input is dropped and counted, never raised."""

    def __init__(self, *, line_termination: bool = False) -> None:
        """Start unlocked; ``line_termination`` when the device ends each datagram with CR LF."""
        self._buffer = bytearray()
        self._tail = b"\r\n" if line_termination else b""
        self.dropped_bytes = 0
        self.bad_datagrams = 0

    def feed(self, data: bytes) -> list[Datagrams]:
        """Return the datagrams completed by these bytes, consecutive ones of a kind together."""
        self._buffer += data
        found: list[Datagrams] = []
        position = 0
        view = bytes(self._buffer)
        while position < len(view):
            layout = LAYOUTS.get(view[position])
            if layout is None:
                position += 1
                self.dropped_bytes += 1
                continue
            step = layout.size + len(self._tail)
            count = self._valid_run(view, position, layout, step)
            if count:
                found.append(_parse(view[position : position + count * step], layout, step))
                position += count * step
            elif len(view) - position < step:
                break
            else:
                self.bad_datagrams += 1
                self.dropped_bytes += 1
                position += 1
        self._buffer = bytearray(view[position:][-_MAX_BUFFER:])
        return found

    def _valid_run(self, view: bytes, position: int, layout: Layout, step: int) -> int:
        identifier = view[position]
        padding = bytes(layout.padding)
        body = layout.size - 4
        count = 0
        while position + step <= len(view) and view[position] == identifier:
            end = position + body
            if crc32_mpeg2(view[position:end] + padding) != int.from_bytes(view[end : end + 4], "big"):
                break
            if view[end + 4 : position + step] != self._tail:
                break
            count += 1
            position += step
        return count


def encode(datagrams: Datagrams, *, line_termination: bool = False) -> bytes:
    """Return the bytes of these datagrams as the device sends them."""
    layout = LAYOUTS[datagrams.identifier]
    n = len(datagrams.gyro)
    rows = np.zeros((n, layout.size - 4), dtype=np.uint8)
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
        if datagrams.temperatures is None:
            raise ValueError(f"datagram {datagrams.identifier:02X} carries temperatures")
        for cluster, (_, status) in enumerate(clusters):
            rows[:, column : column + 6] = _big_endian(datagrams.temperatures[:, cluster], 2)
            rows[:, column + 6] = status
            column += 7
    column += 4 if layout.extra else 0
    rows[:, column] = datagrams.counter % COUNTER_MODULUS
    rows[:, column + 1 : column + 3] = _big_endian(datagrams.latency_us[:, None], 2)
    padding, tail = bytes(layout.padding), b"\r\n" if line_termination else b""
    bodies = [row.tobytes() for row in rows]
    return b"".join(body + crc32_mpeg2(body + padding).to_bytes(4, "big") + tail for body in bodies)


def _parse(data: bytes, layout: Layout, step: int) -> Datagrams:
    rows = np.frombuffer(data, dtype=np.uint8).reshape(-1, step)
    column = 1
    values: list[Ints | None] = [None, None, None]
    status: list[Ints | None] = [None, None, None]
    for slot, present in enumerate((True, layout.accelerometer, layout.inclinometer)):
        if present:
            values[slot] = _signed(rows[:, column : column + 9], 3)
            status[slot] = rows[:, column + 9].astype(np.int64)
            column += 10
    temperatures = None
    if layout.temperature:
        groups = [_signed(rows[:, column + 7 * c : column + 7 * c + 6], 2) for c in range(layout.clusters)]
        temperatures = np.stack(groups, axis=1)
        column += 7 * layout.clusters
    column += 4 if layout.extra else 0
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
    )


def _present(values: Ints | None, status: Ints | None) -> tuple[Ints, Ints]:
    if values is None or status is None:
        raise ValueError("this datagram needs values and status of every cluster that its id names")
    return values, status


def _signed(raw: NDArray[np.uint8], width: int) -> Ints:
    """Return big-endian two's complement numbers of ``width`` bytes: (n, 3 * width) to (n, 3)."""
    numbers = raw.reshape(len(raw), -1, width).astype(np.int64)
    value = numbers[..., 0]
    for byte in range(1, width):
        value = value * 256 + numbers[..., byte]
    top = 1 << (8 * width - 1)
    return (value ^ top) - top


def _big_endian(values: Ints, width: int) -> NDArray[np.uint8]:
    shifts = 8 * np.arange(width - 1, -1, -1)
    return ((values[..., None] >> shifts) & 0xFF).astype(np.uint8).reshape(len(values), -1)
