"""Settings of a simulated STIM300, and its utility mode, by which a driver reads and changes them."""

from collections.abc import Callable, Collection
from dataclasses import dataclass

from drivers.imus.stim300.codec import DATAGRAM_CODES, LAYOUTS
from drivers.imus.stim300.special import RATES_HZ, Configuration
from drivers.imus.stim300.utility import UtilityMessage, parse_message
from drivers.packaged import packaged_toml
from sims.wires.line_controller import Refused

_KNOWN = packaged_toml("sims", "codes.toml")["stim300"]
_PARITIES = ("n", "e", "o")
_GYRO_UNITS = ("0", "1", "2", "3", "8", "9", "10", "11")
_BITS_A_BYTE = 10
_MARGIN = 1.1


@dataclass(kw_only=True, slots=True)
class Settings:
    """The settings that a STIM300 stores."""

    rate_hz: int
    identifier: int
    gyro_unit: int
    accel_range_g: int
    line_termination: bool
    serial: str
    part_number: str = "84167-440000-3321"
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
        """Return the configuration datagram of these settings: rate, units, filters, serial line and contents."""
        layout = LAYOUTS[self.identifier]
        configuration = Configuration.of(
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
        data = bytearray(configuration.data)
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

    def set_rate(self, code: str) -> None:
        """Set the rate by its digit; Refused if there is none, or the serial line is too slow for it."""
        rate_hz = RATES_HZ[int(_one_of(code, tuple("01234")))]
        self._fit(rate_hz, self.identifier)
        self.rate_hz = rate_hz

    def set_datagram(self, code: str) -> None:
        """Set the normal datagram by its letter; Refused if there is none, or the serial line is too slow for it."""
        identifier = DATAGRAM_CODES[_one_of(code, DATAGRAM_CODES)]
        self._fit(self.rate_hz, identifier)
        self.identifier = identifier

    def set_gyro_unit(self, code: str) -> None:
        """Set the unit of the gyro outputs."""
        self.gyro_unit = int(_one_of(code, _GYRO_UNITS))

    def save(self) -> None:
        """Keep the settings, which can be done so often."""
        self.saves_left -= 1

    def _fit(self, rate_hz: int, identifier: int) -> None:
        size = LAYOUTS[identifier].size + 2 * self.line_termination
        if _MARGIN * _BITS_A_BYTE * size * rate_hz > self.bit_rate:
            raise Refused(7)


def utility_reply(settings: Settings, line: bytes) -> UtilityMessage | None:
    """Carry out one line of utility mode, and return the reply to it; None only for an empty line.

    The reply has an error code for a line that is no command (1), a damaged (2) or unknown (3) one, a wrong number of
    fields (4) or a refused value (5), else 0 and what the command shows. Settings are changed in ``settings``.
    """
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
        "sm": (1, settings.set_rate),
        "sd": (1, settings.set_datagram),
        "sgu": (1, settings.set_gyro_unit),
        "save": (0, settings.save),
    }
    needed, act = acts.get(name, (0, lambda: None))
    if len(given) != needed:
        return UtilityMessage(True, (name, "4"))
    try:
        act(*given)
    except Refused:
        return UtilityMessage(True, (name, "5"))
    text = _KNOWN["utility"][name].format(*map(str.upper, given), own=settings)
    return UtilityMessage(True, (name, "0", *(text.split(",") if text else ())))


def _one_of(code: str, known: Collection[str]) -> str:
    if code not in known:
        raise Refused(3)
    return code
