"""A kind of device as one record: its section of the bench file, its protocols, its ready and safe states.

``drivers.kinds`` lists those of the station; a package or a file brings others. The station loops over kinds.
"""

import asyncio
from collections.abc import Awaitable, Callable, Collection, Coroutine, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from drivers.errors import DeviceError
from drivers.plugins import Registry
from drivers.protocols import ChecksSetPoint, MadeSafe
from drivers.specs import Key

_SAFE_LIMIT_S, _PAUSE_S = 15.0, 0.5
_FIRST = "table"  # the kind that is made safe before all others


@dataclass(frozen=True, slots=True, kw_only=True)
class SafeState:
    """How a device was left: ``trouble`` says what went wrong, empty if safe; ``seen`` whether the safe state was
    observed.
    """

    trouble: str
    seen: bool


class MakeSafe(Protocol):
    """Function that makes a device safe at the end of a run, or after the station that drove it has died."""

    def __call__(
        self,
        device: Any,
        /,
        *,
        time_scale: float,
        unconfirmed: Callable[[str], None],
        untrue_readings: bool = False,
    ) -> Coroutine[Any, Any, SafeState]:
        """Make the device safe, in whatever state its link is, and return how it was left.

        ``unconfirmed(trouble)`` is called if the usual way was not confirmed, before a harder one is tried. With
        ``untrue_readings`` nothing that the device reports is believed. ``time_scale`` is how fast the loop's clock
        runs.
        """


async def make_safe(
    device: Any, /, *, time_scale: float, unconfirmed: Callable[[str], None], untrue_readings: bool = False
) -> SafeState:
    """Call the driver's ``make_safe``; while it fails, close the device and call it again, for 15 s.

    Each call may take 15 s; a failure is a DeviceError or a time-out, other exceptions pass through. A driver without
    ``make_safe`` is left alone, which is no trouble, but not ``seen`` either. Limits are multiplied by ``time_scale``,
    how fast the loop's clock runs. The first failure is passed to ``unconfirmed``; that of the last call is in the
    result, which is ``seen`` if that call did not fail. ``untrue_readings`` is not used here.
    """
    if not isinstance(device, MadeSafe):
        return SafeState(trouble="", seen=False)
    loop = asyncio.get_running_loop()
    limit_s = _SAFE_LIMIT_S * time_scale
    until_s = loop.time() + limit_s
    trouble = await tried(device.make_safe(), limit_s)
    if trouble:
        unconfirmed(trouble)
    while trouble and loop.time() < until_s:
        device.close()
        await asyncio.sleep(_PAUSE_S * time_scale)
        trouble = await tried(device.make_safe(), limit_s)
    return SafeState(trouble=trouble, seen=not trouble)


async def tried(action: Coroutine[Any, Any, object], limit_s: float | None) -> str:
    """Await ``action`` for at most ``limit_s`` (None: no limit); return the message of a DeviceError or time-out, else
    empty.

    Other exceptions pass through.
    """
    try:
        async with asyncio.timeout(limit_s):
            await action
    except (DeviceError, TimeoutError) as error:
        return str(error) or "no answer in time"
    return ""


async def _nothing(device: Any, settings: Mapping[str, Any]) -> None:
    """Leave a device as it is."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DeviceKind:
    """A kind of device.

    ``name`` is its section of the bench file: [[name]], or [name] where a bench has at most one (``single``); ``what``
    describes it. ``protocols`` are the records of known protocols. ``keys`` stand in its section beside name, protocol,
    link, timeout and used.

    ``ready(driver, settings)`` brings the device to the state that a run needs, given the values of ``keys``, and
    returns when it is reached. Before anything is done, a driver that is a ``ChecksSetPoint`` is asked about the value
    of the key ``set_point``.

    A device with a ``safe_order`` is made safe on every way out, lowest number first (the table has 0), and its link is
    locked against other programs; ``made_safe`` is the message then. ``wires`` are the links on which a twin may be
    served, the usual one first.
    """

    name: str
    what: str
    protocols: Registry[Any]
    single: bool = False
    keys: tuple[Key, ...] = ()
    ready: Callable[[Any, Mapping[str, Any]], Awaitable[None]] = _nothing
    set_point: str = ""
    safe_order: int | None = None
    make_safe: MakeSafe = make_safe
    made_safe: str = "it is safe"
    wires: Collection[str] = ("tcp", "serial")

    def __post_init__(self) -> None:
        """Raise ValueError for a kind that would be made safe before the table."""
        if self.safe_order is not None and self.safe_order <= 0 and self.name != _FIRST:
            raise ValueError(
                f"kind {self.name}: safe_order is {self.safe_order}. Give a number above 0: the table is first"
            )

    async def refusal(self, device: Any, settings: Mapping[str, Any]) -> str:
        """Return why an open device would refuse its set point in ``settings``; empty if it would not, or cannot
        tell.
        """
        if not self.set_point or not isinstance(device, ChecksSetPoint):
            return ""
        return await device.refused(settings[self.set_point])
