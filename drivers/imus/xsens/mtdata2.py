"""MTData2 packets of Xsens MTi devices, which are the data of Xbus messages: a pure codec, bytes to numbers and back.

Facts from the maker's low-level communication protocol, as public drivers and real captures show them.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.imus.xsens.xbus import Bytes, Mid, frame
from drivers.packaged import packaged_toml
from drivers.types import Floats, Ints

FLOAT32, FP12_20, FP16_32, FLOAT64 = range(4)
FORMATS = ("Float32", "FP1220", "FP1632", "Float64")
"""The maker's names of the number formats, by the two lowest bits of a data identifier."""
# In FP1632 the fraction comes before the whole part: 32 bits of it, then 16 signed bits.
_FRACTION_FIRST: np.dtype[Any] = np.dtype([("fraction", ">u4"), ("whole", ">i2")])
_TYPES: tuple[np.dtype[Any], ...] = (np.dtype(">f4"), np.dtype(">i4"), _FRACTION_FIRST, np.dtype(">f8"))
_POINTS = {FP12_20: 20, FP16_32: 32}  # bits behind the point

TEMPERATURE = 0x0810
UTC_TIME = 0x1010
PACKET_COUNTER = 0x1020
SAMPLE_TIME_FINE = 0x1060
SAMPLE_TIME_COARSE = 0x1070
PRESSURE = 0x3010
EULER_ANGLES = 0x2030
ACCELERATION = 0x4020
RATE_OF_TURN = 0x8020
RATE_OF_TURN_HR = 0x8040
STATUS_BYTE = 0xE010
STATUS_WORD = 0xE020

SAMPLE_TIME_TICK_S = 1e-4
SAMPLE_TIME_MODULUS = 1 << 32
PACKET_COUNTER_MODULUS = 1 << 16


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of packet, by the maker's name.

    Its fields are numbers in the format of the data identifier, or integers of the types ``integers`` if given.
    ``repeated`` bytes may follow any number of times and are ignored.
    """

    name: str
    unit: str
    fields: tuple[str, ...]
    integers: np.dtype[np.void] | None = None
    repeated: int = 0

    def fits(self, number_format: int, size: int) -> bool:
        """Return whether a packet of this kind can have this size."""
        if self.integers is None:
            return size == len(self.fields) * _TYPES[number_format].itemsize
        more = size - self.integers.itemsize
        return more == 0 or (self.repeated > 0 and more > 0 and more % self.repeated == 0)


def _kind(name: str, unit: str, fields: str, repeated: int = 0) -> Kind:
    """Fields that are integers are given as type:name, the types as numpy writes them."""
    if ":" not in fields:
        return Kind(name, unit, tuple(fields.split()))
    parts = [field.split(":") for field in fields.split()]
    types = np.dtype([(field, ">" + kind) for kind, field in parts])
    return Kind(name, unit, tuple(field for _, field in parts), types, repeated)


KINDS = {int(kind, 16): _kind(*stated) for kind, stated in packaged_toml("drivers", "layouts.toml")["mtdata2"].items()}
"""Kinds of packets by their data identifier without its lowest four bits, which are number format and axes."""


def kind_of(data_id: int) -> int:
    """Return a data identifier without number format and coordinate system."""
    return data_id & 0xFFF0


def format_of(data_id: int) -> int:
    """Return the number format of a data identifier."""
    return data_id & 0x3


def name_of(data_id: int) -> str:
    """Return the maker's name of a data identifier, with the number format where there is one."""
    kind = KINDS.get(kind_of(data_id))
    if kind is None:
        return f"data {data_id:04X}"
    return kind.name if kind.integers is not None else f"{kind.name}({FORMATS[format_of(data_id)]})"


@dataclass(frozen=True, slots=True)
class Packet:
    """The place of a packet's value in the data of its message."""

    data_id: int
    start: int
    stop: int


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """Consecutive MTData2 messages with the same packets; ``data`` (n, length).

    ``start`` is the index of the first one among those parsed together.
    """

    packets: tuple[Packet, ...]
    data: Bytes
    start: int

    def has(self, kind: int) -> bool:
        """Return whether there are packets of this kind."""
        return self._find(kind) is not None

    def numbers(self, kind: int) -> Floats | None:
        """Return the values (n, fields) of a kind in its own unit, whatever the number format; None without them."""
        packet = self._find(kind)
        if packet is None:
            return None
        return _decode(self.data[:, packet.start : packet.stop], format_of(packet.data_id))

    def integers(self, kind: int) -> Ints | None:
        """Return the values (n, fields) of a key of ``KINDS``; None if the samples lack it or it has no integers."""
        packet, types = self._find(kind), KINDS[kind].integers
        if packet is None or types is None:
            return None
        raw = self.data[:, packet.start : packet.start + types.itemsize]
        fields = np.ascontiguousarray(raw).view(types)[:, 0]
        return np.column_stack([fields[name].astype(np.int64) for name in KINDS[kind].fields])

    def _find(self, kind: int) -> Packet | None:
        return next((packet for packet in self.packets if kind_of(packet.data_id) == kind), None)


