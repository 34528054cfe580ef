"""Signals that a DBC describes, taken out of many frames of one message at once.

cantools reads the DBC; its own decoding works frame by frame and takes a hundred times as long.
"""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.errors import DeviceError
from drivers.packaged import packaged_toml
from drivers.types import Flags, Floats, Ints, Octets

MessageKey = tuple[int, bool]
"""What tells a message on the bus: its identifier, or the number of its parameter group; whether 29 bits are meant."""

UNITS: dict[str, dict[str, float]] = packaged_toml("drivers", "codes.toml")["unit"]["si"]
"""What a signal can be, and the size in SI of the units it may have; a temperature without any is in degC."""
_KELVIN = 273.15
_SPELLINGS: dict[str, str] = packaged_toml("drivers", "codes.toml")["unit"]["spelling"]
_WINDOW = 8  # bytes looked at for one signal
_NO_MEASUREMENT = 0xFB  # SAE J1939-71: at and above it the top byte says reserved, indicator, error, not available


def plain_unit(text: str) -> str:
    """Return the spelling used here of a unit as DBC files write it: ``°/s``, ``deg/sec``, ``dps`` are deg/s."""
    text = text.strip().lower()
    for written, plain in _SPELLINGS.items():
        text = text.replace(written, plain)
    return {"c": "degC", "degc": "degC", "celsius": "degC", "k": "K", "degk": "K"}.get(text, text)


def is_j1939(message: Any) -> bool:
    """Return whether cantools calls this a J1939 parameter group."""
    return bool(message.protocol == "j1939")


def parameter_group(identifier: int) -> int:
    """Return the parameter group number of a 29-bit identifier: without priority, source, and destination."""
    group = identifier >> 8 & 0x3FFFF
    return group if group >> 8 & 0xFF >= 0xF0 else group & 0x3FF00


def message_key(message: Any) -> MessageKey:
    """Return the key of a message: its id, and whether that has 29 bits, as equal ids of both kinds differ."""
    return int(message.frame_id), bool(message.is_extended_frame)


