"""What stops a controller's axes when its master falls silent."""

import asyncio
from collections.abc import Callable


class Watchdog:
    """Calls back once nothing has been heard for a while, as long as it is armed."""

    def __init__(
        self, clock: Callable[[], float], silence_s: float | Callable[[], float], expired: Callable[[], None]
    ) -> None:
        """Watch for ``silence_s`` of silence, which may change; 0: never."""
        self._clock, self._expired = clock, expired
        self._silence_s = silence_s if callable(silence_s) else lambda: silence_s
        self._heard_s = clock()
        self._watching = False
        self._armed = False

    def heard(self, armed: bool) -> None:
        """Note that the master has said something, and whether its silence matters now."""
        self._heard_s, self._armed = self._clock(), armed
        if armed and not self._watching and (silence_s := self._silence_s()):
            self._watch(silence_s)

    def _watch(self, for_s: float) -> None:
        self._watching = True
        asyncio.get_running_loop().call_later(for_s, self._look)

    def _look(self) -> None:
        self._watching = False
        silence_s = self._silence_s()
        remaining_s = self._heard_s + silence_s - self._clock()
        if not self._armed or not silence_s:
            return
        if remaining_s > 1e-9:
            self._watch(remaining_s)
        else:
            self._expired()
