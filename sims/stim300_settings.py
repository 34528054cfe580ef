"""How a simulated STIM300 is set, and how it is asked and told: its service and utility modes."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

from drivers.packaged import packaged_codes, packaged_toml
from drivers.stim300 import DATAGRAM_CODES, LAYOUTS
from drivers.stim300_special import BIT_RATES, RATES_HZ, Configuration
from drivers.stim300_utility import UtilityMessage, parse_message

_KNOWN = packaged_toml("sims", "codes.toml")["stim300"]
_FILTERS_HZ = packaged_codes("sims", "stim300", "filter")
_PARITIES = ("n", "e", "o")
_ERRORS = packaged_codes("sims", "stim300", "service")
_UNIT_NAMES = {0: "ANGULAR RATE", 1: "INCREMENTAL ANGLE", 2: "AVERAGE ANGULAR RATE", 3: "INTEGRATED ANGLE"}
_BITS_A_BYTE = 10
_MARGIN = 1.1


class Refused(Exception):
    """A command that cannot be obeyed: its error in service mode."""

    def __init__(self, code: int) -> None:
        super().__init__(_ERRORS[code])
        self.code = code


@dataclass(slots=True)
class Settings:
    """What a STIM300 keeps about itself."""

    rate_hz: int
    identifier: int
    gyro_unit: int
    accel_range_g: int
    line_termination: bool
    serial: str
    part_number: str
    revision: str = "K"
    firmware: str = "SWD12404 REV 0"
    hardware: str = "M5728 REV 11"
    bit_rate: int = 921600
    saves_left: int = 9958
    stop_bits: int = 1
    parity: str = "n"
    terminated: bool = False
    gyro_filter: int = 4

    def configuration(self) -> Configuration:
        """Return what the configuration datagram says."""
        layout = LAYOUTS[self.identifier]
        told = Configuration.of(
            rate_hz=self.rate_hz,
            accelerometer=layout.accelerometer,
            inclinometer=layout.inclinometer,
            temperature=layout.temperature,
            pps=layout.extra,
            line_termination=self.line_termination,
            bit_rate=self.bit_rate,
            gyro_unit=self.gyro_unit,
            accel_range_g=self.accel_range_g,
            revision=self.revision,
        )
        data = bytearray(told.data)
        data[3] |= (self.stop_bits == 2) << 3 | _PARITIES.index(self.parity) << 1 | self.terminated
        data[5], data[6] = self.gyro_filter * 0x11, self.gyro_filter << 4
        return Configuration(bytes(data))

    def set_rate(self, code: str) -> None:
        """Set the rate by its digit."""
        if code not in ("0", "1", "2", "3", "4"):
            raise Refused(3)
        self._fit(RATES_HZ[int(code)], self.identifier)
        self.rate_hz = RATES_HZ[int(code)]

    def set_datagram(self, code: str, end: str | None = None) -> None:
        """Set the normal datagram by its letter, and whether CR LF ends it, "0" or "1"."""
        if code not in DATAGRAM_CODES or end not in ("0", "1", None):
            raise Refused(3)
        self._fit(self.rate_hz, DATAGRAM_CODES[code])
        self.identifier = DATAGRAM_CODES[code]
        self.line_termination = self.line_termination if end is None else end == "1"

    def set_gyro_unit(self, code: str) -> None:
        """Set what the gyros put out."""
        if code not in ("0", "1", "2", "3", "8", "9", "10", "11"):
            raise Refused(3)
        self.gyro_unit = int(code)

    def set_of_gyros(self, what: Callable[[str], None], cluster: str, code: str) -> None:
        """Set something of the gyros, cluster "g", the only one that can be set."""
        if cluster != "g":
            raise Refused(3)
        what(code)

    def set_gyro_filter(self, code: str) -> None:
        """Set the low pass by its digit."""
        if code not in map(str, _FILTERS_HZ):
            raise Refused(3)
        self.gyro_filter = int(code)

    def set_termination(self, code: str) -> None:
        """Switch the resistor between the wires of the receiver."""
        if code not in ("0", "1"):
            raise Refused(3)
        self.terminated = code == "1"

    def set_transmission(self, code: str, *more: str) -> None:
        """Set the bit rate, by its digit or as f and a number, then stop bits and parity if they are given."""
        rates = {str(i): str(rate) for i, rate in enumerate(BIT_RATES)}
        given = more if code == "f" else (rates.get(code, ""), *more)
        rate, stop_bits, parity = _exactly(3, list(given) if given[1:] else [*given, str(self.stop_bits), self.parity])
        if not rate.isdecimal() or stop_bits not in ("1", "2") or parity not in _PARITIES:
            raise Refused(3)
        self._fit(self.rate_hz, self.identifier, int(rate))
        self.bit_rate, self.stop_bits, self.parity = int(rate), int(stop_bits), parity

    def save(self) -> str:
        """Keep the settings; return how often that can still be done."""
        self.saves_left -= 1
        return str(self.saves_left)

    def _fit(self, rate_hz: int, identifier: int, bit_rate: int = 0) -> None:
        size = LAYOUTS[identifier].size + 2 * self.line_termination
        if _MARGIN * _BITS_A_BYTE * size * rate_hz > (bit_rate or self.bit_rate):
            raise Refused(7)


def utility_reply(settings: Settings, line: bytes) -> UtilityMessage | None:
    """Return the reply to one line, which may be damaged; None if it is none of utility mode's."""
    if not line.startswith(b"$"):
        return UtilityMessage(True, ("", "1")) if line else None
    command = parse_message(line + b"\r")
    if command is None:
        return UtilityMessage(True, ("", "2"))
    name, *parameters = command.fields
    answer = _utility_answers(settings).get(name)
    if answer is None:
        return UtilityMessage(True, ("", "3"))
    needed, act = answer
    if len(parameters) != needed:
        return UtilityMessage(True, (name, "4"))
    try:
        return UtilityMessage(True, (name, "0", *act(*parameters)))
    except Refused:
        return UtilityMessage(True, (name, "5"))


