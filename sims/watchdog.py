"""What stops a controller's axes when its master falls silent."""

from __future__ import annotations

import asyncio
from collections.abc import Callable


class Watchdog:
    """Calls back once nothing has been heard for a while, as long as it is armed."""

    def __init__(self, clock: Callable[[], float], silence_s: float, expired: Callable[[], None]) -> None:
        """Watch for ``silence_s`` of silence; 0: never."""
        self._clock, self._silence_s, self._expired = clock, silence_s, expired
        self._heard_s = clock()
        self._watching = False
        self._armed = False

    def heard(self, armed: bool) -> None:
        """Note that the master has said something, and whether its silence matters now."""
        self._heard_s, self._armed = self._clock(), armed
        if self._silence_s and armed and not self._watching:
            self._watch(self._silence_s)

    def _watch(self, for_s: float) -> None:
        self._watching = True
        asyncio.get_running_loop().call_later(for_s, self._look)

    def _look(self) -> None:
        self._watching = False
        remaining_s = self._heard_s + self._silence_s - self._clock()
        if not self._armed:
            return
        if remaining_s > 1e-9:
            self._watch(remaining_s)
        else:
            self._expired()
