"""Twin of gyro nodes on CAN: each sends its rate regularly and its temperature once a second."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import can
import cantools
import numpy as np

from sims.gyro import GyroArray


class CanNodes:
    """Single-axis gyros, one node each, on one python-can bus."""

    def __init__(
        self,
        gyros: GyroArray,
        bus: can.BusABC,
        dbc: Path,
        signals: Sequence[tuple[str, str | None]],
        rate_hz: float,
    ) -> None:
        """``signals`` names rate and temperature of each gyro."""
        database: Any = cantools.database.load_file(dbc)
        self._gyros, self._bus = gyros, bus
        self._period_s = 1 / rate_hz
        self._rates = [_signal(database, rate) for rate, _ in signals]
        self._temperatures = [_signal(database, t) for _, t in signals if t is not None]

    async def serve(self) -> None:
        """Send until cancelled."""
        loop = asyncio.get_running_loop()
        start = loop.time()
        count = 0
        every = max(round(1 / self._period_s), 1)
        while True:
            count += 1
            at = start + count * self._period_s
            await asyncio.sleep(max(at - loop.time(), 0.0))
            rates = np.degrees(self._gyros.sample(np.array([at]))[0])
            for (message, signal), rate in zip(self._rates, rates, strict=True):
                self._send(message, signal, float(rate))
            if count % every == 0:
                for message, signal in self._temperatures:
                    self._send(message, signal, self._gyros.temperature_c(at))

    def _send(self, message: Any, signal: str, value: float) -> None:
        field = message.get_signal_by_name(signal)
        value = min(max(value, field.minimum), field.maximum)  # the converter's range
        data = message.encode({signal: value}, strict=False)
        self._bus.send(
            can.Message(arbitration_id=message.frame_id, is_extended_id=message.is_extended_frame, data=data)
        )


def _signal(database: Any, name: str) -> tuple[Any, str]:
    message, _, signal = name.partition(".")
    return database.get_message_by_name(message), signal
