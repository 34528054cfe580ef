"""A STIM300 in normal mode on a byte link: its datagrams as blocks of rates with true sample times."""

from __future__ import annotations

from collections.abc import AsyncIterator

import numpy as np

from drivers.sampling import CounterClock
from drivers.seams import ByteChunk, ByteLink, ImuBlock, SourceCounts
from drivers.stim300 import (
    ACCEL_LSB_G,
    COUNTER_MODULUS,
    GYRO_LSB_DPS,
    INTERNAL_RATE_HZ,
    STATUS_INVALID,
    TEMPERATURE_LSB_C,
    Datagrams,
    Stim300Decoder,
)

STANDARD_GRAVITY_MPS2 = 9.80665


class Stim300Imu:
    """One source of three gyros, with accelerometer and temperatures where the datagram carries them."""

    def __init__(self, device: str, link: ByteLink, rate_hz: int, *, accel_range_g: int = 10) -> None:
        """Expect datagrams at ``rate_hz``, one of 125, 250, 500, 1000, 2000."""
        self._device, self._link = device, link
        self._decoder = Stim300Decoder()
        self._clock = CounterClock(1 / INTERNAL_RATE_HZ, COUNTER_MODULUS, INTERNAL_RATE_HZ // rate_hz)
        self._accel_mps2 = ACCEL_LSB_G[accel_range_g] * STANDARD_GRAVITY_MPS2

    @property
    def names(self) -> tuple[str, ...]:
        """Name of the one source."""
        return (self._device,)

    def counts(self, name: str) -> SourceCounts:
        """Get the counts; ``corrupt`` are places that began like a datagram and had a wrong CRC."""
        counts = self._clock.counts
        counts.corrupt = self._decoder.bad_datagrams
        return counts

    async def open(self) -> None:
        """Open the link."""
        await self._link.open()

    async def blocks(self) -> AsyncIterator[tuple[str, ImuBlock]]:
        """Yield blocks as the bytes come; LinkLost when the link ends."""
        while True:
            chunk = await self._link.receive()
            for datagrams in self._decoder.feed(chunk.data):
                block = self._block(chunk, datagrams)
                if block is not None:
                    yield self._device, block

    def flush(self) -> list[tuple[str, ImuBlock]]:
        """Nothing is held back: the counter times each sample at once."""
        return []

    def close(self) -> None:
        """Close the link."""
        self._link.close()

    def _block(self, chunk: ByteChunk, data: Datagrams) -> ImuBlock | None:
        arrival_ns = np.full(len(data.counter), chunk.t_ns, dtype=np.int64)
        # The device states how long it held each sample before it began to send.
        new, t_ns = self._clock.stamp(data.counter, arrival_ns - data.latency_us * 1000)
        if not len(t_ns):
            return None
        rate = np.radians(data.gyro[new] * GYRO_LSB_DPS)
        rate[(data.gyro_status[new] & STATUS_INVALID) != 0] = np.nan  # the device itself calls these invalid
        temperature = np.full(len(t_ns), np.nan)
        if data.temperatures is not None:
            temperature = data.temperatures[new, 0].mean(axis=1) * TEMPERATURE_LSB_C
        accel = None
        if data.accelerometer is not None:
            accel = np.asarray(data.accelerometer[new] * self._accel_mps2, dtype=np.float64)
        return ImuBlock(t_ns, arrival_ns[new], rate, temperature, data.counter[new], accel)
