"""STIM300 special datagrams (Sensonor TS1524 rev. 31, section 5.5): part number, serial number, configuration, bias
trim, extended error. Payloads only, from behind the id to before the CRC; ``drivers.imus.stim300.codec`` frames
them."""

from dataclasses import dataclass
from typing import Self, TypeAlias

from drivers.packaged import packaged_codes

RATES_HZ = (125, 250, 500, 1000, 2000)
"""Datagram rates, by their code."""
BIT_RATES = (374400, 460800, 921600, 1843200)

_DIGITS = "0123456789ABCDEFGHIJKLMNOPQRSTUVWXYZ"
_EXTERNAL_TRIGGER = 5
_USER_BIT_RATE = 0xF
_ACCEL_RANGES_G = {0: 10, 3: 5, 4: 30, 6: 80}
_ALL_AXES = 0x70


@dataclass(frozen=True, slots=True)
class PartNumber:
    """Part number (``84167-440000-3321``) and its revision, one letter."""

    text: str
    revision: str

    def payload(self) -> bytes:
        """Return the 15 bytes; ValueError unless the number is 5, 6 and 4 digits and the revision one character (tables
        5-13, 5-14).
        """
        parts = [[_digit(c) for c in part] for part in self.text.split("-")]
        if [len(part) for part in parts] != [5, 6, 4] or len(self.revision) != 1:
            raise ValueError(f"{self.text!r} rev {self.revision!r} is no part number")
        first, middle, (d12, d13, d14, d15) = parts
        last = [d13 & 15, d14, d15 & 15, d15 >> 4, d13 >> 4, d12]
        packed = _packed([0, *first]) + b"-" + _packed(middle) + b"-" + _packed(last)
        return packed + bytes(3) + self.revision.encode("latin-1")

    @classmethod
    def parse(cls, payload: bytes) -> Self:
        """Read the 15 bytes; a digit that cannot be one becomes ``?``."""
        p12, p13, p14, p15, p16, p17 = _nibbles(payload[8:11])
        last = [p17, p12 + 16 * p16, p13, p14 + 16 * p15]
        parts = (_nibbles(payload[:3])[1:], _nibbles(payload[4:7]), last)
        text = "-".join("".join(_DIGITS[d] if d < len(_DIGITS) else "?" for d in part) for part in parts)
        return cls(text, payload[14:15].decode("latin-1"))


@dataclass(frozen=True, slots=True)
class SerialNumber:
    """Serial number: N and fourteen digits."""

    text: str

    def payload(self) -> bytes:
        """Return the 15 bytes; ValueError unless it is N and 14 digits (table 5-15)."""
        if len(self.text) != 15 or self.text[0] != "N":
            raise ValueError(f"{self.text!r} is no serial number")
        return b"N" + _packed([_digit(c) for c in self.text[1:]]) + bytes(7)

    @classmethod
    def parse(cls, payload: bytes) -> Self:
        """Read the 15 bytes."""
        return cls("N" + "".join(_DIGITS[d] for d in _nibbles(payload[1:8])))


@dataclass(frozen=True, slots=True)
class Configuration:
    """The device's configuration (table 5-16), read from its 21 bytes; None for values that the tables do not list."""

    data: bytes

    @classmethod
    def of(
        cls,
        *,
        rate_hz: int,
        accelerometer: bool = False,
        inclinometer: bool = False,
        temperature: bool = False,
        pps: bool = False,
        line_termination: bool = False,
        bit_rate: int = 921600,
        gyro_unit: int = 0,
        accel_range_g: int = 10,
        revision: str = "K",
        firmware: int = 0,
    ) -> Self:
        """Return the configuration of a device with all axes on, 262 Hz filters, and all that is not stated at 0.

        ``accelerometer``, ``inclinometer``, ``temperature`` and ``pps`` say which groups normal datagrams carry,
        ``line_termination`` whether CR LF ends them. ``gyro_unit`` is a code; ``accel_range_g`` holds for all three
        axes; a ``bit_rate`` that is not listed becomes "user defined". ``revision`` is a letter, ``firmware`` a number
        of one byte. ValueError for a ``rate_hz`` or an ``accel_range_g`` that the device does not have.
        """
        codes = {range_g: code for code, range_g in _ACCEL_RANGES_G.items()}
        if accel_range_g not in codes:
            raise ValueError(f"no range of {accel_range_g} g: it is one of {', '.join(map(str, sorted(codes)))}")
        data = bytearray(21)
        data[0], data[1] = ord(revision), firmware
        flags = (pps << 4) | (temperature << 3) | (inclinometer << 2) | (accelerometer << 1) | line_termination
        data[2] = RATES_HZ.index(rate_hz) << 5 | flags
        data[3] = (BIT_RATES.index(bit_rate) if bit_rate in BIT_RATES else _USER_BIT_RATE) << 4
        data[4], data[7], data[10] = _ALL_AXES | gyro_unit, _ALL_AXES, _ALL_AXES
        data[5] = data[8] = data[11] = 0x44
        data[6] = data[9] = data[12] = 0x40
        data[13] = pps << 3
        code = codes[accel_range_g]
        data[16], data[17] = code << 4 | code, code << 4
        return cls(bytes(data))

    def payload(self) -> bytes:
        """Return the 21 bytes."""
        return self.data

    @classmethod
    def parse(cls, payload: bytes) -> Self:
        """Keep the 21 bytes."""
        return cls(payload)

    @property
    def firmware(self) -> int:
        """Revision of the firmware."""
        return self.data[1]

    @property
    def rate_hz(self) -> int | None:
        """Rate of normal datagrams; None when they wait for an external trigger."""
        code = self.data[2] >> 5
        return RATES_HZ[code] if code < _EXTERNAL_TRIGGER else None

    @property
    def accelerometer(self) -> bool:
        """Whether normal datagrams carry the accelerometers."""
        return bool(self.data[2] & 0x02)

    @property
    def gyros_on(self) -> tuple[bool, bool, bool]:
        """Which of the gyros x, y, z are on."""
        return bool(self.data[4] & 0x40), bool(self.data[4] & 0x20), bool(self.data[4] & 0x10)

    @property
    def gyro_unit(self) -> int:
        """Code of the gyros' output unit."""
        return self.data[4] & 0x0F

    @property
    def accel_unit(self) -> int:
        """Code of the accelerometers' output unit."""
        return self.data[7] & 0x0F

    @property
    def accel_ranges_g(self) -> tuple[int | None, int | None, int | None]:
        """Ranges of the accelerometers x, y, z."""
        x, y, z = (_ACCEL_RANGES_G.get(code) for code in _nibbles(self.data[16:18])[:3])
        return x, y, z


