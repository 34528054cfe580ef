"""An Aceinna OpenIMU300RI or MTLT305D on CAN: set up and asked over SAE J1939; its data messages are those of a DBC."""

import asyncio
from dataclasses import replace

from drivers.clocks.loop_scale import loop_scale
from drivers.errors import DeviceRefused, LinkLost
from drivers.imus.aceinna import codec as aceinna
from drivers.imus.can.imu import CanChannel, CanImu, CanSource
from drivers.packaged import sentence
from drivers.protocols import FrameLink
from drivers.specs import ImuSetup, ImuSpec, described
from drivers.types import Identity

_GATHER_S = 0.03
_ANSWER_S = 0.2
_TRIES = 3
_KEPT = (aceinna.FILTERS, aceinna.ORIENTATION)  # which it keeps, and the bench file does not say
_OWN_ADDRESS = 0  # of the station on J1939


class AceinnaImu(CanImu):
    """One source of three gyros and accelerometers. There is no counter on this wire: samples are timed by rhythm."""

    def __init__(self, setup: ImuSetup, link: FrameLink) -> None:
        """Expect messages from J1939 ``address``; ValueError for a rate that it is to be set to and does not have.

        ``model`` is one of ``AXIS_ORDERS`` and decides the order of axes unless ``axis_order`` says it; with
        ``configure`` it is set to this rate when the link is opened.
        """
        own = setup.options
        x, y, z = (place + 1 for place in aceinna.COLUMNS[own["axis_order"] or aceinna.AXIS_ORDERS[own["model"]]])
        self._peer, self._settings = own["address"], aceinna.settings(setup.rate_hz) if own["configure"] else []
        channel = CanChannel(
            setup.name,
            (f"ARI.Rate{x}", f"ARI.Rate{y}", f"ARI.Rate{z}"),
            acceleration=(f"ACCS.Acceleration{x}", f"ACCS.Acceleration{y}", f"ACCS.Acceleration{z}"),
            saturates=True,
        )
        super().__init__(replace(setup, signals=CanSource(aceinna.DBC, (channel,), self._peer)), link)
        self._gather_s = _GATHER_S
        self._styles: tuple[bool, ...] = (False, True)  # ways of writing a request: Aceinna's, the standard's

    async def open(self) -> None:
        """Open the bus and send the settings; DeviceRefused if the device does not take one.

        LinkLost if it does not answer when asked for what it has taken.
        """
        await super().open()
        for group, values in self._settings:
            await self._set(group, values)

    async def identify(self) -> Identity:
        """Ask for software version and NAME; what is not answered within 0.4 s stays empty."""
        version = await self._ask(aceinna.SOFTWARE_VERSION)
        claim = await self._ask(aceinna.ADDRESS_CLAIM)
        name = aceinna.Name.decode(claim or b"")
        kept = [await self._ask(group) if claim else None for group in _KEPT]
        return Identity(
            model="" if name is None else f"J1939 manufacturer {name.manufacturer}, function {name.function}",
            serial="" if name is None else str(name.identity),
            firmware=aceinna.decode_version(version or b""),
            settings="" if None in kept else " ".join(one.hex() for one in kept if one),
        )

    async def _set(self, group: int, values: bytes) -> None:
        """Send a set request and ask until the device says that it has it: an answer may be from before."""
        self._link.send(aceinna.command(group, self._peer, values, _OWN_ADDRESS))
        answer: bytes | None = None
        for _ in range(_TRIES):
            answer = await self._ask(group)
            if answer is not None and answer[1:] == values:
                return
        if answer is None:
            raise LinkLost(self._device, sentence("link.no_setting", address=self._peer, group=group))
        raise DeviceRefused(
            self._device,
            f"setting {group:04X}: requested {values.hex(' ')}, but the device keeps {answer[1:].hex(' ')}",
        )

    async def _ask(self, group: int) -> bytes | None:
        """Return the device's answer to a request, or None if there is none in time, in either way of asking."""
        for standard in self._styles:
            self._link.send(aceinna.request(group, self._peer, _OWN_ADDRESS, standard=standard))
            if (answer := await self._answer(group)) is not None:
                self._styles = (standard,)
                return answer
        return None

    async def _answer(self, group: int) -> bytes | None:
        try:
            async with asyncio.timeout(_ANSWER_S * max(loop_scale(asyncio.get_running_loop()), 1.0)):  # of a host
                while True:
                    for frame in await self._link.receive():
                        if aceinna.is_from(frame, group, self._peer):
                            return frame.data
        except TimeoutError:
            return None


SPEC = described(
    ImuSpec,
    __package__,
    {"model": {"one_of": aceinna.AXIS_ORDERS}, "address": {"one_of": range(0xFE), "default": aceinna.DEFAULT_ADDRESS}},
    make=AceinnaImu,
    rates_hz=sorted(aceinna.RATES_HZ),
)
