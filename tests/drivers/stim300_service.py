"""STIM300 service mode (TS1524 rev. 31, section 9): what a person would type, and what the device prints."""

from __future__ import annotations

import re
from dataclasses import dataclass

PROMPT = b"\r>"
LEAVING = b"SYSTEM RETURNING TO"
"""Begins the line after which the device leaves service mode, without a prompt."""

ERROR_TEXTS = {
    1: "the device does not know this command",
    2: "wrong number of parameters",
    3: "a parameter is outside of what the device takes",
    4: "the device's memory has been written as often as it can be",
    5: "the device could not write its memory",
    7: "the datagrams would be too long for the rate and the bit rate",
}
"""What the errors E001 to E007 mean."""

_ERROR = re.compile(r"E(\d{3})\b *(.*)")
_LONGEST = 65536


@dataclass(frozen=True, slots=True)
class ServiceReply:
    """What the device printed between the echo of a command and the next prompt."""

    lines: tuple[str, ...]

    @property
    def error(self) -> str:
        """The device's error in its own words and in plain ones; empty when there is none."""
        for line in self.lines:
            match = _ERROR.match(line)
            if match:
                meaning = ERROR_TEXTS.get(int(match[1]), "an error without a name here")
                return f"{line}: {meaning}"
        return ""

    def value(self, key: str) -> str:
        """Return what stands behind ``KEY =``; empty if no line has it."""
        for line in self.lines:
            name, equals, value = line.partition("=")
            if equals and name.strip() == key:
                return value.strip()
        return ""


class ServiceReader:
    """Collects what the device prints until its prompt; what came before the echo of the command is left out."""

    def __init__(self) -> None:
        """Start with nothing read."""
        self._buffer = b""

    def clear(self) -> None:
        """Forget what has come."""
        self._buffer = b""

    def feed(self, data: bytes) -> None:
        """Take in bytes; of more than 64 kB the oldest are dropped."""
        self._buffer = (self._buffer + data)[-_LONGEST:]

    @property
    def at_prompt(self) -> bool:
        """Whether the last that came is a prompt."""
        return self._buffer.endswith(PROMPT)

    def reply(self, command: str) -> ServiceReply | None:
        """Return the reply to this command once it is whole, by its prompt or by the device's leaving."""
        _, echo, behind = self._buffer.partition(command.encode("ascii") + b"\r")
        leaving, _, rest = behind.partition(LEAVING)
        if rest.count(b"\r"):
            return ServiceReply(_lines(leaving + LEAVING + rest.split(b"\r")[0]))
        return ServiceReply(_lines(behind)) if echo and behind.endswith(PROMPT) else None

    @property
    def banner(self) -> ServiceReply:
        """What was printed up to here, which at first is preceded by the rest of a datagram."""
        return ServiceReply(_lines(self._buffer))


def _lines(data: bytes) -> tuple[str, ...]:
    lines = (line.strip() for line in data.decode("latin-1").split("\r"))
    return tuple(line for line in lines if line and line != ">")
