"""Reopening of links lost while nothing turns; during a motion, the run ends instead.

Whatever answers then is asked who it is, and how it is set: another device ends the run.
"""

import asyncio
from collections.abc import Callable
from dataclasses import astuple

from drivers.errors import BadReply, DeviceFault, DeviceRefused, LinkLost
from drivers.links.reopen import BackOff, reopen
from drivers.protocols import Device
from drivers.types import Identity

_LOOK_S = 0.02


class Reopening:
    """Reopens lost links, for one run."""

    def __init__(self, moving: Callable[[], bool], tell: Callable[[str], None], time_scale: float) -> None:
        """Start without identities; ``moving`` returns whether the table turns or is about to.

        ``tell`` notes an event in the recording; the time for all tries and those between them are stretched by
        ``time_scale``, how fast the loop's clock runs.
        """
        self._moving, self._tell, self._scale = moving, tell, time_scale
        self._known: dict[str, Identity] = {}
        self.under_way: set[str] = set()
        """Devices whose links are being opened again."""
        self.times: dict[str, int] = {}
        """How often each device's link was opened again."""

    async def identify(self, name: str, device: Device) -> Identity:
        """Return the identity of an open device, remembered on the first call and compared on later ones.

        Only parts that both identities state are compared. DeviceFault if one of these differs, be it the settings
        only, or if a device that has told its identity refuses to; LinkLost if a part is missing that was there. Other
        errors, and a refusal on the first call, are passed on.
        """
        known = self._known.get(name)
        try:
            now = await device.identify()
        except DeviceRefused as error:
            if known is None:
                raise
            raise DeviceFault(name, f"{error.message}; when the run began it was {_identity_text(known)}") from None
        before, after = (astuple(one) for one in (self._known.setdefault(name, now), now))
        if any(old != new for old, new in zip(before, after, strict=True) if old and new):
            other = "a different device" if before[:-1] != after[:-1] else "the same device with other settings"
            identities = [
                f"{_identity_text(Identity(*one))}{f', set to {one[-1]}' * (before[:-1] == after[:-1])}"
                for one in (before, after)
            ]
            raise DeviceFault(
                name, f"{other} answers now: when the run began it was {identities[0]}, now it is {identities[1]}"
            )
        if any(old and not new for old, new in zip(before, after, strict=True)):
            raise LinkLost(name, "the device no longer identifies itself")
        return now

    async def restore(self, name: str, lost: Device, error: LinkLost) -> None:
        """Reopen a lost link and check that the same device is there; note that in the recording and in ``times``.

        Raises ``error`` at once if the table moves; LinkLost if it has to move before the link is open, or after a
        minute; DeviceFault if another device answers. A BadReply is tried again, other errors pass through. Meanwhile
        ``under_way`` has the device; both an attempt and its success are told.
        """
        if self._moving():
            raise error
        self._tell(f"{error}; no axis turns, so the link is reopened")
        limits = BackOff(0.1 * self._scale, 5.0 * self._scale, 60.0 * self._scale)

        async def seen() -> None:
            try:
                await self.identify(name, lost)
            except BadReply as error:  # bytes left on a wire that was plugged in again
                raise LinkLost(error.device, error.message) from None

        tries = asyncio.get_running_loop().create_task(reopen(lost, limits, seen=seen))
        self.under_way.add(error.device)
        try:
            while not tries.done():
                if self._moving():
                    raise LinkLost(error.device, f"{error.message}; it was still missing when the table had to turn")
                await asyncio.wait({tries}, timeout=_LOOK_S)
            count = tries.result()
        finally:
            tries.cancel()
            self.under_way.discard(error.device)
        self.times[error.device] = self.times.get(error.device, 0) + 1
        self._tell(f"{error.device}: reopened after {count} {'try' if count == 1 else 'tries'}")
        for doubt in self.doubts(name):
            self._tell(doubt)

    async def ask_at_end(self, name: str, device: Device) -> None:
        """Reopen a closed device, check its identity, and close it; a link that fails is only noted.

        Nothing is done for a device that has no identity. It must have been identified before (KeyError). DeviceFault
        if it is another device; it is closed in any case.
        """
        if self._known[name] == Identity():
            return
        try:
            await device.open()
            await self.identify(name, device)
        except (LinkLost, BadReply) as error:
            self._tell(f"the identity of {name} could not be checked again at the end: {error}")
        finally:
            device.close()

    def doubts(self, name: str = "") -> list[str]:
        """Return sentences on devices (or this one) that may have been exchanged while their link was lost."""
        return [
            f"{lost} reports no serial number, so it may have been exchanged while its link was lost"
            for lost in self.times
            if name in ("", lost) and not self._known[lost].serial
        ]


def _identity_text(identity: Identity) -> str:
    parts = [identity.model, f"serial {identity.serial}" if identity.serial else "", identity.firmware]
    return ", ".join(part for part in parts if part) or "a device without identification"
