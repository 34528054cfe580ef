"""STIM300 utility mode (TS1524 rev. 31, section 10): a pure codec of ``$command,..,crc`` and ``#reply,..,crc``."""

import re
from dataclasses import dataclass

from drivers.packaged import packaged_codes

STATUS_TEXTS = packaged_codes("drivers", "stim300", "utility")
"""What the status of a reply means (table 10-2)."""

_IDENTIFIERS = (0x90, 0x91, 0x92, 0x93, 0x94, 0xA5, 0xA6, 0xA7, 0xF0, 0xF1, 0xF2, 0xF3, 0xF4, 0xF5, 0xF6, 0xF7)
DATAGRAM_CODES = dict(zip("01234567lmnpqrst", _IDENTIFIERS, strict=True))
"""Ids of normal datagrams by the code that service and utility mode have for them."""

_STATUSES = {str(status) for status in STATUS_TEXTS}
_LONGEST = 100  # characters, without the CR
_MESSAGE = re.compile(rb"[$#][ -~]*,[0-9]{1,3}\r")
_LEAD = re.compile(rb"[$#]")
_NOT_TEXT = re.compile(rb"[^ -~]")


@dataclass(frozen=True, slots=True)
class UtilityMessage:
    """A command or a reply: its name, which a refused reply may lack, and what follows up to the CRC."""

    reply: bool
    fields: tuple[str, ...]

    @property
    def name(self) -> str:
        """The command."""
        return self.fields[0]

    @property
    def status(self) -> int | None:
        """Status of a reply; None where there is none: a command, the greeting, replies that begin with data."""
        if self.reply and len(self.fields) > 1 and self.fields[1] in _STATUSES:
            return int(self.fields[1])
        return None

    @property
    def data(self) -> tuple[str, ...]:
        """What a reply says, behind its status where it has one."""
        return self.fields[1:] if self.status is None else self.fields[2:]


def encode_message(message: UtilityMessage) -> bytes:
    """Return the bytes of a message; ValueError if it would be none: too long, or with commas in its fields."""
    text = ("#" if message.reply else "$") + ",".join(message.fields) + ","
    raw = f"{text}{crc8(text.encode('ascii'))}".encode("ascii") + b"\r"
    if not _MESSAGE.fullmatch(raw) or len(raw) > _LONGEST + 1 or text.count(",") != len(message.fields):
        raise ValueError(f"{text!r} is no message of utility mode")
    return raw


class UtilityDecoder:
    """Finds messages in a stream. Whatever else comes is dropped and counted, never raised."""

    def __init__(self) -> None:
        """Start with nothing read."""
        self._buffer = b""
        self.dropped_bytes = 0
        self.bad_messages = 0

    def feed(self, data: bytes) -> list[UtilityMessage]:
        """Return the messages completed by these bytes."""
        view = self._buffer + data
        found = []
        at = 0
        while at < len(view):
            lead = _LEAD.search(view, at)
            start = lead.start() if lead else len(view)
            self.dropped_bytes += start - at
            at = start
            if lead is None:
                break
            end = _NOT_TEXT.search(view, at, at + _LONGEST + 1)
            if end is None and len(view) <= at + _LONGEST:
                break
            message = _parse(view[at : end.end()]) if end is not None else None
            if message is not None and end is not None:
                found.append(message)
                at = end.end()
            else:
                self.bad_messages += 1
                self.dropped_bytes += 1
                at += 1
        self._buffer = view[at:]
        return found


def crc8(data: bytes) -> int:
    """Return CRC-8 (poly 07, init FF, not reflected, no final xor)."""
    crc = 0xFF
    for byte in data:
        crc = _CRC8[crc ^ byte]
    return crc


def _crc8_table() -> bytes:
    table = bytearray(256)
    for i in range(256):
        crc = i
        for _ in range(8):
            crc = (crc << 1 ^ 0x07) & 0xFF if crc & 0x80 else crc << 1
        table[i] = crc
    return bytes(table)


_CRC8 = _crc8_table()


def _parse(raw: bytes) -> UtilityMessage | None:
    if not _MESSAGE.fullmatch(raw):
        return None
    body, crc = raw[:-1].rsplit(b",", 1)
    if int(crc) != crc8(body + b","):
        return None
    return UtilityMessage(raw[:1] == b"#", tuple(body[1:].decode("ascii").split(",")))
