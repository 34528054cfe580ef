"""VectorNav VN-100, 200, 300: ASCII sentences and binary frames in one stream; a pure codec, bytes to values and back.

Facts: VN-100 User Manual UM001, 4.2 and 5.1; field sizes also from VectorNav's own programming library and SDK (MIT).
"""

import binascii
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from drivers.packaged import packaged_codes, packaged_toml

IMU_RATE_HZ = 800
"""Binary output comes at this rate over a whole number."""
ASCII_RATES_HZ = (1, 2, 4, 5, 10, 20, 25, 40, 50, 100, 200)
"""What register 7 takes."""

RATES_HZ: Mapping[str, tuple[int, ...]] = {
    "binary": tuple(rate_hz for rate_hz in range(1, IMU_RATE_HZ + 1) if IMU_RATE_HZ % rate_hz == 0),
    "ascii": ASCII_RATES_HZ,
}
"""Rates of each output."""

COMMON, TIME, IMU, GPS, ATTITUDE, INS, GPS2 = range(7)
"""Output groups by their bit."""

ERRORS = packaged_codes("drivers", "vectornav", "error")

_SYNC = 0xFA
_CRC_SIZE = 2
_MORE_GROUPS = 0x80
_MORE_FIELDS = 0x8000
_LONGEST_SENTENCE = 256

_SENTENCE = re.compile(rb"(VN[A-Z0-9]{3}(?:,[^*]*)?)\*(XX|[0-9A-Fa-f]{4}|[0-9A-Fa-f]{2})")
_NOT_TEXT = re.compile(rb"[^ -#%-~]")  # characters not allowed within a sentence
_FIELD_TEXT = re.compile(r"[ -#%-)+\--~]*")  # printable, none of $ * ,
_HEADER_TEXT = re.compile(r"VN[A-Z0-9]{3}")


def _fields(text: str) -> tuple[tuple[str, np.dtype[Any]], ...]:
    return tuple((name, np.dtype(kind)) for name, kind in (entry.split() for entry in text.split(", ")))


_GROUPS = tuple((name, _fields(text)) for name, text in packaged_toml("drivers", "layouts.toml")["vectornav"].items())
"""Groups by number: the name, and name and type of every field from bit 0 up."""


@dataclass(frozen=True, slots=True)
class Sentence:
    """One ASCII sentence: its ``header``, such as VNRRG, and the fields between the commas."""

    header: str
    fields: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Raise ValueError for a header or field that cannot be sent."""
        if not _HEADER_TEXT.fullmatch(self.header) or not all(map(_FIELD_TEXT.fullmatch, self.fields)):
            raise ValueError(f"{self.header!r}, {self.fields!r} cannot be a VectorNav sentence")

    @property
    def text(self) -> str:
        """The characters between ``$`` and ``*``."""
        return ",".join((self.header, *self.fields))


@dataclass(frozen=True, slots=True)
class Layout:
    """The fields of a binary frame.

    ``dtype`` is the complete frame as a structured type; its fields are named group.field, for instance
    imu.uncomp_gyro. ``masks`` are the field bits of each group, without extension bits.
    """

    header: bytes
    dtype: np.dtype[Any]
    masks: tuple[tuple[int, int], ...]

    @property
    def size(self) -> int:
        """Bytes of a frame, from the sync byte to the CRC."""
        return int(self.dtype.itemsize)

    @property
    def register_fields(self) -> tuple[str, ...]:
        """Groups and fields as registers 75 to 77 hold them, in hex."""
        words = np.frombuffer(self.header[2:], dtype="<u2").tolist()
        return f"{self.header[1]:02X}", *(f"{word:04X}" for word in words)


@dataclass(frozen=True, slots=True, eq=False)
class Frames:
    """Consecutive binary frames of one layout: ``values`` (n,) of ``layout.dtype``."""

    layout: Layout
    values: NDArray[Any]


def layout_of(masks: Mapping[int, int]) -> Layout:
    """Return the layout with these fields, bits by group number; ValueError for groups or fields that are unknown."""
    header = bytes([_SYNC, sum(1 << group for group in masks)]) if set(masks) <= set(range(7)) else b""
    for _, mask in sorted(masks.items()):
        header += mask.to_bytes(2, "little") if 0 <= mask < _MORE_FIELDS else b""
    return layout_of_header(header)


def layout_of_header(header: bytes) -> Layout:
    """Return the layout given by a frame's first bytes, up to the last field word; ValueError if it is unknown."""
    end, masks = _read_header(header, 0)
    if masks is None or end != len(header):
        raise ValueError(f"{header.hex(' ')} is no header of a frame whose fields are known")
    return _layout(header, masks)


