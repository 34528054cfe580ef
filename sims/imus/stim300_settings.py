"""How a simulated STIM300 is set, and how it is asked and told: its service and utility modes."""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from functools import partial

from drivers.imus.stim300.codec import DATAGRAM_CODES, LAYOUTS
from drivers.imus.stim300.special import BIT_RATES, RATES_HZ, Configuration
from drivers.imus.stim300.utility import UtilityMessage, parse_message
from drivers.packaged import packaged_codes, packaged_toml
from sims.wires.line_controller import Refused

_KNOWN = packaged_toml("sims", "codes.toml")["stim300"]
_FILTERS_HZ = packaged_codes("sims", "stim300", "filter")
_PARITIES = ("n", "e", "o")
_CODES = {
    "gyro_unit": ("0", "1", "2", "3", "8", "9", "10", "11"),
    "gyro_filter": [*map(str, _FILTERS_HZ)],
    "terminated": ("0", "1"),
}
SERVICE_ERRORS = packaged_codes("sims", "stim300", "service")
_UNIT_NAMES = {0: "ANGULAR RATE", 1: "INCREMENTAL ANGLE", 2: "AVERAGE ANGULAR RATE", 3: "INTEGRATED ANGLE"}
_BITS_A_BYTE = 10
_MARGIN = 1.1


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
    terminated: int = 0
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

    @property
    def rate_code(self) -> int:
        """Digit of the rate."""
        return RATES_HZ.index(self.rate_hz)

    @property
    def datagram_code(self) -> str:
        """Letter of the normal datagram."""
        return next(code for code, identifier in DATAGRAM_CODES.items() if identifier == self.identifier)

    @property
    def gyro_filter_hz(self) -> str:
        """Cutoff of the low pass."""
        return _FILTERS_HZ[self.gyro_filter]

    @property
    def gyro_text(self) -> str:
        """What the gyros put out, in the words of service mode."""
        return _UNIT_NAMES[self.gyro_unit & 3] + (" - DELAYED" if self.gyro_unit & 8 else "")

    @property
    def termination_text(self) -> str:
        """Whether there is a resistor between the wires of the receiver, likewise."""
        return "ON" if self.terminated else "OFF"

    def set_rate(self, code: str) -> None:
        """Set the rate by its digit."""
        rate_hz = RATES_HZ[int(_one_of(code, tuple("01234")))]
        self._fit(rate_hz, self.identifier)
        self.rate_hz = rate_hz

    def set_datagram(self, code: str, end: str | None = None) -> None:
        """Set the normal datagram by its letter, and whether CR LF ends it, "0" or "1"."""
        identifier = DATAGRAM_CODES[_one_of(code, DATAGRAM_CODES)]
        terminated = self.line_termination if end is None else _one_of(end, ("0", "1")) == "1"
        self._fit(self.rate_hz, identifier)
        self.identifier, self.line_termination = identifier, terminated

    def set_code(self, field: str, code: str) -> None:
        """Set what is kept by a code of its own."""
        setattr(self, field, int(_one_of(code, _CODES[field])))

    def set_of_gyros(self, field: str, cluster: str, code: str) -> None:
        """Set something of a cluster; only that of the gyros can be set."""
        _one_of(cluster, ("g",))
        self.set_code(field, code)

    def set_transmission(self, code: str, *more: str) -> None:
        """Set the bit rate, by its digit or as f and a number, then stop bits and parity if they are given."""
        rates = {str(i): str(rate) for i, rate in enumerate(BIT_RATES)}
        given = more if code == "f" else (rates.get(code, ""), *more)
        rate, stop_bits, parity = _exactly(3, list(given) if given[1:] else [*given, str(self.stop_bits), self.parity])
        if not rate.isdecimal() or stop_bits not in ("1", "2") or parity not in _PARITIES:
            raise Refused(3)
        self._fit(self.rate_hz, self.identifier, int(rate))
        self.bit_rate, self.stop_bits, self.parity = int(rate), int(stop_bits), parity

    def save(self) -> None:
        """Keep the settings, which can be done so often."""
        self.saves_left -= 1

    def _fit(self, rate_hz: int, identifier: int, bit_rate: int = 0) -> None:
        size = LAYOUTS[identifier].size + 2 * self.line_termination
        if _MARGIN * _BITS_A_BYTE * size * rate_hz > (bit_rate or self.bit_rate):
            raise Refused(7)


def utility_reply(own: Settings, line: bytes) -> UtilityMessage | None:
    """Return the reply to one line, which may be damaged; None if it is none of utility mode's."""
    if not line.startswith(b"$"):
        return UtilityMessage(True, ("", "1")) if line else None
    command = parse_message(line + b"\r")
    if command is None:
        return UtilityMessage(True, ("", "2"))
    name, *given = command.fields
    if name not in _KNOWN["utility"]:
        return UtilityMessage(True, ("", "3"))
    acts: dict[str, tuple[int, Callable[..., object]]] = {
        "ig": (1, lambda axis: _one_of(axis.upper(), tuple("XYZ"))),
        "sm": (1, own.set_rate),
        "sd": (1, own.set_datagram),
        "sgu": (1, partial(own.set_code, "gyro_unit")),
        "save": (0, own.save),
    }
    needed, act = acts.get(name, (0, lambda: None))
    if len(given) != needed:
        return UtilityMessage(True, (name, "4"))
    try:
        act(*given)
    except Refused:
        return UtilityMessage(True, (name, "5"))
    said = _KNOWN["utility"][name].format(*map(str.upper, given), own=own)
    return UtilityMessage(True, (name, "0", *(said.split(",") if said else ())))


def banner(own: Settings) -> list[str]:
    """Return what service mode prints on entry and to ``i``."""
    return [line.format(own=own) for line in _KNOWN["banner"].values()]


def service_lines(own: Settings, command: str, readings: Mapping[str, list[str]]) -> list[str]:
    """Return what service mode prints to a command; Refused for what it does not take.

    ``readings`` are the lines of commands that tell what the device measures and finds.
    """
    name, _, text = command.partition(" ")
    given = [part.strip() for part in text.split(",")] if text else []
    setters: dict[str, tuple[Callable[..., None], int]] = {
        "d": (own.set_datagram, 2),
        "f": (partial(own.set_of_gyros, "gyro_filter"), 2),
        "m": (own.set_rate, 1),
        "r": (partial(own.set_code, "terminated"), 1),
        "t": (own.set_transmission, max(len(given), 1)),
        "u": (partial(own.set_of_gyros, "gyro_unit"), 2),
    }
    if name in setters:
        setter, count = setters[name]
        setter(*_exactly(count, given))
        return _information(own, name)
    if name == "i":
        return _information(own, *_exactly(1, given)) if given else banner(own)
    if name == "x":
        _one_of(_exactly(1, given)[0], ("n", "i", "N", "I"))
        return [f"SYSTEM RETURNING TO {'NORMAL' if given[0] in 'nN' else 'INIT'} MODE."]
    if name == "?":
        return str(_KNOWN["help"]["text"]).splitlines()
    if name not in readings:
        raise Refused(1)
    return readings[name]


def _information(own: Settings, letter: str) -> list[str]:
    return [_KNOWN["banner"][_one_of(letter, [key for key in _KNOWN["banner"] if len(key) == 1])].format(own=own)]


def _one_of(code: str, known: Collection[str]) -> str:
    if code not in known:
        raise Refused(3)
    return code


def _exactly(count: int, given: list[str]) -> list[str]:
    if len(given) != count:
        raise Refused(2)
    return given
