"""Twin of a serial CAN adapter that speaks Lawicel's commands (CANUSB, CAN232, and what copies them).

Source: Lawicel's CAN232 and CANUSB manuals; the FD commands d, D, b, B and Y are those of the CANable firmware.
Every command ends with CR; CR says done, BELL says refused.
"""

import re
from collections import deque
from collections.abc import Callable

import can
from can.util import CAN_FD_DLC, len2dlc

from drivers.packaged import packaged_toml
from sims.wires.line_controller import LineDevice

CR, BELL = b"\r", b"\a"

_FIFO = 64
_STAMP_WRAP_MS = 60_000
_FRAMES = "tTrRdDbB"
_TAKEN: dict[str, str] = packaged_toml("sims", "codes.toml")["slcan"]


class SlcanAdapter(LineDevice):
    """Bridges a byte stream and a bus: frames of the host go to ``on_message``, those of the bus enter by ``send``."""

    longest = 10 + 2 * 64

    def __init__(
        self,
        write: Callable[[bytes], None],
        on_message: Callable[[can.Message], None] | None = None,
        *,
        clock: Callable[[], float] | None = None,
        version: str = "1013",
        serial: str = "A123",
    ) -> None:
        """Start with the channel closed; ``write`` sends to the host, ``on_message`` gets the frames of the host.

        ``clock`` (s) stamps frames once the host asks for stamps; without one they carry 0. ``version`` and ``serial``
        are reported when asked for.
        """
        super().__init__(write)
        self._on_message, self._clock = on_message, clock
        self._version, self._serial = version, serial
        self.is_open = self._listens_only = self._stamps = False
        self._sends_itself = True
        self._waiting: deque[bytes] = deque()
        self._flags = 0

    def flag(self, bits: int) -> None:
        """Set bits of the status that F reports once: 1, 2 queues full, 4 warning, 8 overrun, 32 passive, 128 error."""
        self._flags |= bits

    def _take(self, line: bytes) -> None:
        self._write(BELL if self._too_long else self._obey(line))

    def send(self, msg: can.Message) -> None:
        """Pass a frame from the bus to the host, or queue it while the host polls; dropped while the channel is closed.

        A full queue sets a flag. Error frames are dropped.
        """
        if not self.is_open or msg.is_error_frame:
            return
        line = self._encoded(msg)
        if self._sends_itself:
            self._write(line)
        elif len(self._waiting) < _FIFO:
            self._waiting.append(line)
        else:
            self.flag(1)

    def _obey(self, line: bytes) -> bytes:
        """Carry out one command line and return its answer: CR alone for an empty line.

        BELL for a refusal, an unknown command, or text that is not ASCII. Flags of errors are returned only while the
        channel is open, and cleared.
        """
        if not line:
            return CR
        try:
            text = line.decode("ascii")
        except UnicodeDecodeError:
            return BELL
        name, rest = text[0], text[1:]
        if name in _FRAMES:
            return self._transmit(text)
        if name == "C" or name in _TAKEN:
            return self._set_up(name, rest)
        if name in "XPA":
            return self._poll(name, rest)
        if rest:
            return BELL
        if name == "F" and self.is_open:
            flags, self._flags = self._flags, 0
            return f"F{flags:02X}\r".encode()
        answer = {"V": f"V{self._version}", "N": f"N{self._serial}"}.get(name)
        return BELL if answer is None else answer.encode() + CR

    def _set_up(self, name: str, argument: str) -> bytes:
        """Carry out the command ``name`` with an argument: open or close the channel, or change a setting; return CR.

        Opening and settings are allowed only while the channel is closed. Closing drops the queued frames. BELL if it
        is refused, or for closing a closed channel.
        """
        if name == "C":
            if argument or not self.is_open:
                return BELL
            self.is_open = False
            self._waiting.clear()
            return CR
        if self.is_open:
            return BELL
        if not re.fullmatch(_TAKEN[name], argument):
            return BELL
        if name == "Z":
            self._stamps = argument == "1"
        if name in "OL":
            self.is_open, self._listens_only = True, name == "L"
        return CR

    def _poll(self, name: str, argument: str) -> bytes:
        """Carry out the command ``name`` with an argument: switch polling on or off (X), or return queued frames.

        P returns the next, CR if there is none, A all. BELL for a wrong argument, while closed, or without polling.
        """
        if name == "X":
            if argument not in ("0", "1"):
                return BELL
            self._sends_itself = argument == "1"
            return CR
        if argument or not self.is_open or self._sends_itself:
            return BELL
        if name == "P":
            return self._waiting.popleft() if self._waiting else CR
        waiting = b"".join(self._waiting)
        self._waiting.clear()
        return waiting + b"A\r"

    def _transmit(self, text: str) -> bytes:
        """Pass a frame of the host, written as in ``text``, to the bus and return the answer.

        It is CR while the host polls, else z or, for 29-bit identifiers, Z before it. BELL for an invalid frame, and
        while the channel is closed or only listens.
        """
        message = decode_frame(text)
        if message is None or not self.is_open or self._listens_only:
            return BELL
        if self._on_message is not None:
            self._on_message(message)
        if not self._sends_itself:
            return CR
        return b"Z\r" if message.is_extended_id else b"z\r"

    def _encoded(self, msg: can.Message) -> bytes:
        stamp = ""
        if self._stamps:
            now_s = self._clock() if self._clock is not None else 0.0
            stamp = f"{int(now_s * 1000) % _STAMP_WRAP_MS:04X}"
        return f"{encode_frame(msg)}{stamp}\r".encode()


def encode_frame(msg: can.Message) -> str:
    """Return a frame as Lawicel's line, without its end."""
    kind = ("r" if msg.is_remote_frame else "b" if msg.bitrate_switch else "d") if msg.is_fd else "t"
    kind = "r" if msg.is_remote_frame else kind
    identifier = f"{msg.arbitration_id:08X}" if msg.is_extended_id else f"{msg.arbitration_id:03X}"
    data = "" if msg.is_remote_frame else bytes(msg.data).hex().upper()
    return f"{kind.upper() if msg.is_extended_id else kind}{identifier}{len2dlc(msg.dlc):X}{data}"


def decode_frame(text: str) -> can.Message | None:
    """Return the frame of a line, with or without a stamp of four digits; None if it is not a valid frame.

    Classic and FD frames, data and remote ones, with identifiers of 11 or 29 bits.
    """
    kind, digits = text[:1], 8 if text[:1].isupper() else 3
    if not kind or kind not in _FRAMES or not _is_hex(text[1 : 1 + digits], digits):
        return None
    identifier, code = int(text[1 : 1 + digits], 16), text[1 + digits : 2 + digits]
    fd, remote = kind in "dDbB", kind in "rR"
    if not _is_hex(code, 1) or identifier >> (29 if digits == 8 else 11) or (not fd and int(code, 16) > 8):
        return None
    length, data = CAN_FD_DLC[int(code, 16)], text[2 + digits :]
    size = 0 if remote else 2 * length
    if not (_is_hex(data, size) or _is_hex(data, size + 4)):
        return None
    return can.Message(
        arbitration_id=identifier,
        is_extended_id=digits == 8,
        is_remote_frame=remote,
        is_fd=fd,
        bitrate_switch=kind in "bB",
        dlc=length,
        data=bytes.fromhex(data[:size]),
    )


def _is_hex(text: str, digits: int) -> bool:
    return len(text) == digits and all(c in "0123456789abcdefABCDEF" for c in text)
