"""A client of a STIM300's utility mode: identity and settings, while it sends no samples."""

from __future__ import annotations

import asyncio
import re
from types import TracebackType

from drivers.errors import BadReply, DeviceRefused, LinkLost
from drivers.imus.stim300.codec import DATAGRAM_CODES, UTILITY_MODE
from drivers.imus.stim300.special import RATES_HZ
from drivers.imus.stim300.units import UNITS
from drivers.imus.stim300.utility import UtilityMessage, encode_message, parse_message
from drivers.packaged import packaged_codes
from drivers.protocols import ByteLink
from drivers.types import Identity

STATUS_TEXTS = packaged_codes("drivers", "stim300", "utility")
"""What the status of a reply means (table 10-2)."""

_TRIES = 2
_QUIET_S = 0.1  # far longer than the pause between datagrams
_DATAGRAM_LETTERS = {identifier: code for code, identifier in DATAGRAM_CODES.items()}
_UNIT_CODES = {name: code for code, name in UNITS.items()}
_STATUSES = {str(status) for status in STATUS_TEXTS}
_LONGEST = 100  # characters, without the CR
_LEAD = re.compile(rb"[$#]")
_NOT_TEXT = re.compile(rb"[^ -~]")


def status_of(message: UtilityMessage) -> int | None:
    """Return the status of a reply; None where there is none: a command, the greeting, replies that begin with data."""
    if message.reply and len(message.fields) > 1 and message.fields[1] in _STATUSES:
        return int(message.fields[1])
    return None


def data_of(message: UtilityMessage) -> tuple[str, ...]:
    """Return what a reply says, behind its status where it has one."""
    return message.fields[1 if status_of(message) is None else 2 :]


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
            message = parse_message(view[at : end.end()]) if end is not None else None
            if message is not None and end is not None:
                found.append(message)
                at = end.end()
            else:
                self.bad_messages += 1
                self.dropped_bytes += 1
                at += 1
        self._buffer = view[at:]
        return found


class Stim300Utility:
    """Utility mode, for programs; ``async with`` enters and leaves it. The link is open before and after."""

    def __init__(self, device: str, link: ByteLink, *, timeout_s: float = 0.5) -> None:
        """Wait ``timeout_s`` twice for each reply."""
        self._device, self._link, self._timeout_s = device, link, timeout_s
        self._decoder = UtilityDecoder()

    async def __aenter__(self) -> Stim300Utility:
        """Enter: samples stop; LinkLost if the device does not answer."""
        for _ in range(_TRIES):
            self._link.write(UTILITY_MODE)
            # Any reply will do: one to UTILITYMODE as a wrong command comes from a device that was in it already.
            if await self._reply("") is not None:
                return self
        raise LinkLost(self._device, "no answer to UTILITYMODE; is it powered, and sending samples?")

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        """Leave: samples go on."""
        if kind is None:
            await self.ask("xn")
        else:
            self._link.write(encode_message(UtilityMessage(False, ("xn",))))

    async def ask(self, name: str, *parameters: str | int) -> tuple[str, ...]:
        """Send a command and return what the reply says; DeviceRefused with its status, LinkLost if there is none."""
        command = encode_message(UtilityMessage(False, (name, *map(str, parameters))))
        for _ in range(1 if name == "save" else _TRIES):
            self._link.write(command)
            reply = await self._reply(name)
            status = None if reply is None else status_of(reply)
            if reply is not None and status in (0, None):
                return data_of(reply)
            if reply is not None and status != 2:
                text = STATUS_TEXTS[status or 0]
                raise DeviceRefused(self._device, f"{name} refused with status {status}: {text}")
        raise LinkLost(self._device, f"no answer to {name} in utility mode")

    async def identify(self) -> Identity:
        """Ask for product, part number, serial number and firmware."""
        product, part = (await self.ask("in"))[0:1], await self.ask("ix")
        serial, firmware = (await self.ask("isn"))[0:1], (await self.ask("ifw"))[0:1]
        if not (product and len(part) >= 2 and serial and firmware):
            raise BadReply(self._device, "its replies about itself are too short; is it a STIM300?")
        return Identity(f"{product[0]} {part[0]} rev {part[1]}", serial[0], firmware[0])

    async def set_rate(self, rate_hz: int) -> None:
        """Set the rate of normal datagrams, one of 125, 250, 500, 1000, 2000."""
        await self.ask("sm", RATES_HZ.index(rate_hz))

    async def set_gyro_unit(self, unit: str) -> None:
        """Set what the gyros put out, by a name of ``UNITS``."""
        await self.ask("sgu", _UNIT_CODES[unit])

    async def set_datagram(self, identifier: int) -> None:
        """Set which normal datagram is sent, by its id."""
        await self.ask("sd", _DATAGRAM_LETTERS[identifier])

    async def save(self) -> int:
        """Keep the settings through power-off; return how often that can still be done."""
        left = await self.ask("save")
        if not left or not left[0].isdigit():
            raise BadReply(self._device, f"it answered {','.join(left)!r} to save; ask it again what it has kept")
        return int(left[0])

    async def _reply(self, name: str) -> UtilityMessage | None:
        """Return the reply to this command; None if there is none in time. Late replies to others are passed over."""
        try:
            async with asyncio.timeout(self._timeout_s):
                while True:
                    for message in self._decoder.feed((await self._link.receive()).data):
                        if message.reply and (not name or message.fields[0] in (name, "")):
                            return message
        except TimeoutError:
            return None
