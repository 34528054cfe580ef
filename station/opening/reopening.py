"""Links that drop while nothing turns are opened again; in a motion, or if one begins meanwhile, the run ends."""

import asyncio
from collections.abc import Callable

from drivers.errors import LinkLost
from drivers.links.reopen import BackOff, Openable, reopen

_LOOK_S = 0.02


class Reopening:
    """Opens again what is lost, for one run."""

    def __init__(self, moving: Callable[[], bool], tell: Callable[[str], None], time_scale: float) -> None:
        """``moving`` says whether the table turns or is about to; ``tell`` keeps what happened in the record."""
        self._moving, self._tell, self._scale = moving, tell, time_scale
        self.under_way: set[str] = set()
        """Devices whose links are being opened again."""
        self.times: dict[str, int] = {}
        """How often each device's link was opened again."""

    async def restore(self, lost: Openable, error: LinkLost) -> None:
        """Open again; LinkLost if the table turns, begins to turn before it is open, or a minute is over."""
        if self._moving():
            raise error
        self._tell(f"{error}; nothing turns, so it is opened again")
        limits = BackOff(0.1 * self._scale, 5.0 * self._scale, 60.0 * self._scale)
        tries = asyncio.get_running_loop().create_task(reopen(lost, limits))
        self.under_way.add(error.device)
        try:
            while not tries.done():
                if self._moving():
                    raise LinkLost(error.device, f"{error.message}; it was still gone when the table was to turn")
                await asyncio.wait({tries}, timeout=_LOOK_S)
            count = tries.result()
        finally:
            tries.cancel()
            self.under_way.discard(error.device)
        self.times[error.device] = self.times.get(error.device, 0) + 1
        self._tell(f"{error.device}: open again after {count} {'try' if count == 1 else 'tries'}")
