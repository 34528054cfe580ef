"""Reopening of lost links, with growing pauses."""

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import dataclass

from drivers.errors import LinkLost
from drivers.protocols import Openable


@dataclass(frozen=True, slots=True)
class BackOff:
    """Pauses between attempts: the first one, doubled each time up to the longest; give up after the limit (s)."""

    first_s: float = 0.1
    longest_s: float = 5.0
    limit_s: float = 60.0


async def reopen(
    lost: Openable, back_off: BackOff | None = None, seen: Callable[[], Awaitable[object]] | None = None
) -> int:
    """Close and open ``lost`` until it opens, and return the number of attempts, the successful one included.

    Before each attempt a pause is made, from ``first_s`` to ``longest_s`` of ``back_off``, doubled each time. LinkLost
    once ``limit_s`` would be over by the next attempt; the link is closed then. ``seen``, if given, is awaited on the
    opened link, to check it; its LinkLost counts as a failed attempt. Any other error, such as a fault or a refusal, is
    raised at once, and the link stays open: the device is back and says so.
    """
    limits = back_off or BackOff()
    loop = asyncio.get_running_loop()
    deadline_s = loop.time() + limits.limit_s
    pause_s, tries = limits.first_s, 0
    while True:
        lost.close()
        await asyncio.sleep(pause_s)
        tries += 1
        try:
            await lost.open()
            if seen is not None:
                await seen()
        except LinkLost as error:
            pause_s = min(2 * pause_s, limits.longest_s)
            if loop.time() + pause_s > deadline_s:
                lost.close()
                tried = f"(tried {tries} times within {limits.limit_s:g} s)"
                raise LinkLost(error.device, f"{error.message} {tried}") from None
        else:
            return tries
