"""The Galil DMC language: framing, status words, and its codes in plain words. No I/O.

Sources: DMC-2x00, DMC-1700 and DMC-1400 manuals (framing, TS bits), code tables of public drivers (TC, SC).
Upper-case two-letter commands, axis letters A to H (X, Y, Z, W are A to D), ended by CR. The answer is ``:``, or
data, CR LF and ``:``, or ``?`` for a refusal, whose code ``TC1`` tells.
"""

import re
import secrets
from dataclasses import dataclass

from drivers.packaged import packaged_codes
from drivers.requests.exchange import Framed, Token

LONGEST_LINE = 80

# Stop codes (SC) that end a motion by something else than the master.
FORWARD_LIMIT, REVERSE_LIMIT = 2, 3
AT_TARGET, STOPPED, ABORT_INPUT, ABORTED, OFF_ON_ERROR, HOMED, AMPLIFIER_FAULT = 1, 4, 6, 7, 8, 10, 15
FATAL_STOPS = frozenset({ABORT_INPUT, OFF_ON_ERROR, 11, 12, AMPLIFIER_FAULT, 16})
LIMIT_STOPS = frozenset({FORWARD_LIMIT, REVERSE_LIMIT})

STOP_CODES = packaged_codes("drivers", "galil", "stop")

UNRECOGNIZED, OUT_OF_RANGE, NOT_WHILE_RUNNING, NOT_JOGGING = 1, 6, 7, 13
MOTOR_OFF, RUNNING, ON_LIMIT = 20, 21, 22

ERROR_CODES = packaged_codes("drivers", "galil", "error")

NOTHING = re.compile("")
NUMBER = re.compile(r"-?\d{1,15}(\.\d{1,15})?")
TEXT = re.compile(r"[\x20-\x7e\n]+")
_REVISION = re.compile(r"(\S+)\s+Rev\S*\s+(\S+)")
_PROMPT = re.compile(rb"(?:\A|[\r\n])([:?])")


def _flag(mask: int, meaning: str, *, when_low: bool = False) -> property:
    """Return a property that tells whether a bit of the word is set; with ``when_low``, whether it is not set."""
    return property(lambda switches: bool(switches.word & mask) is not when_low, doc=meaning)


@dataclass(frozen=True, slots=True)
class Switches:
    """The TS word of an axis. Bits: 7 moving, 6 error beyond ER, 5 motor off, 3 and 2 limit switches *inactive*."""

    word: int

    moving = _flag(0x80, "Whether a motion is under way.")
    error_exceeded = _flag(0x40, "Whether the following error is beyond ER.")
    motor_off = _flag(0x20, "Whether the motor is off.")
    forward_limit = _flag(0x08, "Whether the forward limit switch is pressed.", when_low=True)
    reverse_limit = _flag(0x04, "Whether the reverse limit switch is pressed.", when_low=True)
    latched = _flag(0x01, "Whether the position latch has caught.", when_low=True)

    @property
    def text(self) -> str:
        """All of it in words."""
        words = ["motor off" if self.motor_off else "motor on", "moving" if self.moving else "standing"]
        words += ["following error too large"] * self.error_exceeded
        words += ["on its forward limit switch"] * self.forward_limit
        words += ["on its reverse limit switch"] * self.reverse_limit
        return ", ".join(words)


def stop_text(code: int) -> str:
    """Return a stop code in plain words."""
    return STOP_CODES.get(code, "stopped for an unknown reason")


def error_of(tc1: str) -> tuple[int, str]:
    """Return code and plain words of an answer to TC1; the controller's own words where we have none."""
    head, _, tail = tc1.strip().partition(" ")
    code = int(head) if head.isdecimal() else 0
    return code, ERROR_CODES.get(code, tail.strip() or "no reason given")


def revision(text: str) -> tuple[str, str]:
    """Return model and firmware of an answer to ^R^V, such as "DMC2143 Rev 1.0o"."""
    found = _REVISION.search(text)
    return (found[1], found[2]) if found else (text.replace("\n", " ").strip(), "")


ACCELERATION_STEP = 1024  # counts/s2


def floor_acceleration(counts_per_s2: float) -> int:
    """Return the acceleration that AC and DC set: a multiple of 1024, rounded down, at least 1024."""
    return max(int(counts_per_s2) // ACCELERATION_STEP, 1) * ACCELERATION_STEP


class GalilFraming:
    """Bytes of requests and answers. Echo may be on or off: a first line that repeats the request is skipped.

    The token has the controller print a word that it has never printed before (``MG "word"``). No other answer is that
    word; an echo has it in quotation marks.
    """

    idle = b""
    settle_s = 0.0

    def request(self, line: str) -> bytes:
        """Return a command line, ended by CR."""
        return line.encode("ascii") + b"\r"

    def answer(self, line: str, received: bytes) -> Framed | None:
        """Return the text up to the prompt at the beginning of a line (":", or "?" for a refusal); None without a
        prompt.

        A ``line`` that is echoed is skipped, as are empty lines; the length counts all bytes up to the prompt.
        """
        body = received.removeprefix(line.encode("ascii"))
        prompt = _PROMPT.search(body)
        if prompt is None:
            return None
        lines = re.split("[\r\n]+", body[: prompt.start(1)].decode("ascii", "replace"))
        text = "\n".join(stripped for one in lines if (stripped := one.strip()))
        return Framed(text, prompt[1] == b"?", len(received) - len(body) + prompt.end())

    def token(self) -> Token:
        """Return a token with a new word. Its leading CR terminates a line that was cut off on its way."""
        word = f"T{secrets.token_hex(4).upper()}".encode()
        pattern = re.compile(rb':?[ \r\n]*(?<!")' + word + rb"[ ]*\r\n:")

        def find(received: bytes) -> tuple[int, int] | None:
            found = pattern.search(received)
            return found.span() if found else None

        return Token(b'\rMG "' + word + b'"\r', find)
