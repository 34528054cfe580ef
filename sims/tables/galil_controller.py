"""Twin of a Galil DMC motion controller over the table model: commands, answers, motion, switches, stop codes.

It is what the manuals and public code tables say; where they are silent it does the simplest thing. The watchdog is
what a program on a real controller has to do: a DMC has none of its own.
"""

import re
from collections.abc import Callable

from drivers.packaged import packaged_codes, packaged_toml
from drivers.tables.galil.language import LONGEST_LINE, UNRECOGNIZED
from sims.tables.galil_axis import GalilAxisTwin
from sims.wires.line_controller import LineController, Refused, TableTwinSetup, number

_LETTERS = "ABCDEFGH"
_SYNONYMS = str.maketrans("XYZW", "ABCD")
_COMMAND = re.compile(r"([A-Z]{2}) ?(.*)")
_ONE_AXIS = re.compile(r"([A-HW-Z])=(.+)")
_REVISION = "\x12\x16"

_WORDS = packaged_codes("sims", "galil", "error")
_KNOWN = packaged_toml("sims", "codes.toml")["galil"]
_TELL = ("TP", "TV", "TE", "TS", "SC", "TD", "TT")
_SETTINGS = (*_KNOWN["axis"], "DP")
_IN_VOLTS = ("TT", "TL")


