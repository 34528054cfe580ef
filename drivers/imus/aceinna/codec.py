"""Aceinna OpenIMU300RI and MTLT305D on SAE J1939: identifiers, data messages, requests. A pure codec.

Source: Aceinna's public documentation of the OpenIMU300RI's J1939 application; SAE J1939-21 for identifiers and
J1939-71 for codes that are no measurements. All numbers are little endian, unsigned, with an offset.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from typing import Literal

import numpy as np

from drivers.imus.signals import parameter_group
from drivers.packaged import packaged_toml
from drivers.types import Flags, Floats, Frame, Octets

SSI2, ARI, ACCS = 0xF029, 0xF02A, 0xF02D
"""Slope, angular rate and acceleration messages, as parameter group numbers."""
ACKNOWLEDGEMENT, REQUEST, ADDRESS_CLAIM, SOFTWARE_VERSION = 0xE800, 0xEA00, 0xEE00, 0xFEDA
RESET_ALGORITHM, SAVE, RATE_DIVIDER, PACKET_TYPES, FILTERS, ORIENTATION = 0xFF50, 0xFF51, 0xFF55, 0xFF56, 0xFF57, 0xFF58
DEFAULT_ADDRESS = 0x80
EVERYBODY = 0xFF

INTERNAL_RATE_HZ = 100
DIVIDERS = (0, 1, 2, 4, 5, 10, 20, 25, 50)
RATES_HZ = tuple(INTERNAL_RATE_HZ / divider for divider in DIVIDERS[1:])
FILTERS_HZ = (0, 2, 5, 10, 25, 40, 50)
ORIENTATIONS: list[int] = packaged_toml("drivers", "codes.toml")["aceinna"]["orientation"]["codes"]
PACKETS = {"ssi2": 1, "ari": 2, "accs": 4}

AxisOrder = Literal["xyz", "sae"]
AXIS_ORDERS: dict[str, AxisOrder] = {"openimu300ri": "xyz", "mtlt305d": "sae"}
"""Order of the fields by model: SAE J1939-71 puts pitch before roll and lateral before longitudinal, y before x."""
ByteOrder = Literal["little", "big"]

_COLUMNS: dict[AxisOrder, tuple[int, int, int]] = {"xyz": (0, 1, 2), "sae": (1, 0, 2)}
_PRIORITIES = {SSI2: 3, ARI: 3, ACCS: 2}
_DPS_PER_BIT, _DPS_OFFSET = 1 / 128, -250.0
_MPS2_PER_BIT, _MPS2_OFFSET = 0.01, -320.0
_DEG_PER_BIT, _DEG_OFFSET = 1 / 32768, -250.0
_TOP = 64000  # the code of +250 deg/s and of +320 m/s2, where the device stops
_NO_MEASUREMENT = 0xFB00  # from here on: reserved, indicator, error (FExx), not available (FFxx)
_NOT_AVAILABLE = 0xFFFF


def identifier(group: int, source: int, destination: int = EVERYBODY) -> int:
    """Return the 29-bit identifier of a message: priority, parameter group, destination where it has one, source."""
    specific = group if group >> 8 >= 0xF0 else group | destination
    return _PRIORITIES.get(group, 6) << 26 | specific << 8 | source


def message(group: int, data: bytes, source: int, destination: int = EVERYBODY) -> Frame:
    """Return a message as a frame without stamp."""
    return Frame(0, identifier(group, source, destination), True, data)


def is_from(frame: Frame, group: int, source: int) -> bool:
    """Return whether a frame is a message of this group by this sender."""
    return frame.extended and frame.identifier & 0xFF == source and parameter_group(frame.identifier) == group


def request(group: int, destination: int, source: int, *, standard: bool = False) -> Frame:
    """Return the request for a parameter group: as Aceinna writes it (0, PF, PS), or by the standard (PS, PF, 0)."""
    data = bytes([0, group >> 8, group & 0xFF])
    return message(REQUEST, data[::-1] if standard else data, source, destination)


def command(group: int, destination: int, values: bytes, source: int) -> Frame:
    """Return a set request: the destination comes first in the data, not in the identifier."""
    return message(group, bytes([destination]) + values, source)


@dataclass(frozen=True, slots=True)
class Settings:
    """What the device is to do; None leaves it as it is. Nothing is saved: a power cycle undoes it.

    ``orientation`` is one of ``ORIENTATIONS``; whether its two bytes go low or high first is told differently by
    the documentation (little) and by Aceinna's own software (big).
    """

    rate_hz: float | None = None
    packets: tuple[str, ...] | None = None
    rate_filter_hz: int | None = None
    accel_filter_hz: int | None = None
    orientation: int | None = None
    orientation_bytes: ByteOrder = "little"

    def __post_init__(self) -> None:
        """ValueError for what the device cannot do."""
        if self.rate_hz is not None and self.rate_hz not in RATES_HZ:
            rates = ", ".join(f"{rate_hz:g}" for rate_hz in RATES_HZ)
            raise ValueError(f"rate {self.rate_hz:g} Hz: the device sends at {rates} Hz")
        if self.packets is not None and not set(self.packets) <= set(PACKETS):
            raise ValueError(f"packets {', '.join(self.packets)}: the device has {', '.join(PACKETS)}")
        for cutoff_hz in (self.rate_filter_hz, self.accel_filter_hz):
            if cutoff_hz is not None and cutoff_hz not in FILTERS_HZ:
                raise ValueError(f"filter {cutoff_hz} Hz: the device has {', '.join(map(str, FILTERS_HZ))} Hz")
        if (self.rate_filter_hz is None) != (self.accel_filter_hz is None):
            raise ValueError("the filters of rate and acceleration are set together: give both or none")
        if self.orientation is not None and self.orientation not in ORIENTATIONS:
            raise ValueError(f"orientation {self.orientation:#06x} is none of the 24 that the device has")

    def commands(self) -> list[tuple[int, bytes]]:
        """Return (parameter group, values) of each set request."""
        out = []
        if self.rate_hz is not None:
            out.append((RATE_DIVIDER, bytes([round(INTERNAL_RATE_HZ / self.rate_hz)])))
        if self.packets is not None:
            out.append((PACKET_TYPES, bytes([sum(PACKETS[name] for name in set(self.packets)), 0])))
        if self.rate_filter_hz is not None and self.accel_filter_hz is not None:
            out.append((FILTERS, bytes([self.rate_filter_hz, self.accel_filter_hz])))
        if self.orientation is not None:
            out.append((ORIENTATION, self.orientation.to_bytes(2, self.orientation_bytes)))
        return out


@dataclass(frozen=True, slots=True)
class Name:
    """A J1939 NAME, as far as it identifies a device: what an address claim carries."""

    identity: int
    manufacturer: int
    function: int

    @classmethod
    def decode(cls, data: bytes) -> Name | None:
        """Return the NAME of eight bytes, None of any other number."""
        if len(data) != 8:
            return None
        number = int.from_bytes(data, "little")
        return cls(number & 0x1FFFFF, number >> 21 & 0x7FF, number >> 40 & 0xFF)

    def encode(self) -> bytes:
        """Return the eight bytes, with all other fields 0."""
        number = self.identity & 0x1FFFFF | (self.manufacturer & 0x7FF) << 21 | (self.function & 0xFF) << 40
        return number.to_bytes(8, "little")


def decode_version(data: bytes) -> str:
    """Return major.minor.patch, stage and build of five bytes; empty for any other number."""
    if len(data) != 5:
        return ""
    major, minor, patch, stage, build = data
    return f"{major}.{minor}.{patch} stage {stage} build {build}"


def decode_rates(data: Octets, order: AxisOrder) -> tuple[Floats, Flags]:
    """Return rates x, y, z (n, 3) in deg/s of ARI messages (n, 8), and which are saturated; NaN for no measurement."""
    return _decode(data, order, _DPS_PER_BIT, _DPS_OFFSET)


def decode_accelerations(data: Octets, order: AxisOrder) -> tuple[Floats, Flags]:
    """Return accelerations x, y, z (n, 3) in m/s2 of ACCS messages (n, 8), and which are saturated; NaN as above."""
    return _decode(data, order, _MPS2_PER_BIT, _MPS2_OFFSET)


def encode_rates(rates_dps: Floats, order: AxisOrder, tail: bytes = bytes(2)) -> bytes:
    """Return the data of ARI for rates x, y, z (3,) in deg/s; ``tail`` is figure of merit and latency."""
    return _encode(rates_dps, order, _DPS_PER_BIT, _DPS_OFFSET) + tail


def encode_accelerations(accel_mps2: Floats, order: AxisOrder, tail: bytes = bytes(2)) -> bytes:
    """Return the data of ACCS for accelerations x, y, z (3,) in m/s2."""
    return _encode(accel_mps2, order, _MPS2_PER_BIT, _MPS2_OFFSET) + tail


def encode_slope(pitch_deg: float, roll_deg: float, tail: bytes = bytes(2)) -> bytes:
    """Return the data of SSI2."""
    raw = [round((angle - _DEG_OFFSET) / _DEG_PER_BIT) for angle in (pitch_deg, roll_deg)]
    return b"".join(min(max(number, 0), _NO_MEASUREMENT << 8).to_bytes(3, "little") for number in raw) + tail


def _decode(data: Octets, order: AxisOrder, per_bit: float, offset: float) -> tuple[Floats, Flags]:
    raw = np.ascontiguousarray(data[:, :6]).view("<u2")[:, _COLUMNS[order]]
    values = raw * per_bit + offset
    none = raw >= _NO_MEASUREMENT
    values[none] = np.nan
    return np.asarray(values), np.asarray(((raw == 0) | (raw >= _TOP)) & ~none)


def _encode(values: Floats, order: AxisOrder, per_bit: float, offset: float) -> bytes:
    fields = [float(values[column]) for column in _COLUMNS[order]]  # either order is its own inverse
    raw = [
        _NOT_AVAILABLE if math.isnan(field) else round(min(max((field - offset) / per_bit, 0), _TOP))
        for field in fields
    ]
    return struct.pack("<3H", *raw)
