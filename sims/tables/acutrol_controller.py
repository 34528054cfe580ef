"""Twin of an ACUTROL controller over the table model: interlocks, modes, demands, limits, as open drivers use them.

The maker's manuals are not public. What the open drivers do not show is chosen here, on the hard side for a driver:
angles are told within one turn, a position demand is reached on the shorter way, a change of it is 180 deg at most,
a rate demand of long ago still holds when rate mode is entered. The prefix of an answer is true in its length only.
"""

import re
from collections.abc import Callable, Iterable

from drivers.packaged import packaged_toml
from sims.tables.acutrol_axis import LIMITED_MODES, AclError, AcutrolAxisTwin
from sims.wires.line_controller import LineController, TableTwinSetup, number

_VTRIP = 1.1
_JERK_DPS3 = 100_000.0

_WORDS: dict[str, list[str]] = packaged_toml("sims", "codes.toml")["acutrol"]


class AcutrolController(LineController):
    """A controller of the Acutrol language; a line ends with LF, and empty lines are ignored."""

    ends, skipped, longest = b"\n", b"", 256

    def __init__(
        self,
        setup: TableTwinSetup,
        write: Callable[[bytes], None],
        *,
        wrapped: bool = True,
        identity: str = "Acutronic,ACUTROL3000,{serial},2.4",
    ) -> None:
        """Prepare for axes with numbers as addresses; answers begin with as many digits as the option ``reply_prefix``.

        ``wrapped`` angles are reported within 0 to 360 deg; ``identity`` is the answer to *idn?, with the serial
        number.
        """
        super().__init__(setup, write)
        self._prefix_length = setup.options["reply_prefix"]
        self._identity = identity.format(serial=3117 + setup.number)
        self._axes = {number: AcutrolAxisTwin(setup.table, axis, wrapped) for axis, number in setup.addresses.items()}
        self._answers = 0

    def _is_powered(self) -> bool:
        return any(axis.powered for axis in self._axes.values())

    def _take(self, line: bytes) -> None:
        """Carry out a line and send its answer, or the text of an AclError, behind the running number of answers.

        The number is cut to the length of the prefix, and left out if that is 0. An empty line has no answer. The axes
        are brought up to date first.
        """
        if not line.strip():
            return
        for axis in self._axes.values():
            axis.update()
        try:
            text = self._carry_out(line.decode("ascii", "replace").strip().lower())
        except AclError as error:
            text = str(error)
        self._answers += 1
        prefix = f"{self._answers:08d}".rjust(self._prefix_length, "0")[-self._prefix_length :]
        self._write(f"{prefix if self._prefix_length else ''}{text}\r\n".encode("ascii", "replace"))

    def _carry_out(self, line: str) -> str:
        """Carry out the commands of a line, separated by ";", and return their values joined by it; OK without any.

        A command without a subsystem belongs to that of the one before. *idn? and *stb? are lines of their own.
        AclError if a command fails; those before it have been carried out.
        """
        if line == "*idn?":
            return self._identity
        if line == "*stb?":
            return "65" if any(axis.faulty for axis in self._axes.values()) else "0"
        subsystem = ""
        values = []
        for part in line.split(";"):
            match = re.fullmatch(r"(?::([a-z]+))?:?([a-z]*)(\?)? ?(.*)", part.strip())
            if match is None or not (match[1] or subsystem):
                raise AclError("Command not recognized")
            subsystem = _full(match[1], _WORDS) if match[1] else subsystem
            if (value := self._part(subsystem, match[2], bool(match[3]), match[4])) != "OK":
                values.append(value)
        return ";".join(values) or "OK"

    def _part(self, subsystem: str, word: str, query: bool, arguments: str) -> str:
        """Carry out one command, or query, of a subsystem and return its answer, OK if it has no value.

        ``arguments`` are separated by commas, the axis first. An interlock command without an axis is for all; commands
        of the subsystem utility do nothing. Those of any but limit, interlock, mode and read are demands of the second
        argument, or queries of the present demand. AclError if the command is wrong or refused.
        """
        given = [argument.strip() for argument in arguments.split(",")]
        if subsystem == "utility":
            return "OK"
        if subsystem == "limit":
            return self._limit(_full(word, _WORDS["limit"]), query, given)
        axis = self._axis(given[0]) if given[0] else None
        if subsystem == "interlock" and axis is None and not query:
            for each in self._axes.values():
                each.interlock(_full(word, _WORDS["interlock"]))
            return "OK"
        if axis is None:
            raise AclError("Axis missing")
        if subsystem == "interlock":
            if query:
                return "Fault" if axis.faulty else "Closed" if axis.powered else "Open"
            axis.interlock(_full(word, _WORDS["interlock"]))
        elif subsystem == "mode":
            if query:
                return axis.mode.capitalize()
            axis.enter(_full(word or given[-1], _WORDS["mode"]))
        elif subsystem == "read":
            return f"{axis.read(_full(word, _WORDS['read'])):.6f}"
        else:
            return self._demand(axis, _full(word, _WORDS["demand"]), query, given[1:])
        return "OK"

    def _demand(self, axis: AcutrolAxisTwin, quantity: str, query: bool, given: list[str]) -> str:
        """Demand the value ``given`` of an axis and return OK, or return the present demand if ``query``.

        AclError unless ``given`` is one number, or empty for a query, and if the axis refuses it.
        """
        if len(given) != (0 if query else 1):
            raise AclError("Wrong number of arguments")
        if query:
            return f"{axis.demanded(quantity):.6f}"
        axis.demand(quantity, number(given[0], AclError("Parameter error")))
        return "OK"

    def _limit(self, quantity: str, query: bool, given: list[str]) -> str:
        """Set a limit of an axis in a mode and return OK, or return its value if ``query``.

        "absolute" always returns six values of an axis, joined by commas: its largest rate, acceleration and jerk, the
        ends of its position, and the rate that trips. ``given`` are the arguments: mode, axis and, to set it, the
        value; for "absolute" the axis alone. AclError for wrong ones.
        """
        if quantity == "absolute":
            most = self._axis(given[0]).most
            values = (most["rate"], most["acceleration"], _JERK_DPS3, -1e6, 1e6, most["rate"] * _VTRIP)
            return ",".join(f"{value:.6f}" for value in values)
        if len(given) != (2 if query else 3):
            raise AclError("Wrong number of arguments")
        mode, axis = _full(given[0], LIMITED_MODES), self._axis(given[1])
        if query:
            return f"{axis.limits[quantity, mode]:.6f}"
        axis.set_limit(quantity, mode, number(given[2], AclError("Parameter error")))
        return "OK"

    def _axis(self, text: str) -> AcutrolAxisTwin:
        axis = self._axes.get(int(text)) if text.isdecimal() else None
        if axis is None:
            raise AclError("Axis not available")
        return axis

    def _master_is_silent(self) -> None:
        for axis in self._axes.values():
            axis.update()
            axis.power_down()


def _full(word: str, words: Iterable[str]) -> str:
    """Return the first word that begins with a short form; AclError if there is none."""
    for full in words:
        if word and full.startswith(word):
            return full
    raise AclError("Command not recognized")
