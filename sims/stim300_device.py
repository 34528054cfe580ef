"""Twin of a STIM300: its gyros as rate-and-temperature datagrams on a byte link."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

import numpy as np

from drivers.stim300 import GYRO_LSB_DPS, INTERNAL_RATE_HZ, TEMPERATURE_LSB_C, Datagrams, encode
from sims.gyro import GyroArray

_RATE_AND_TEMPERATURE = 0x94
_GYRO_LIMIT = (1 << 23) - 1
_BURST_S = 0.01


class Stim300Device:
    """Sends datagrams in bursts of about 10 ms, as an operating system hands them over."""

    def __init__(self, gyros: GyroArray, write: Callable[[bytes], None], rate_hz: int) -> None:
        """``rate_hz`` is one of the device's own rates."""
        self._gyros, self._write, self._rate_hz = gyros, write, rate_hz

    async def serve(self) -> None:
        """Send until cancelled."""
        loop = asyncio.get_running_loop()
        start = loop.time()
        burst = max(round(self._rate_hz * _BURST_S), 1)
        sent = 0
        while True:
            index = np.arange(sent + 1, sent + 1 + burst)
            at = start + index / self._rate_hz
            await asyncio.sleep(max(float(at[-1]) - loop.time(), 0.0))
            raw = np.round(np.degrees(self._gyros.sample(at)) / GYRO_LSB_DPS).astype(np.int64)
            temperature = round(self._gyros.temperature_c(float(at[-1])) / TEMPERATURE_LSB_C)
            zeros = np.zeros(burst, dtype=np.int64)
            self._write(
                encode(
                    Datagrams(
                        _RATE_AND_TEMPERATURE,
                        np.clip(raw, -_GYRO_LIMIT - 1, _GYRO_LIMIT),
                        zeros,
                        index * (INTERNAL_RATE_HZ // self._rate_hz),
                        zeros,
                        temperatures=np.full((burst, 1, 3), temperature),
                    )
                )
            )
            sent += burst
