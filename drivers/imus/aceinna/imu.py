"""An Aceinna OpenIMU300RI or MTLT305D on CAN: set up and asked over SAE J1939, its rates as blocks."""

import asyncio
from collections.abc import AsyncIterator, Iterable

import numpy as np

from drivers.clocks.loop_scale import loop_scale
from drivers.clocks.sampling import Alignment, RegularClock
from drivers.errors import DeviceRefused, LinkLost
from drivers.imus.aceinna import codec as aceinna
from drivers.imus.one_source import OneSource
from drivers.imus.samples import Companion, Piece, regular_block
from drivers.protocols import FrameLink
from drivers.types import Flags, Floats, Frame, Identity, ImuBlock, Octets, SourceCounts

_GATHER_S = 0.03
_ANSWER_S = 0.2
_TRIES = 3
_LENGTH = 8


class AceinnaImu(OneSource[FrameLink]):
    """One source of three gyros and accelerometers. There is no counter on this wire: samples are timed by rhythm."""

    def __init__(
        self,
        device: str,
        link: FrameLink,
        rate_hz: float,
        *,
        model: str = "openimu300ri",
        axis_order: aceinna.AxisOrder | None = None,
        address: int = aceinna.DEFAULT_ADDRESS,
        own_address: int = 0,
        settings: aceinna.Settings | None = None,
    ) -> None:
        """Expect messages at ``rate_hz`` from J1939 address ``address``.

        ``model`` is one of ``AXIS_ORDERS`` and decides the order of axes unless ``axis_order`` says it;
        ``settings`` are sent when the link is opened.
        """
        super().__init__(device, link)
        self._order: aceinna.AxisOrder = axis_order or aceinna.AXIS_ORDERS[model]
        self._address, self._own_address, self._settings = address, own_address, settings
        self._styles: tuple[bool, ...] = (False, True)  # ways of writing a request: Aceinna's, the standard's
        self._place = 0
        self._before = 0
        self._waiting: list[Piece] = []
        self._accelerations = Companion(follows=False)
        self._counts = SourceCounts()
        self._clock = RegularClock(1 / rate_hz, self._counts)

    def counts(self, name: str) -> SourceCounts:
        """Get the counts; ``corrupt`` are rate and acceleration messages of a wrong length."""
        return self._counts

    def alignment(self, name: str) -> Alignment | None:
        """Get how the device's clock lies to the loop's; None while that is not known."""
        return self._clock.alignment

    async def open(self) -> None:
        """Open the bus and send the settings; DeviceRefused if the device does not take one.

        LinkLost if it does not answer when asked for what it has taken.
        """
        await super().open()
        for group, values in self._settings.commands() if self._settings is not None else ():
            await self._set(group, values)

    async def identify(self) -> Identity:
        """Ask for software version and NAME; what is not answered within 0.4 s stays empty."""
        version = await self._ask(aceinna.SOFTWARE_VERSION)
        claim = await self._ask(aceinna.ADDRESS_CLAIM)
        name = aceinna.Name.decode(claim or b"")
        return Identity(
            model="" if name is None else f"J1939 manufacturer {name.manufacturer}, function {name.function}",
            serial="" if name is None else str(name.identity),
            firmware=aceinna.decode_version(version or b""),
        )

    async def blocks(self) -> AsyncIterator[tuple[str, ImuBlock]]:
        """Yield blocks as the frames come; LinkLost when the bus is gone. Begun again, it goes on after the break."""
        for name, held in self.flush():
            yield name, held
        self._clock.restart()
        while True:
            self._take(await self._link.receive())
            if (block := self._block()) is not None:
                yield self._device, block
            await asyncio.sleep(_GATHER_S)  # frames are stamped by the link

    def flush(self) -> list[tuple[str, ImuBlock]]:
        """Return the samples still held back for their timing."""
        block = self._block(everything=True)
        return [] if block is None else [(self._device, block)]

    async def _set(self, group: int, values: bytes) -> None:
        """Send a set request and ask until the device says that it has it: an answer may be from before."""
        self._link.send(aceinna.command(group, self._address, values, self._own_address))
        answer: bytes | None = None
        for _ in range(_TRIES):
            answer = await self._ask(group)
            if answer is not None and _agree(group, values, answer[1:]):
                return
        if answer is None:
            raise LinkLost(
                self._device,
                f"no answer from J1939 address {self._address:#04x} about setting {group:04X}; is it powered, and are "
                "bit rate and address right?",
            )
        raise DeviceRefused(
            self._device, f"setting {group:04X}: asked for {values.hex(' ')}, the device keeps {answer[1:].hex(' ')}"
        )

    async def _ask(self, group: int) -> bytes | None:
        """Return the device's answer to a request, or None if there is none in time, in either way of asking."""
        for standard in self._styles:
            self._link.send(aceinna.request(group, self._address, self._own_address, standard=standard))
            if (answer := await self._answer(group)) is not None:
                self._styles = (standard,)
                return answer
        return None

    async def _answer(self, group: int) -> bytes | None:
        scale = loop_scale(asyncio.get_running_loop())  # it is a host that is waited for
        try:
            async with asyncio.timeout(_ANSWER_S * scale):
                while True:
                    for frame in await self._link.receive():
                        if aceinna.is_from(frame, group, self._address):
                            return frame.data
        except TimeoutError:
            return None

    def _take(self, frames: Iterable[Frame]) -> None:
        for frame in frames:
            rate = aceinna.is_from(frame, aceinna.ARI, self._address)
            if not (rate or aceinna.is_from(frame, aceinna.ACCS, self._address)):
                continue
            self._place += 1
            piece = Piece(self._place, frame.t_ns, frame.data)
            if len(frame.data) != _LENGTH:
                self._counts.corrupt += 1
            elif rate:
                self._waiting.append(piece)
            else:
                self._accelerations.add(piece)

    def _block(self, *, everything: bool = False) -> ImuBlock | None:
        pieces, self._waiting = self._waiting, []
        if not pieces:
            self._accelerations.idle()
            return regular_block(self._clock, [], gyros=3, everything=everything)
        places = [piece.order for piece in pieces]
        found, rows = self._accelerations.matched(self._before, places, places[-1] + 1)
        self._before = places[-1]
        self._accelerations.forget(self._before)
        accel = np.full((len(pieces), 3), np.nan)
        accel[found] = _measured(*aceinna.decode_accelerations(_table(rows), self._order))
        rates = _measured(*aceinna.decode_rates(_table([piece.data for piece in pieces]), self._order))
        temperature = np.full(len(pieces), np.nan)  # not on this wire
        values = np.column_stack([np.radians(rates), temperature, accel])
        samples = [(piece.t_ns, row, piece.data) for piece, row in zip(pieces, values, strict=True)]
        return regular_block(self._clock, samples, gyros=3, everything=everything)


def _agree(group: int, asked: bytes, told: bytes) -> bool:
    """Return whether the device has what was asked for; it tells its two filters in the other order."""
    return told == asked or (group == aceinna.FILTERS and told == asked[::-1])


def _measured(values: Floats, saturated: Flags) -> Floats:
    """Return the values, NaN where the range ended: the true one is beyond."""
    return np.where(saturated, np.nan, values)


def _table(rows: list[bytes]) -> Octets:
    return np.frombuffer(b"".join(rows), dtype=np.uint8).reshape(len(rows), _LENGTH)
