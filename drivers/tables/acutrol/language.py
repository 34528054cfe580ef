"""A subset of the ACUTROL command language (ACL): framing and answers. No I/O.

It is what open drivers show (AcutronicRobotics/acutrol over TCP, IEAv-EFO/acutrol3000): lines ended by CR LF, words
between colons, the axis first among the arguments; every answer has a prefix of fixed length, then OK, a value or a
text. What they do not show is not used: the format of the prefix, the texts of errors, a flag for "in position".
"""

import random
import re
from collections import deque

from drivers.requests.exchange import Framed, Token

OK = re.compile("OK")
NUMBER = re.compile(r"[-+]?\d{1,15}(\.\d{0,15})?([eE][-+]?\d{1,2})?")
NUMBERS = re.compile(rf"{NUMBER.pattern}(, ?{NUMBER.pattern})*")
WORD = re.compile(r"(?!OK$)[A-Za-z][A-Za-z ]*")
TEXT = re.compile(r"(?!OK$)[\x20-\x7e]*[A-Za-z][\x20-\x7e]*")

INTERLOCK_SUMMARY = 0x01  # of the status byte: seen as 65 = this and the master summary, 64

_TOKENS_REMEMBERED = 64


def absolute_limits(text: str) -> tuple[float, float] | None:
    """Return the maker's limits of an axis from the answer to ``:limit:absolute?``, in deg/s and deg/s2.

    They are the first of the values; None if there are fewer than two.
    """
    values = [float(value) for value in text.split(",")]
    return (values[0], values[1]) if len(values) >= 2 else None


def refusal(text: str) -> bool:
    """Return whether an answer is the controller's text for a refusal."""
    return bool(TEXT.fullmatch(text)) and not NUMBER.fullmatch(text)


class AcutrolFraming:
    """Bytes of requests and answers.

    The token writes a number where it does no harm, the rate limit of the synthesis mode of one axis, and reads it
    back. Its answer is OK, then that number. Its limits: an angle or rate could by chance give the same number, one of
    9,900, after an OK. A controller without this limit, or with steps coarser than 0.01 deg/s, cannot be brought back
    in step and counts as silent, which shows when the link is opened. The limit keeps the last number written.
    """

    idle = b""
    settle_s = 0.0

    def __init__(self, axis_number: int, largest_rate_dps: float, prefix_length: int) -> None:
        """Prepare for a token that writes and reads back the rate limit of axis ``axis_number``.

        The numbers written are from 1 to 99.99 deg/s and stay below ``largest_rate_dps``, what the axis may have as a
        limit; if that is not above 2 deg/s, they begin at 0.01, and repeat the sooner the fewer they are.
        ``prefix_length`` is the number of bytes before each answer.
        """
        self._axis, self._prefix = axis_number, prefix_length
        self._largest = min(max(int(largest_rate_dps * 100) - 1, 1), 9999)
        self._least = 100 if self._largest >= 200 else 1
        self._used: deque[int] = deque(maxlen=min((self._largest - self._least) // 2, _TOKENS_REMEMBERED))
        self._random = random.SystemRandom()
        self._pattern = re.compile(
            rb"[\s\S]{%d}OK *\r?\n[\s\S]{%d} *(%s) *\r?\n"
            % (prefix_length, prefix_length, NUMBER.pattern.encode("ascii"))
        )

    def request(self, line: str) -> bytes:
        """Return a command line, ended by CR LF."""
        return line.encode("ascii") + b"\r\n"

    def answer(self, line: str, received: bytes) -> Framed | None:
        """Return the line behind the prefix; the prefix may hold any byte."""
        end = received.find(b"\n", self._prefix)
        if end < 0:
            return None
        return Framed(received[self._prefix : end].decode("ascii", "replace").strip(), False, end + 1)

    def token(self) -> Token:
        """Return a token with a random number that was not used lately.

        Sending it makes the number, in 0.01 deg/s, the axis's rate limit of the synthesis mode, and reads that back.
        The leading line end terminates a line that was cut off on its way.
        """
        number = self._random.randint(self._least, self._largest)
        while number in self._used:
            number = self._random.randint(self._least, self._largest)
        self._used.append(number)
        write = f"\r\n:lim:rate synt,{self._axis},{number / 100:05.2f}\r\n"
        ask = f":limit:rate? synt,{self._axis}\r\n"

        def find(received: bytes) -> tuple[int, int] | None:
            start = 0
            while found := self._pattern.search(received, start):
                if abs(float(found[1]) * 100 - number) < 0.6:
                    return found.span()
                start = found.start() + 1
            return None

        return Token((write + ask).encode("ascii"), find)