def _utility_answers(own: Settings) -> dict[str, tuple[int, Callable[..., tuple[str, ...]]]]:
    """Return commands with how many parameters they take and what they do and say."""
    codes = {identifier: code for code, identifier in DATAGRAM_CODES.items()}

    def after(act: Callable[[str], None]) -> Callable[[str], tuple[str, ...]]:
        def obey(code: str) -> tuple[str, ...]:
            act(code)
            return (code,)

        return obey

    def gyro(axis: str) -> tuple[str, ...]:
        if axis.upper() not in ("X", "Y", "Z"):
            raise Refused(3)
        return axis.upper(), "1", str(own.gyro_unit), str(own.gyro_filter), "0", "0"  # in the order of the command sg

    return {
        "in": (0, lambda: ("STIM300",)),
        "ix": (0, lambda: (own.part_number, own.revision)),
        "ipn": (0, lambda: (own.part_number, own.revision)),
        "ig": (1, gyro),
        "it": (0, lambda: (str(own.bit_rate), str(own.stop_bits), own.parity, str(int(own.terminated)), "0", "0")),
        "isn": (0, lambda: (own.serial,)),
        "ifw": (0, lambda: (own.firmware,)),
        "ihw": (0, lambda: (own.hardware,)),
        "im": (0, lambda: (str(RATES_HZ.index(own.rate_hz)),)),
        "id": (0, lambda: (codes[own.identifier],)),
        "igu": (0, lambda: (str(own.gyro_unit),)),
        "isv": (0, lambda: (str(own.saves_left),)),
        "sm": (1, after(own.set_rate)),
        "sd": (1, after(own.set_datagram)),
        "sgu": (1, after(own.set_gyro_unit)),
        "save": (0, lambda: (own.save(),)),
        "xn": (0, lambda: ()),
    }


def banner(own: Settings) -> list[str]:
    """Return what service mode prints on entry and to ``i``."""
    return [
        f"SERIAL NUMBER = {own.serial}",
        "PRODUCT = STIM300",
        f"PART NUMBER = {own.part_number} REV {own.revision}",
        f"FW CONFIG = {own.firmware}",
        f"HW CONFIG = {own.hardware}",
        f"GYRO OUTPUT = {_gyro_text(own)}",
        f"SAMPLE RATE [samples/s] = {own.rate_hz}",
        f"DATAGRAM = {own.identifier:02X}",
        f"BIT-RATE [bits/s] = {own.bit_rate}",
        f"LINE TERMINATION = {'ON' if own.terminated else 'OFF'}",
        f"GYRO LP FILTER -3dB FREQUENCY [Hz] = {_FILTERS_HZ[own.gyro_filter]}",
    ]


def service_lines(own: Settings, command: str, readings: Mapping[str, list[str]]) -> list[str]:
    """Return what service mode prints to a command; Refused for what it does not take.

    ``readings`` are the lines of commands that tell what the device measures and finds.
    """
    name, _, text = command.partition(" ")
    given = [part.strip() for part in text.split(",")] if text else []
    setters: dict[str, tuple[Callable[..., None], int]] = {
        "d": (own.set_datagram, 2),
        "f": (partial(own.set_of_gyros, own.set_gyro_filter), 2),
        "m": (own.set_rate, 1),
        "r": (own.set_termination, 1),
        "t": (own.set_transmission, max(len(given), 1)),
        "u": (partial(own.set_of_gyros, own.set_gyro_unit), 2),
    }
    if name in setters:
        setter, count = setters[name]
        setter(*_exactly(count, given))
        return _information(own, name)
    if name == "i":
        return _information(own, *_exactly(1, given)) if given else banner(own)
    if name == "x":
        if _exactly(1, given)[0] not in ("n", "i", "N", "I"):
            raise Refused(3)
        return [f"SYSTEM RETURNING TO {'NORMAL' if given[0] in 'nN' else 'INIT'} MODE."]
    if name == "?":
        return str(_KNOWN["help"]["text"]).splitlines()
    if name not in readings:
        raise Refused(1)
    return readings[name]


def _information(own: Settings, letter: str) -> list[str]:
    if letter not in _KNOWN["information"]:
        raise Refused(3)
    return [line for line in banner(own) if line.startswith(_KNOWN["information"][letter])]


def _exactly(count: int, given: list[str]) -> list[str]:
    if len(given) != count:
        raise Refused(2)
    return given


def _gyro_text(own: Settings) -> str:
    return _UNIT_NAMES[own.gyro_unit & 3] + (" - DELAYED" if own.gyro_unit & 8 else "")
