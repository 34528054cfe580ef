"""Motion that nobody asked for: every reading of an axis against what the axis was told."""

import asyncio
import math
from collections.abc import Callable
from typing import NamedTuple

from drivers.errors import DeviceFault
from drivers.protocols import Turntable
from drivers.types import AxisState

_ANGLE_RAD = math.radians(0.1)  # twice of what an axis may be off where a step ends
_RATE_RPS = math.radians(1.0)
_RATE_SHARE = 1.1
_LATE_S = 0.25  # that a controller may carry on with a rate it was told to leave
_SIGMAS = 6.0  # of the rate that a standing axis reports
_FORGET = 0.05
_LOOKS, _AGAIN_S = 3, 0.02
_HOMING_LOOK_S = 0.1


class Commanded(NamedTuple):
    """What an axis was told: to be between two angles, no faster than a rate, since an instant of the loop's clock."""

    low_rad: float
    high_rad: float
    rate_rps: float
    since_s: float

    def off_rad(self, angle_rad: float) -> float:
        """Return how far an angle lies outside. Whole turns are left out: a link opened again may have lost them."""
        return math.remainder(angle_rad - min(max(angle_rad, self.low_rad), self.high_rad), math.tau)


class MotionGuard:
    """Looks at readings; one that cannot be is taken again before it is believed."""

    def __init__(self, table: Turntable, commanded: Callable[[str], Commanded]) -> None:
        """``commanded`` says what an axis was told last."""
        self._table, self._commanded = table, commanded
        self._noise_rps2 = dict.fromkeys(table.limits, 0.0)

    async def look(self, axis: str, first: AxisState) -> None:
        """Look at a reading; DeviceFault if the axis does what it was not told."""
        state = first
        for _ in range(_LOOKS - 1):
            if not self._off(axis, state):
                return
            await asyncio.sleep(_AGAIN_S)
            state = await self._table.read(axis)
        if not self._off(axis, state):
            return
        told = self._commanded(axis)
        turned_rad, took_s = state.angle_rad - first.angle_rad, (state.angle_t_ns - first.angle_t_ns) * 1e-9
        rate_dps = math.degrees(max(turned_rad / took_s, state.rate_rps, key=abs))
        does = f"turns at {rate_dps:.1f} deg/s"
        if abs(rate_dps) < math.degrees(_RATE_RPS):
            off_deg = math.degrees(told.off_rad(state.angle_rad))
            does = f"stands {off_deg:+.2f} deg from where it should be (it was turned, or its encoder has jumped)"
        was_told = f"turn at up to {math.degrees(told.rate_rps):.1f} deg/s" if told.rate_rps else "stand"
        raise DeviceFault("table", f"axis {axis} {does}; it was told to {was_told}")

    def _off(self, axis: str, state: AxisState) -> bool:
        """Return whether a reading is none of an axis that does what it was told."""
        told = self._commanded(axis)
        # A mean rate says something of this command only if all that it is the mean of came after it.
        if state.rate_t_ns - state.rate_window_ns // 2 >= told.since_s * 1e9:
            noise_rps = math.sqrt(self._noise_rps2[axis])
            if abs(state.rate_rps) > _RATE_SHARE * told.rate_rps + _RATE_RPS + _SIGMAS * noise_rps:
                return True
            if not told.rate_rps:
                self._noise_rps2[axis] += _FORGET * (state.rate_rps**2 - self._noise_rps2[axis])
        judged = state.angle_t_ns >= told.since_s * 1e9
        return judged and abs(told.off_rad(state.angle_rad)) > _ANGLE_RAD + _LATE_S * told.rate_rps


async def watch_homing(table: Turntable) -> None:
    """Look at all axes until cancelled; DeviceFault if one turns that is not, or not any more, on its way home."""
    loop = asyncio.get_running_loop()
    homed_s = dict.fromkeys(table.limits, loop.time())

    def commanded(axis: str) -> Commanded:
        if axis in table.homing:
            homed_s[axis] = loop.time()
        rate_rps = table.limits[axis].rate_rps if axis in table.homing else 0.0
        return Commanded(-math.inf, math.inf, rate_rps, homed_s[axis])

    guard = MotionGuard(table, commanded)
    while True:
        for axis in table.limits:
            await guard.look(axis, await table.read(axis))
        await asyncio.sleep(_HOMING_LOOK_S)