def parse_mtdata2(data: Bytes) -> tuple[list[Samples], int]:
    """Return the contents of MTData2 messages of one length (n, length), and how many of them were malformed.

    Successive messages with the same packets share an item, whose ``start`` is the row of the first. A message is
    malformed if its packets do not end with it, or a known kind has an impossible size. Packets of unknown kinds are
    kept unread.
    """
    found: list[Samples] = []
    malformed = 0
    start = 0
    while start < len(data):
        packets = _layout(data[start].tobytes())
        if packets is None:
            malformed += 1
            start += 1
            continue
        heads = np.array([p.start - i for p in packets for i in (3, 2, 1)], dtype=np.intp)
        differs = (data[start:, heads] != data[start, heads]).any(axis=1)
        stop = start + int(np.argmax(differs)) if differs.any() else len(data)
        found.append(Samples(packets, data[start:stop], start))
        start = stop
    return found, malformed


def _layout(data: bytes) -> tuple[Packet, ...] | None:
    """Return the packets of a message, () if it is empty.

    None if they do not fill it exactly or a known kind has an impossible size.
    """
    packets: list[Packet] = []
    position = 0
    while position < len(data):
        if position + 3 > len(data):
            return None
        data_id, size = int.from_bytes(data[position : position + 2], "big"), data[position + 2]
        packet = Packet(data_id, position + 3, position + 3 + size)
        kind = KINDS.get(kind_of(data_id))
        if packet.stop > len(data) or (kind is not None and not kind.fits(format_of(data_id), size)):
            return None
        packets.append(packet)
        position = packet.stop
    return tuple(packets)


def encode_mtdata2(packets: Sequence[tuple[int, Floats | Ints]]) -> bytes:
    """Return n MTData2 messages, each with one packet of every (data identifier, values (n, fields)) in ``packets``.

    They are complete, with header and checksum. At least one packet is needed. Fixed-point numbers are rounded and
    clipped. ValueError for an unknown kind, a wrong number of fields, or too many bytes.
    """
    parts: list[tuple[bytes, Bytes]] = []
    for data_id, values in packets:
        kind = KINDS.get(kind_of(data_id))
        if kind is None or values.ndim != 2 or values.shape[1] != len(kind.fields):
            raise ValueError(f"{name_of(data_id)} cannot be made of values of shape {values.shape}")
        raw = _encode(values, format_of(data_id)) if kind.integers is None else _packed(values, kind.integers)
        parts.append((data_id.to_bytes(2, "big") + bytes([raw.shape[1]]), raw))
    rows = np.empty((len(parts[0][1]), sum(len(head) + raw.shape[1] for head, raw in parts)), dtype=np.uint8)
    column = 0
    for head, raw in parts:
        rows[:, column : column + 3] = np.frombuffer(head, dtype=np.uint8)
        rows[:, column + 3 : column + 3 + raw.shape[1]] = raw
        column += 3 + raw.shape[1]
    return frame(Mid.MTDATA2, rows)


def _decode(raw: Bytes, number_format: int) -> Floats:
    """Return numbers (n, m) from their bytes (n, m * width)."""
    numbers = np.ascontiguousarray(raw).view(_TYPES[number_format])
    if number_format == FP16_32:
        return np.asarray(numbers["whole"] + numbers["fraction"] / 2.0**32)
    with np.errstate(invalid="ignore"):  # noise may spell a signalling NaN
        return np.asarray(numbers.astype(np.float64) / 2.0 ** _POINTS.get(number_format, 0))


def _encode(values: Floats | Ints, number_format: int) -> Bytes:
    """Return the bytes (n, size) of values (n, fields) in a float or fixed-point format, as the device orders them.

    Fixed-point numbers are rounded and clipped.
    """
    kind = _TYPES[number_format]
    if number_format not in _POINTS:
        return _bytes(values.astype(kind))
    most = 2.0 ** (8 * kind.itemsize - 1)
    scaled = np.clip(np.round(values * 2.0 ** _POINTS[number_format]), -most, most - 1).astype(np.int64)
    if number_format == FP12_20:
        return _bytes(scaled.astype(kind))
    parts = np.empty(scaled.shape, dtype=kind)
    parts["fraction"], parts["whole"] = scaled & 0xFFFFFFFF, scaled >> 32
    return _bytes(parts)


def _packed(values: Floats | Ints, types: np.dtype[np.void]) -> Bytes:
    rows = np.empty((len(values), 1), dtype=types)
    for column, name in enumerate(types.names or ()):
        rows[name][:, 0] = values[:, column]
    return _bytes(rows)


def _bytes(values: NDArray[np.generic]) -> Bytes:
    return np.ascontiguousarray(values).view(np.uint8).reshape(len(values), -1)


EVERY = 0xFFFF
"""In place of a rate: with every message (counters and times), or as fast as the device can."""


@dataclass(frozen=True, slots=True)
class Output:
    """One line of the output configuration: the data sent, and its rate."""

    data_id: int
    rate_hz: int

    def __str__(self) -> str:
        """Return the output in words, with the maker's name for its data."""
        rate = "with every message" if self.rate_hz == EVERY else f"at {self.rate_hz} Hz"
        return f"{name_of(self.data_id)} {rate}"


def encode_outputs(outputs: Sequence[Output]) -> bytes:
    """Return the data of a request to set the output configuration."""
    return b"".join(o.data_id.to_bytes(2, "big") + o.rate_hz.to_bytes(2, "big") for o in outputs)


def decode_outputs(data: bytes) -> tuple[Output, ...] | None:
    """Return an output configuration; None if these bytes are none."""
    if len(data) % 4:
        return None
    words = np.frombuffer(data, dtype=">u2").reshape(-1, 2)
    return tuple(Output(int(data_id), int(rate_hz)) for data_id, rate_hz in words)
