"""STIM300 utility mode (TS1524 rev. 31, section 10): a pure codec of ``$command,..,crc`` and ``#reply,..,crc``."""

import re
from dataclasses import dataclass

from drivers.imus.checks import Check

_LONGEST = 100  # characters, without the CR
_MESSAGE = re.compile(rb"[$#][ -~]*,[0-9]{1,3}\r")

crc8 = Check("crc", 8, polynomial=0x07, init=0xFF).of
"""CRC-8 (poly 07, init FF, not reflected, no final xor)."""


@dataclass(frozen=True, slots=True)
class UtilityMessage:
    """A command or a reply: its name, which a refused reply may lack, and its fields up to the CRC."""

    reply: bool
    fields: tuple[str, ...]


def encode_message(message: UtilityMessage) -> bytes:
    """Return the bytes of a message; ValueError if it would be none: too long, or with commas in its fields."""
    text = ("#" if message.reply else "$") + ",".join(message.fields) + ","
    raw = f"{text}{crc8(text.encode('ascii'))}".encode("ascii") + b"\r"
    if not _MESSAGE.fullmatch(raw) or len(raw) > _LONGEST + 1 or text.count(",") != len(message.fields):
        raise ValueError(f"{text!r} is no message of utility mode")
    return raw


def parse_message(raw: bytes) -> UtilityMessage | None:
    """Return the message in ``raw``, which ends with its CR; None if it is malformed, too long or has a wrong CRC."""
    if len(raw) > _LONGEST + 1 or not _MESSAGE.fullmatch(raw):
        return None
    body, crc = raw[:-1].rsplit(b",", 1)
    if int(crc) != crc8(body + b","):
        return None
    return UtilityMessage(raw[:1] == b"#", tuple(body[1:].decode("ascii").split(",")))
