"""Aceinna OpenIMU300RI and MTLT305D on SAE J1939: identifiers and requests. A pure codec; a DBC has the data messages.

Source: Aceinna's public documentation of the OpenIMU300RI's J1939 application; SAE J1939-21 for identifiers.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Self

import drivers.imus.can.dbc
from drivers.imus.signals import parameter_group
from drivers.packaged import packaged_toml
from drivers.types import Frame

DBC = Path(drivers.imus.can.dbc.__path__[0]) / "aceinna.dbc"
"""Data messages: SSI2, ARI, ACCS."""

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

COLUMNS: dict[AxisOrder, tuple[int, int, int]] = {"xyz": (0, 1, 2), "sae": (1, 0, 2)}
"""Places of x, y, z among the fields, and the other way round."""

_PRIORITIES = {SSI2: 3, ARI: 3, ACCS: 2}


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


def settings(rate_hz: float) -> list[tuple[int, bytes]]:
    """Return (parameter group, values) of the two set requests for rates and accelerations at ``rate_hz``.

    The first sets the divider of the internal rate, the second which packets are sent. Nothing is saved: a power cycle
    undoes it. ValueError for a rate that the device does not have.
    """
    if rate_hz not in RATES_HZ:
        rates = ", ".join(f"{rate:g}" for rate in RATES_HZ)
        raise ValueError(f"rate {rate_hz:g} Hz: the device sends at {rates} Hz")
    divider = round(INTERNAL_RATE_HZ / rate_hz)
    return [(RATE_DIVIDER, bytes([divider])), (PACKET_TYPES, bytes([PACKETS["ari"] | PACKETS["accs"], 0]))]


@dataclass(frozen=True, slots=True)
class Name:
    """The part of a J1939 NAME, from an address claim, that identifies a device."""

    identity: int
    manufacturer: int
    function: int

    @classmethod
    def decode(cls, data: bytes) -> Self | None:
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
