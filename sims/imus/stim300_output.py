"""Gyro outputs of a STIM300 in each of its units, as raw numbers at its own ticks."""

from collections.abc import Callable, Collection

import numpy as np

from drivers.imus.stim300.codec import INTERNAL_RATE_HZ
from drivers.types import Flags, Floats, Ints

RANGE_DPS = 400.0
"""Beyond this the device reports an overload."""

_RATE_SCALE, _ANGLE_SCALE = 2.0**14, 2.0**21
_TOP = 1 << 23
_RATE, _INCREMENT, _AVERAGE = 0, 1, 2


class GyroOutput:
    """Converts rates at the gyros' instants to outputs at the ticks of the datagrams."""

    def __init__(self, sample: Callable[[Floats], Floats], rate_hz: int) -> None:
        """``sample`` gives rates (n, 3) in rad/s at instants that are 1 / ``rate_hz`` apart."""
        self._sample, self._rate_hz = sample, rate_hz
        self._angle_deg = np.zeros((1, 3))
        self._total = np.zeros((1, 3), dtype=np.int64)

    def at(
        self, t_s: Floats, ticks: Ints, wanted: Ints, unit: int, wanted_hz: int, saturated: Collection[int]
    ) -> tuple[Ints, Flags]:
        """Return raw outputs (k, 3) at the ticks ``wanted`` (k,), and which gyros (k, 3) are beyond their range.

        ``t_s`` (n,) are the instants of the gyros' samples, ``ticks`` (n,) the device's 2000 Hz count at them. ``unit``
        is the code of a rate, increment, average or integral; the latter three continue across calls. ``wanted_hz`` is
        the rate of datagrams, over which averages are taken. Gyros in ``saturated`` (0 to 2) are at their range.
        Outputs are limited to 24 bits, except integrals, which wrap.
        """
        kind = unit & 3
        # A mean over a period is the rate at its middle, to second order.
        rate = np.degrees(self._sample(t_s if kind == _RATE else t_s - 0.5 / self._rate_hz))
        rate[:, list(saturated)] = RANGE_DPS
        over = (np.abs(rate) > RANGE_DPS)[np.minimum(np.searchsorted(ticks, wanted), len(ticks) - 1)]
        if kind == _RATE:
            return _clipped(rate[np.searchsorted(ticks, wanted)] * _RATE_SCALE), over
        angle = self._angle_deg + np.cumsum(rate, axis=0) / self._rate_hz
        known = np.concatenate([[ticks[0] - INTERNAL_RATE_HZ // self._rate_hz], ticks])
        path = np.vstack([self._angle_deg, angle])
        there = np.column_stack([np.interp(wanted, known, path[:, i]) for i in range(3)])
        self._angle_deg = angle[-1:]
        total = np.round(there * _ANGLE_SCALE).astype(np.int64)
        change = np.diff(np.vstack([self._total, total]), axis=0)
        self._total = total[-1:] if len(total) else self._total
        if kind == _INCREMENT:
            return _clipped(change), over
        if kind == _AVERAGE:
            return _clipped(change * (wanted_hz * _RATE_SCALE / _ANGLE_SCALE)), over
        return (total + _TOP) % (2 * _TOP) - _TOP, over


def _clipped(raw: Floats | Ints) -> Ints:
    return np.clip(np.round(raw), -_TOP, _TOP - 1).astype(np.int64)