@dataclass(frozen=True, slots=True)
class BiasTrim:
    """Offsets that the device adds to its outputs, raw (table 5-17): x, y, z of each cluster."""

    gyro: tuple[int, int, int] = (0, 0, 0)
    accelerometer: tuple[int, int, int] = (0, 0, 0)
    inclinometer: tuple[int, int, int] = (0, 0, 0)
    reference: int = 0
    saves_left: int = 0

    def payload(self) -> bytes:
        """Return the 35 bytes."""
        values = (*self.gyro, *self.accelerometer, *self.inclinometer)
        offsets = b"".join(value.to_bytes(3, "big", signed=True) for value in values)
        return offsets + self.reference.to_bytes(4, "big") + self.saves_left.to_bytes(2, "big") + bytes(2)

    @classmethod
    def parse(cls, payload: bytes) -> Self:
        """Read the 35 bytes."""
        v = [int.from_bytes(payload[i : i + 3], "big", signed=True) for i in range(0, 27, 3)]
        reference, saves = int.from_bytes(payload[27:31], "big"), int.from_bytes(payload[31:33], "big")
        return cls((v[0], v[1], v[2]), (v[3], v[4], v[5]), (v[6], v[7], v[8]), reference, saves)


@dataclass(frozen=True, slots=True)
class ExtendedError:
    """The error register, 128 bits (table 5-18); reading clears it."""

    bits: int

    def payload(self) -> bytes:
        """Return the 16 bytes."""
        return self.bits.to_bytes(16, "big")

    @classmethod
    def parse(cls, payload: bytes) -> Self:
        """Read the 16 bytes."""
        return cls(int.from_bytes(payload, "big"))

    @property
    def texts(self) -> tuple[str, ...]:
        """Meanings of the bits that are set (table 5-19), in their order; unknown bits by number."""
        set_bits = (bit for bit in range(128) if self.bits >> bit & 1)
        return tuple(_ERRORS.get(bit, f"error bit {bit}") for bit in set_bits)


Special: TypeAlias = PartNumber | SerialNumber | Configuration | BiasTrim | ExtendedError


@dataclass(frozen=True, slots=True)
class SpecialLayout:
    """The value that a special datagram carries, its length in bytes, and whether CR LF ends it."""

    kind: type[PartNumber] | type[SerialNumber] | type[Configuration] | type[BiasTrim] | type[ExtendedError]
    length: int
    line_termination: bool

    @property
    def size(self) -> int:
        """Bytes from the id to the CRC, without line termination."""
        return 1 + self.length + 4


SPECIAL_LAYOUTS = {
    0xB1: SpecialLayout(PartNumber, 15, False),
    0xB3: SpecialLayout(PartNumber, 15, True),
    0xB5: SpecialLayout(SerialNumber, 15, False),
    0xB7: SpecialLayout(SerialNumber, 15, True),
    0xBC: SpecialLayout(Configuration, 21, False),
    0xBD: SpecialLayout(Configuration, 21, True),
    0xD1: SpecialLayout(BiasTrim, 35, False),
    0xD2: SpecialLayout(BiasTrim, 35, True),
    0xBE: SpecialLayout(ExtendedError, 16, False),
    0xBF: SpecialLayout(ExtendedError, 16, True),
}
SPECIAL_IDS = {(layout.kind, layout.line_termination): identifier for identifier, layout in SPECIAL_LAYOUTS.items()}

_ERRORS = packaged_codes("drivers", "stim300", "failure")


def _digit(character: str) -> int:
    if character not in _DIGITS:
        raise ValueError(f"{character!r} is no digit")
    return _DIGITS.index(character)


def _nibbles(data: bytes) -> list[int]:
    return [nibble for byte in data for nibble in (byte >> 4, byte & 15)]


def _packed(nibbles: list[int]) -> bytes:
    return bytes(high << 4 | low for high, low in zip(nibbles[::2], nibbles[1::2], strict=True))