def error_code(field: str) -> int:
    """Return the code of a VNERR sentence, which is hex; older firmware writes 10 to 12 and 255 in decimal.

    The two can be told apart, as 0x10 to 0x12 and 0x255 are no codes. -1 if ``field`` is no number.
    """
    try:
        code = int(field, 16)
        return code if code in ERRORS or not field.isdecimal() else int(field)
    except ValueError:
        return -1


def error_text(code: int) -> str:
    """Return a code in words."""
    return f"error {code} ({ERRORS.get(code, 'not in its manual')})"


def encode_sentence(sentence: Sentence, check: Literal["xor", "crc", "none"] = "xor") -> bytes:
    """Return a sentence with its check: XOR, CRC16, or XX, which the device takes for none."""
    body = sentence.text.encode("ascii")
    text = {"xor": f"{_xor(body):02X}", "crc": f"{binascii.crc_hqx(body, 0):04X}", "none": "XX"}[check]
    return b"$" + body + b"*" + text.encode("ascii") + b"\r\n"


def encode_frames(layout: Layout, values: NDArray[Any]) -> bytes:
    """Return frames as the device sends them: a copy of ``values`` (n,), of ``layout.dtype``, with header and CRC."""
    rows = values.copy()
    rows["header"] = np.void(layout.header)
    raw, body = rows.tobytes(), layout.size - _CRC_SIZE
    rows["crc"] = [binascii.crc_hqx(raw[at + 1 : at + body], 0) for at in range(0, len(raw), layout.size)]
    return rows.tobytes()


class VectorNavDecoder:
    """Finds sentences and frames in a stream. Malformed input is dropped and counted, never raised."""

    def __init__(self, *, binary: bool = True) -> None:
        """Start unlocked; ``binary`` is False at the device's end, where only sentences come in."""
        self._buffer = b""
        self._start = re.compile(rb"[$\xfa]" if binary else rb"\$")
        self.dropped_bytes = 0
        self.bad_frames = 0
        self.bad_sentences = 0

    def feed(self, data: bytes) -> list[Sentence | Frames]:
        """Return the sentences and frames that these bytes complete, in order, consecutive frames of one layout
        together.
        """
        self._buffer += data
        return self._take(ended=False)

    def flush(self) -> list[Sentence | Frames]:
        """Return what lies behind a beginning that was never completed, after a pause in the stream."""
        return self._take(ended=True)

    def _take(self, *, ended: bool) -> list[Sentence | Frames]:
        """Return the sentences and frames in the buffer, in order, and remove them from it.

        Bytes that belong to none are removed and counted, damaged frames and sentences too. An unfinished one is kept,
        unless the stream has ``ended``: then it is searched for what lies inside.
        """
        found: list[Sentence | Frames] = []
        view, position = self._buffer, 0
        while (start := self._start.search(view, position)) is not None:
            self.dropped_bytes += start.start() - position
            position = start.start()
            is_frame = view[position] == _SYNC
            item, end = _frames_at(view, position) if is_frame else _sentence_at(view, position)
            if item is not None:
                found.append(item)
                position = end
            elif end > len(view) and not ended:
                break
            else:
                # With an end it began as a sentence, so it is damaged; the others are foreign bytes.
                self.bad_frames += is_frame and end > 0
                self.bad_sentences += not is_frame and end > 0
                self.dropped_bytes += 1
                position += 1
        else:
            self.dropped_bytes += len(view) - position
            position = len(view)
        self._buffer = view[position:]
        return found


