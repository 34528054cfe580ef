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
_KEPT = (aceinna.FILTERS, aceinna.ORIENTATION)  # settings that it keeps, and that are not in the bench file
_OWN_ADDRESS = 0  # of the station on J1939


class AceinnaImu(CanImu):
    """One source of three gyros and accelerometers. Its messages carry no counter: samples are timed by their
    rhythm.
    """

    def __init__(self, setup: ImuSetup, link: FrameLink) -> None:
        """Expect rate and acceleration messages from the J1939 address of the option ``address``.

        The option ``model``, one of ``AXIS_ORDERS``, gives the order of axes unless ``axis_order`` does. With the
        option ``configure`` the device is set to the bench's rate when the link is opened; ValueError if it does not
        have that rate. Without it nothing is sent but questions. Values at the ends of the range count as missing.
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
        """Open the bus and send the settings, if any; DeviceRefused if the device keeps another value.

        LinkLost if the bus cannot be opened or the device does not answer.
        """
        await super().open()
        for group, values in self._settings:
            await self._set(group, values)

    async def identify(self) -> Identity:
        """Ask for software version, NAME and settings; whatever is not answered stays empty.

        The NAME gives the model (its manufacturer and function) and the serial number (its identity). A question is
        given up after 0.4 s. The settings, filters and orientation in hex, are asked for only if the NAME
        was answered, and left empty if one of them is missing. Samples that arrive meanwhile are dropped. LinkLost if
        the bus is gone.
        """
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
        """Send ``values`` as the setting of a parameter group, and read it back until it matches, three times at most.

        An early answer may still hold the old value. LinkLost if the last question was not answered, DeviceRefused if
        the device keeps another value.
        """
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
        """Return the data of the device's answer to the request for a parameter group, or None if there is none in
        time.

        Requests are written in Aceinna's way, then in the standard's, with 0.2 s for each; the way that was answered is
        used from then on. LinkLost if the bus is gone.
        """
        for standard in self._styles:
            self._link.send(aceinna.request(group, self._peer, _OWN_ADDRESS, standard=standard))
            if (answer := await self._answer(group)) is not None:
                self._styles = (standard,)
                return answer
        return None

    async def _answer(self, group: int) -> bytes | None:
        """Return the data of the next frame with this parameter group from the device; None if none comes within 0.2 s.

        Other frames that arrive meanwhile are dropped. LinkLost if the bus is gone.
        """
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
