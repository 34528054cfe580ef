"""Xbus messages of Xsens MTi devices: a pure codec, bytes to messages and back.

Facts from the maker's low-level communication protocol, as public drivers and real captures show them.
"""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from drivers.packaged import packaged_codes
from drivers.types import Octets

Bytes = Octets

_START = b"\xfa\xff"  # preamble, and the address of a device that is alone on its wire
_EXTENDED = 0xFF  # in place of a length: the length follows in two bytes
_LONGEST_SHORT = 254
LONGEST_DATA = 2048
"""A message that claims more bytes of data than this is taken for noise; those of an MTi have some hundred."""


class Mid(IntEnum):
    """Message identifiers; the answer to a request has the next number."""

    REQ_DEVICE_ID = 0x00
    INIT = 0x02
    REQ_CONFIGURATION = 0x0C
    GO_TO_MEASUREMENT = 0x10
    REQ_FIRMWARE = 0x12
    REQ_PRODUCT_CODE = 0x1C
    REQ_HARDWARE = 0x1E
    GO_TO_CONFIG = 0x30
    MTDATA2 = 0x36
    WAKE_UP = 0x3E
    RESET = 0x40
    ERROR = 0x42
    REQ_FACTORY_PAGE = 0x90
    OUTPUT_CONFIGURATION = 0xC0

    @property
    def label(self) -> str:
        """Name as the maker's manuals write it."""
        return _LABELS.get(self, self.name.title().replace("_", ""))


_LABELS = {Mid.REQ_DEVICE_ID: "ReqDID", Mid.REQ_FIRMWARE: "ReqFirmwareRev", Mid.REQ_HARDWARE: "ReqHardwareVersion"}


ERRORS = packaged_codes("drivers", "xbus", "error")
ERROR_DATA_OVERFLOW = 41
"""Comes by itself while measuring, never as the answer to a request."""


def error_text(data: bytes) -> str:
    """Return the text of an Error message, code and words."""
    code = data[0] if data else 0
    return f"error {code}: {ERRORS.get(code, 'a code without a public meaning')}"


@dataclass(frozen=True, slots=True, eq=False)
class Messages:
    """Consecutive messages of one identifier and one length: the data of each is a row of ``data`` (n, length)."""

    mid: int
    data: Bytes

    def each(self) -> list[bytes]:
        """Return the data of each message."""
        return [row.tobytes() for row in self.data]


class XbusDecoder:
    """Finds messages in a stream. Malformed input is dropped and counted, never raised."""

    def __init__(self) -> None:
        """Start unlocked."""
        self._buffer = b""
        self.dropped_bytes = 0
        self.bad_messages = 0

    def feed(self, data: bytes) -> list[Messages]:
        """Return the messages completed by these bytes, consecutive ones of a kind together."""
        self._buffer += data
        return self._scan(at_end=False)

    def flush(self) -> list[Messages]:
        """Return the messages inside a longer one that began but never ended, for when no more bytes come."""
        return self._scan(at_end=True)

    def _scan(self, *, at_end: bool) -> list[Messages]:
        """Return the messages in the buffer, in order, and remove them from it.

        Messages with the same header that follow one another are returned together. Bytes of none are removed and
        counted, damaged messages too. An unfinished message is kept; ``at_end`` no more bytes are waited for, and the
        search goes on inside it.
        """
        view, position = self._buffer, 0
        found: list[Messages] = []
        while True:
            start = view.find(_START, position)
            if start < 0:
                start = max(len(view) - view.endswith(_START[:1]), position)
            self.dropped_bytes += start - position
            position = start
            head, length = _header(view, position)
            size = head + length + 1
            whole = head > 0 and len(view) >= position + size
            if not whole and length <= LONGEST_DATA and not (at_end and len(view) > position):
                break
            count = _valid_run(view, position, head, size) if whole and length <= LONGEST_DATA else 0
            if count:
                rows = np.frombuffer(view, dtype=np.uint8, count=count * size, offset=position).reshape(count, size)
                found.append(Messages(view[position + 2], rows[:, head:-1]))
                position += count * size
            else:
                self.bad_messages += 1
                self.dropped_bytes += 1
                position += 1
        self._buffer = view[position:]
        return found


def _header(view: bytes, position: int) -> tuple[int, int]:
    """Return the length of the header at ``position`` and the length of its data; (0, 0) while more bytes are needed to
    tell.
    """
    if len(view) < position + 4:
        return 0, 0
    if view[position + 3] != _EXTENDED:
        return 4, view[position + 3]
    if len(view) < position + 6:
        return 0, 0
    return 6, int.from_bytes(view[position + 4 : position + 6], "big")


def _valid_run(view: bytes, position: int, head: int, size: int) -> int:
    """Return how many complete messages follow one another from ``position`` with one header and a valid checksum.

    ``head`` is the length of the header, ``size`` that of a message, both in bytes.
    """
    header = view[position : position + head]
    count = 0
    while position + size <= len(view) and view.startswith(header, position):
        if sum(view[position + 1 : position + size]) & 0xFF:
            break
        count += 1
        position += size
    return count


def encode(mid: int, data: bytes = b"") -> bytes:
    """Return one message; ValueError if the data is too long for one."""
    return frame(mid, np.frombuffer(data, dtype=np.uint8)[None])


def frame(mid: int, data: Bytes) -> bytes:
    """Return n messages of type ``mid`` around their data (n, length), with header and checksum.

    ValueError if the data are too long.
    """
    count, length = data.shape
    if length > LONGEST_DATA:
        raise ValueError(f"a message carries at most {LONGEST_DATA} bytes, not {length}")
    size = bytes([length]) if length <= _LONGEST_SHORT else bytes([_EXTENDED]) + length.to_bytes(2, "big")
    header = _START + bytes([mid]) + size
    rows = np.empty((count, len(header) + length + 1), dtype=np.uint8)
    rows[:, : len(header)] = np.frombuffer(header, dtype=np.uint8)
    rows[:, len(header) : -1] = data
    # All bytes after the preamble add up to a multiple of 256; sums of uint8 wrap by themselves.
    rows[:, -1] = np.negative(rows[:, 1:-1].sum(axis=1, dtype=np.uint8))
    return rows.tobytes()


def serial_of(data: bytes) -> str:
    """Return the serial number, as it is printed on the device, of the answer to REQ_DEVICE_ID (4 or 8 bytes)."""
    return data[-4:].hex().upper()


def product_of(data: bytes) -> str:
    """Return the product code of the answer to REQ_PRODUCT_CODE, which is filled up with blanks."""
    return data.decode("ascii", errors="replace").strip(" \0")


def firmware_of(data: bytes) -> str:
    """Return the firmware of the answer to REQ_FIRMWARE: three numbers, and the build where there is one."""
    version = ".".join(str(part) for part in data[:3])
    return f"{version} build {int.from_bytes(data[3:7], 'big')}" if len(data) >= 7 else version