class SignalReader:
    """Reader of one signal of one message, in SI units (temperatures in degC).

    ``key`` identifies the message, ``name`` the signal; ``bits`` is the length of the raw number, ``scale`` the value
    of its least significant bit in SI.
    """

    def __init__(
        self,
        *,
        device: str,
        database: Any,
        dbc: Path,
        name: str,
        quantity: str,
        unit: str = "",
        saturates: bool = False,
    ) -> None:
        """Look up ``name``, a ``MESSAGE.Signal``, in cantools' ``database``; DeviceError if it is missing or
        unsuitable.

        Unsuitable is one whose unit is unknown for its ``quantity``, that does not lie within 8 bytes, or a float of
        other than 32 or 64 bits. ``quantity`` is a key of ``UNITS``, or "count" for a plain number; ``unit`` takes
        precedence over the DBC's own. With ``saturates``, values at the ends of the DBC's range count as missing, as
        the true value may be beyond. ``device`` and ``dbc`` are for the error messages.
        """
        message_name, _, signal_name = name.partition(".")
        try:
            self.message: Any = database.get_message_by_name(message_name)
            signal: Any = self.message.get_signal_by_name(signal_name)
        except KeyError:
            raise DeviceError(device, f"{dbc.name} has no signal {name}. Write it as MESSAGE.Signal") from None
        self.name, self.key = signal_name, message_key(self.message)
        self.length = int(self.message.length)
        self.bits = int(signal.length)
        self._si, self._zero = _unit(device, f"{name} in {dbc.name}", quantity, unit or str(signal.unit or ""))
        self.scale = float(signal.scale) * self._si
        self._offset = float(signal.offset) * self._si - self._zero
        self._signed, self._float = bool(signal.is_signed), bool(signal.is_float)
        self._first, self._shift, self._order = _place(signal)
        if not 0 <= self._shift <= 64 - self.bits or (self._float and self.bits not in (32, 64)):
            raise DeviceError(device, f"{name} in {dbc.name} has {self.bits} bits across {_WINDOW + 1} bytes or more")
        low, high = (signal.minimum, signal.maximum) if saturates else (-np.inf, np.inf)
        self._least, self._most = (end * self._si - self._zero for end in (low, high))
        # In J1939 the highest codes of a number of whole bytes are no measurements.
        self._coded = is_j1939(self.message) and not self._signed and self.bits % 8 == 0
        self._selector: SignalReader | None = None
        self._selected: tuple[int, ...] = ()
        if signal.multiplexer_ids:
            self._selected = tuple(signal.multiplexer_ids)
            selector = f"{message_name}.{signal.multiplexer_signal}"
            self._selector = SignalReader(device=device, database=database, dbc=dbc, name=selector, quantity="count")

    @property
    def counts(self) -> bool:
        """Whether it is a whole number."""
        return not self._float

    @property
    def multiplexed(self) -> bool:
        """Whether it is only in some frames of its message."""
        return self._selector is not None

    def raw(self, data: Octets) -> Ints:
        """Return the raw numbers (n,) of frames (n, length); of 64 unsigned bits the highest becomes a sign."""
        word = self._word(data)
        if self._signed and self.bits < 64:
            half = np.uint64(1 << (self.bits - 1))
            return np.asarray((word ^ half).astype(np.int64) - np.int64(half))
        return word.astype(np.int64)

    def values(self, data: Octets) -> Floats:
        """Return the values (n,) in SI of frames (n, length); NaN where a frame has no valid value.

        That is the case where the signal is not multiplexed into the frame, for J1939's codes above the range, and at
        the ends of the range of a saturating signal.
        """
        word = self._word(data)
        if self._float:
            number = word.astype(np.uint32).view(np.float32) if self.bits == 32 else word.view(np.float64)
            number = number.astype(np.float64)
        elif self._signed:
            number = self.raw(data).astype(np.float64)
        else:
            number = word.astype(np.float64)
        out = number * self.scale + self._offset
        if self._coded:
            out[word >> np.uint64(self.bits - 8) >= _NO_MEASUREMENT] = np.nan
        little = abs(self.scale) / 2
        out[~self.present(data) | (out < self._least + little) | (out > self._most - little)] = np.nan
        return np.asarray(out)

    def present(self, data: Octets) -> Flags:
        """Return in which frames (n, length) the signal is: in all, unless the message is multiplexed."""
        if self._selector is None:
            return np.ones(len(data), dtype=np.bool_)
        return np.isin(self._selector.raw(data), self._selected) & self._selector.present(data)

    def unscaled(self, value: float) -> float:
        """Return the number that the DBC's own scale and offset give for a value in SI."""
        return value / self._si + self._zero

    def _word(self, data: Octets) -> NDArray[np.uint64]:
        window = np.zeros((len(data), _WINDOW), dtype=np.uint8)
        part = data[:, self._first : self._first + _WINDOW]
        window[:, : part.shape[1]] = part
        word = window.view(self._order).ravel().astype(np.uint64) >> np.uint64(self._shift)
        return word if self.bits == 64 else np.asarray(word & np.uint64((1 << self.bits) - 1))


def _place(signal: Any) -> tuple[int, int, str]:
    """Return a signal's first byte, how far its lowest bit is from the lowest of the window, and the byte order."""
    first, bit = divmod(int(signal.start), 8)
    if signal.byte_order == "little_endian":
        return first, bit, "<u8"
    # Motorola order: the start is the highest bit, and the window begins with its byte.
    return first, 64 - (7 - bit) - int(signal.length), ">u8"


def _unit(device: str, where: str, quantity: str, text: str) -> tuple[float, float]:
    """Return the size of a unit in SI, and the offset to subtract after scaling (273.15 for K); DeviceError if it is
    unknown.

    ``where`` is for the message. A count has size 1 and no unit.
    """
    if quantity == "count":
        return 1.0, 0.0
    unit, known = plain_unit(text), UNITS[quantity]
    if unit not in known:
        first, second, *_ = known
        raise DeviceError(device, f"{where} has unit {text!r}, not {first} or {second} or the like")
    return known[unit], _KELVIN if unit == "K" else 0.0
