"""Whether this computer keeps up with a run, so that a fault which it made itself is not blamed on a device."""

import asyncio
from collections import deque
from contextlib import suppress
from pathlib import Path

from drivers.errors import DeviceError, DeviceRefused, LinkLost
from station.run.event_loop.loops import PacedLoop

_LATE_S = 0.03  # of the wall, after which a late computer may be why a run fails
_BEHIND_S = 0.1  # the shortest time that a driver waits for an answer
_RECENT_S = 2.0  # of real time: earlier delays are not related to a fault
_CROWDED = 0.8  # share of the time in which some program waited for a processor
_TOLD_S, _TOLD_SHARE = 1.0, 0.1  # real time by which a paced clock has waited before it is reported
_PRESSURE = Path("/proc/pressure/cpu")
_HELP = "close other programs or lower --scale"


class Overdue(DeviceRefused):
    """As far as this computer has seen, an axis has not arrived in time."""


class HostWatch:
    """Records by how much the loop was late, and how busy the processors were."""

    def __init__(self, scale: float) -> None:
        """Start without delays; ``scale`` is how fast the loop's clock runs."""
        self._scale = scale
        self._latest: deque[tuple[float, float]] = deque()
        self._pressure: deque[tuple[float, float]] = deque()
        self._began: tuple[float, float] | None = None  # of the clock, and how long it had waited by then
        self._slowed = False
        self.worst_s = 0.0
        """The longest delay so far, in seconds of the wall; 0 if none was worth telling."""

    def woke(self, due_s: float) -> bool:
        """Record that a sleep due at ``due_s`` (loop time) has ended; return whether it was late.

        Late is more than 30 ms by the wall's clock; a shorter delay is not recorded.
        """
        now_s = asyncio.get_running_loop().time()
        late_s = (now_s - due_s) / self._scale
        if late_s <= _LATE_S:
            return False
        self.worst_s = max(self.worst_s, late_s)
        self._latest.append((now_s, late_s))
        self._forget(self._latest, now_s)
        return True

    def look(self) -> None:
        """Measure how crowded the processors are; does nothing on a system that does not report it."""
        now_s = asyncio.get_running_loop().time()
        with suppress(OSError, ValueError, IndexError):  # not every system reports it
            waited_s = float(_PRESSURE.read_text(encoding="ascii").split("\n", 1)[0].rpartition("total=")[2]) * 1e-6
            self._pressure.append((now_s, waited_s))
            self._forget(self._pressure, now_s)

    def slowed(self) -> str:
        """Return a message, once, if the clock of twins has become clearly slower than its scale; else "".

        It must have waited for 1 s and a tenth of the time (wall) since the first call. Call it only while a script
        runs, from its beginning: imports before that take longer.
        """
        now_s, so_far_s = asyncio.get_running_loop().time(), self._waited_s
        self._began = self._began or (now_s, so_far_s)
        passed_s, waited_s = (now_s - self._began[0]) / self._scale, so_far_s - self._began[1]
        if self._slowed or waited_s < max(_TOLD_S, _TOLD_SHARE * passed_s):
            return ""
        self._slowed = True
        return (
            f"this computer cannot keep up with --scale {self._scale:g}: the clock of the twins goes slower, "
            f"about {self._scale * passed_s / (passed_s + waited_s):.2g} times as fast as the wall's so far; "
            "nothing is lost by that"
        )

    @property
    def _waited_s(self) -> float:
        """How long a paced clock has waited for this computer, in seconds of the wall; 0 of any other."""
        loop = asyncio.get_running_loop()
        return loop.waited_s if isinstance(loop, PacedLoop) else 0.0

    def blame(self, error: DeviceError, *, served_here: bool) -> DeviceError:
        """Return a DeviceError of "host", with ``error`` in its text, if this computer may be at fault, else ``error``
        itself.

        Only lost links and late arrivals may be its fault: if it fell behind by 0.1 s in the last two seconds, or if a
        program on it answers for the device (``served_here``) and its processors are crowded.
        """
        if not isinstance(error, LinkLost | Overdue):
            return error
        now_s = asyncio.get_running_loop().time()
        behind_s = max((late_s for at_s, late_s in self._latest if now_s - at_s < self._recent_s), default=0.0)
        if behind_s >= _BEHIND_S:
            return DeviceError("host", f"this computer fell behind by {behind_s * 1e3:.0f} ms: {_HELP} ({error})")
        share = self._crowded()
        if served_here and share >= _CROWDED:
            waited = f"programs waited {share:.0%} of the time for its processors"
            return DeviceError("host", f"this computer is overloaded, {waited}: {_HELP} ({error})")
        return error

    @property
    def _recent_s(self) -> float:
        return _RECENT_S * self._scale

    def _crowded(self) -> float:
        if len(self._pressure) < 2:
            return 0.0
        (first_s, first), (last_s, last) = self._pressure[0], self._pressure[-1]
        return (last - first) / ((last_s - first_s) / self._scale) if last_s > first_s else 0.0

    def _forget(self, samples: deque[tuple[float, float]], now_s: float) -> None:
        while now_s - samples[0][0] > self._recent_s:
            samples.popleft()