def _frames_at(view: bytes, at: int) -> tuple[Frames | None, int]:
    """Return the frames of one layout that begin at ``at``, and where they end.

    Without a frame (None): the end it would have, beyond the view if more bytes are needed to tell; 0 if it is no
    frame.
    """
    end, masks = _read_header(view, at)
    if masks is None:
        return None, end
    layout = _layout(view[at:end], masks)
    size, position = layout.size, at
    while (
        position + size <= len(view)
        and view.startswith(layout.header, position)
        and binascii.crc_hqx(view[position + 1 : position + size], 0) == 0  # over its own CRC it gives 0
    ):
        position += size
    if position == at:
        return None, at + size
    return Frames(layout, np.frombuffer(view[at:position], dtype=layout.dtype)), position


def _read_header(view: bytes, at: int) -> tuple[int, tuple[tuple[int, int], ...] | None]:
    """Return where in ``view`` the header of the frame that begins at ``at`` ends, and its (group, bits of fields)
    pairs.

    Without a header (None): an end beyond the view if it is cut off; 0 if it is invalid, that is without fields or with
    unknown groups or fields, whose size is unknown. Both selectors may be extended by a second word, of groups by an
    empty one only.
    """
    position = at + 2
    if position > len(view):
        return position, None
    groups = view[at + 1]
    if groups & _MORE_GROUPS:
        position += 1
        if position > len(view):
            return position, None
        if view[position - 1]:  # groups 8 to 14 and beyond
            return 0, None
    masks = []
    for group in range(7):
        if groups >> group & 1:
            mask, position = _read_fields(view, position)
            if position > len(view):
                return position, None
            if not mask or mask >> len(_GROUPS[group][1]):
                return 0, None
            masks.append((group, mask))
    return (position, tuple(masks)) if masks else (0, None)


def _read_fields(view: bytes, at: int) -> tuple[int, int]:
    word = int.from_bytes(view[at : at + 2], "little")
    if not word & _MORE_FIELDS:
        return word, at + 2
    more = int.from_bytes(view[at + 2 : at + 4], "little")
    # A third word is as unknown as the fields of the second; the mask keeps its bit.
    return word & ~_MORE_FIELDS | more << 15, at + 4


@lru_cache(maxsize=64)
def _layout(header: bytes, masks: tuple[tuple[int, int], ...]) -> Layout:
    fields: list[tuple[str, Any]] = [("header", f"V{len(header)}")]
    for group, mask in masks:
        name, known = _GROUPS[group]
        fields += [(f"{name}.{field}", kind) for bit, (field, kind) in enumerate(known) if mask >> bit & 1]
    return Layout(header, np.dtype([*fields, ("crc", ">u2")]), masks)


def _sentence_at(view: bytes, at: int) -> tuple[Sentence | None, int]:
    """Return the sentence that begins at ``at``, and where it ends.

    Without a sentence (None): an end beyond the view if more bytes are needed to tell, 0 if the start is wrong,
    otherwise the place where it stops being one.
    """
    if not b"$VN".startswith(view[at : at + 3]):
        return None, 0
    stop = _NOT_TEXT.search(view, at + 1, at + _LONGEST_SENTENCE)
    if stop is None:
        return None, len(view) + 1 if len(view) < at + _LONGEST_SENTENCE else at + _LONGEST_SENTENCE
    end = stop.start() + 1
    if stop[0] == b"\r":
        if end == len(view):
            return None, end + 1
        end += view[end] == 0x0A
    match = _SENTENCE.fullmatch(view, at + 1, stop.start()) if view[end - 1] == 0x0A else None
    if match is None or not _check_is_right(match[1], match[2]):
        return None, end
    header, *fields = match[1].decode("ascii").split(",")
    return Sentence(header, tuple(fields)), end


def _check_is_right(body: bytes, check: bytes) -> bool:
    if check == b"XX":
        return True
    return int(check, 16) == (_xor(body) if len(check) == 2 else binascii.crc_hqx(body, 0))


def _xor(body: bytes) -> int:
    return int(np.bitwise_xor.reduce(np.frombuffer(body, dtype=np.uint8)))