class GalilController(LineController):
    """A controller of the Galil language; a carriage return or a semicolon ends a command."""

    ends, longest = b"\r;", LONGEST_LINE

    def __init__(
        self,
        setup: TableTwinSetup,
        write: Callable[[bytes], None],
        *,
        echo: bool = False,
        revision: str = "DMC4030 Rev 1.2c",
        serial: int = 9046,
    ) -> None:
        """Prepare for axes with letters as addresses.

        The option ``velocity_window`` (s) is the averaging time of velocities. ``revision`` is reported when asked for,
        and ``serial``, counted on for each of several controllers; ``echo`` repeats what is received.
        """
        super().__init__(setup, write)
        by_letter = sorted(setup.addresses.items(), key=lambda a: str(a[1]))
        self._table, window_s = setup.table, setup.options["velocity_window"]
        self._axes = {letter: GalilAxisTwin(setup.table, axis, window_s) for axis, letter in by_letter}
        self._echo, self._revision, self._serial = echo, revision, serial + setup.number
        self._error = 0
        self._leading_zeros = False
        self._own: dict[str, list[float]] = {word: list(values) for word, values in _KNOWN["setting"].items()}

    def received(self, data: bytes) -> None:
        """Take bytes from the host, divided anywhere; with echo, each byte is sent back before it is carried out."""
        for part in [bytes([byte]) for byte in data] if self._echo else [data]:
            if self._echo:
                self._write(part.replace(b"\r", b"\r\n"))
            super().received(part)

    def _is_powered(self) -> bool:
        return any(not axis.motor_off for axis in self._axes.values())

    def _take(self, line: bytes) -> None:
        """Carry out a command and send its answer and ":", or "?" for a refusal, whose code TC then reports.

        A line that is too long is refused. The axes are brought up to date first.
        """
        for axis in self._axes.values():
            axis.update()
        try:
            if self._too_long:
                raise Refused(5)
            text = self._command(line.decode("ascii", "replace").strip(" "))
        except Refused as refusal:
            self._error = refusal.code
            self._write(b"?")
            return
        self._write(f"{text}\r\n:".encode() if text else b":")

    def _command(self, command: str) -> str:
        """Carry out a command and return its answer, empty if it has none.

        An empty command does nothing; Refused if it is unknown, or if what carries it out refuses it.
        """
        if not command:
            return ""
        if command == _REVISION:
            return self._revision
        match = _COMMAND.fullmatch(command)
        if match is None:
            raise Refused(UNRECOGNIZED)
        word, operand = match[1], match[2].strip()
        if word == "MG":
            return self._message(operand)
        if word in _SETTINGS:
            return self._setting(word, operand)
        if word in self._own:
            return self._own_setting(word, operand)
        if word in _KNOWN["tell"]:
            return str(_KNOWN["tell"][word])
        if word in _TELL:
            return ",".join(self._number(axis.get(word), word) for axis in self._each(operand))
        return self._act(word, operand)

    def _act(self, word: str, operand: str) -> str:
        """Carry out a command that is neither a setting nor a value, and return its answer, empty if it has none.

        TC returns the code of the last refusal and clears it. Refused if the command is unknown, or if an axis refuses
        it: BG then starts none, other commands may have reached some axes.
        """
        if word == "TC":
            code, self._error = self._error, 0
            return f" {code}" if operand in ("", "0") else f"{code} {_WORDS.get(code, '')}".rstrip()
        if word == "ID":
            return f"FW, {self._revision}"
        if word == "TB":
            return f" {int(self._echo)}"
        if word == "AB":
            for axis in self._axes.values():
                axis.abort()
        elif word == "EO":
            self._echo = operand == "1"
        elif word == "LZ":
            self._leading_zeros = operand == "0"
        elif word == "BG":
            for axis in self._each(operand):
                axis.check_begin()
            for axis in self._each(operand):
                axis.begin()
        elif word in ("SH", "MO", "ST", "HM", "FI"):
            for axis in self._each(operand):
                axis.act(word)
        else:
            raise Refused(UNRECOGNIZED)
        return ""

    def _setting(self, word: str, operand: str) -> str:
        """Set or return values of axes: ``JGA=1000``, ``JGA=?``, ``JG 1000,,500``, ``JG ?,?``; "" after setting.

        ``word`` is the command, ``operand`` the rest. Axes with an empty value are left. Refused if one is invalid, as
        is "?" beside a number; those before it have been set.
        """
        one = _ONE_AXIS.fullmatch(operand)
        if one:
            given = {self._axis(one[1]): one[2]}
        else:
            values = operand.split(",")
            if len(values) > len(_LETTERS):
                raise Refused(4)
            given = {self._axis(_LETTERS[i]): value for i, value in enumerate(values) if value.strip()}
        if given and all(value.strip() == "?" for value in given.values()):
            return ",".join(self._number(axis.get(word), word) for axis in given)
        for axis, value in given.items():
            axis.set(word, number(value, Refused(4)))
        return ""

    def _own_setting(self, word: str, operand: str) -> str:
        """Set values of a setting of the controller, as opposed to its axes, and return those asked for with "?".

        ``operand`` and the answer have values separated by commas; empty ones are left as they are. The answer is "" if
        none was asked for. Refused for too many, of which none is set, or for one that is no number; those before it
        have been set.
        """
        own, values = self._own[word], [value.strip() for value in operand.split(",")]
        if len(values) > len(own):
            raise Refused(4)
        for i, value in enumerate(values):
            if value not in ("", "?"):
                own[i] = number(value, Refused(4))
        return ",".join(f"{own[i]: g}" for i, value in enumerate(values) if value == "?")

    def _message(self, operand: str) -> str:
        """Return texts in quotation marks, numbers, and operands (``_TPA``) as MG prints them, with nothing in between.

        Refused if there are none or one is wrong.
        """
        parts = []
        decimals = round(self._own["VF"][0] % 1 * 10)
        own = {"_BN": self._serial, "_AB": int(not self._table.interlock_open)}
        for part in re.findall(r'"[^"]*"|[^,"]+', operand):
            if part.startswith('"'):
                parts.append(part[1:-1])
            elif part.strip() in own:
                parts.append(f" {own[part.strip()]}.0000")
            elif part.strip().startswith("_"):
                name = part.strip()
                parts.append(f"{self._axis(name[3:]).get(name[1:3]): .{decimals}f}")
            else:
                parts.append(f"{number(part, Refused(4)): .{decimals}f}")
        if not parts:
            raise Refused(4)
        return "".join(parts)

    def _each(self, letters: str) -> list[GalilAxisTwin]:
        return [self._axis(letter) for letter in letters] if letters else list(self._axes.values())

    def _axis(self, letter: str) -> GalilAxisTwin:
        axis = self._axes.get(letter.translate(_SYNONYMS))
        if axis is None:
            raise Refused(UNRECOGNIZED)
        return axis

    def _number(self, value: float, word: str) -> str:
        if word in _IN_VOLTS:
            return f"{value: .4f}"
        whole = round(value)
        if self._leading_zeros:
            return f"{'-' if whole < 0 else ''}{abs(whole):0{3 if word in ('TS', 'SC') else int(self._own['PF'][0])}d}"
        return f"{'' if whole < 0 else ' '}{whole}"

    def _master_is_silent(self) -> None:
        for axis in self._axes.values():
            axis.update()
            axis.power_down()
