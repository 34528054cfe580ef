"""An IMU of one's own, and its twin: three gyros that send counted binary frames by themselves.

A bench file takes it by ``plugins = ["counted_imu.py"]`` and ``protocol = "counted"``. A frame, little-endian: the word
0x5AA5, a count of samples (16 bits), three rates, a temperature (0.01 degC), CRC-16/CCITT of all before it.
"""

import asyncio
import math
from binascii import crc_hqx
from collections.abc import AsyncIterator, Callable

import numpy as np

from drivers.clocks.sampling import Alignment, CounterClock
from drivers.imus.one_source import OneSource
from drivers.protocols import ByteLink
from drivers.specs import ImuSetup, ImuSpec, Key, ProposedImu
from drivers.types import ByteChunk, Identity, ImuBlock, SourceCounts
from sims.imus.registry import ImuTwinSetup
from sims.wires.burst import burst_of

FRAME = np.dtype([("sync", "<u2"), ("count", "<u2"), ("rate", "<i2", 3), ("temperature", "<i2"), ("crc", ">u2")])
SYNC = bytes([0xA5, 0x5A])
RATES_HZ = (50, 100, 200, 400)


class Decoder:
    """Bytes to frames, cut and damaged anywhere."""

    def __init__(self) -> None:
        self._rest = b""
        self.damaged = 0
        """Places that began like a frame and had a wrong checksum."""

    def feed(self, data: bytes) -> list[bytes]:
        """Return the frames that these bytes complete."""
        self._rest += data
        found = []
        while (at := self._rest.find(SYNC)) >= 0 and at + FRAME.itemsize <= len(self._rest):
            frame = self._rest[at : at + FRAME.itemsize]
            if crc_hqx(frame[:-2], 0xFFFF) == int.from_bytes(frame[-2:]):
                found.append(frame)
                self._rest = self._rest[at + FRAME.itemsize :]
            else:
                self.damaged += 1
                self._rest = self._rest[at + 1 :]  # a frame may begin within what only looked like one
        if at < 0:
            self._rest = self._rest[-1:]
        return found


class CountedImu(OneSource[ByteLink]):
    """The driver: samples are timed by their count."""

    def __init__(self, setup: ImuSetup, link: ByteLink) -> None:
        super().__init__(setup.name, link)
        self._lsb_rps = setup.options["resolution"]
        self._clock = CounterClock(1 / setup.rate_hz, 1 << 16, 1)
        self._decoder = Decoder()

    def counts(self, name: str) -> SourceCounts:
        counts = self._clock.counts
        counts.corrupt = self._decoder.damaged
        return counts

    def alignment(self, name: str) -> Alignment | None:
        return self._clock.alignment

    async def identify(self) -> Identity:
        return Identity("counted IMU")  # it cannot be asked

    async def blocks(self) -> AsyncIterator[tuple[str, ImuBlock]]:
        while True:
            block = self._block(await self._link.receive())
            if block is not None:
                yield self._device, block

    def flush(self) -> list[tuple[str, ImuBlock]]:
        return []

    def _block(self, chunk: ByteChunk) -> ImuBlock | None:
        frames = np.frombuffer(b"".join(self._decoder.feed(chunk.data)), dtype=FRAME)
        count = frames["count"].astype(np.int64)
        arrival_ns = np.full(len(frames), chunk.t_ns, dtype=np.int64)
        new, t_ns = self._clock.stamp(count, arrival_ns)
        if not len(t_ns):
            return None
        rate_rps = frames["rate"][new] * self._lsb_rps
        return ImuBlock(
            t_ns=t_ns,
            arrival_ns=arrival_ns[new],
            rate_rps=rate_rps,
            temperature_c=frames["temperature"][new] * 0.01,
            counter=count[new],
        )


class CountedTwin:
    """The twin: the same bytes from simulated gyros."""

    def __init__(self, ride: ImuTwinSetup, write: Callable[[bytes], None]) -> None:
        self._ride, self._write = ride, write
        self._lsb_rps = ride.options["resolution"]

    def received(self, data: bytes) -> None:
        """It listens to nothing."""

    async def serve(self) -> None:
        """Send until cancelled, in bursts of about 10 ms, as an operating system hands them over."""
        ride, loop = self._ride, asyncio.get_running_loop()
        start, count, burst = loop.time(), 0, burst_of(ride.rate_hz)
        period_s = 1 / (ride.rate_hz * (1 + 1e-6 * ride.faults.clock_ppm))
        while True:
            numbers = np.arange(count + 1, count + 1 + burst)
            at = start + numbers * period_s
            await asyncio.sleep(max(float(at[-1]) - loop.time(), 0.0))
            count += burst
            temperature_c = ride.gyros.temperature_c(float(at[-1]))
            frames = zip(numbers.tolist(), ride.gyros.sample(at), strict=True)
            data = b"".join(self._frame(n, rate, temperature_c) * ride.faults.times_to_send() for n, rate in frames)
            if data:
                self._write(data)

    def _frame(self, count: int, rate_rps: np.ndarray, temperature_c: float) -> bytes:
        raw = np.clip(np.round(self._ride.faults.rates(rate_rps) / self._lsb_rps), -32768, 32767)
        values = np.array((0x5AA5, count % (1 << 16), raw, round(temperature_c * 100), 0), dtype=FRAME).tobytes()[:-2]
        return values + crc_hqx(values, 0xFFFF).to_bytes(2)


SPEC = ImuSpec(
    name="counted",
    what="three gyros with counted binary frames, an example",
    link="serial:///dev/ttyUSB0?baud=115200",
    make=CountedImu,
    rates_hz=RATES_HZ,
    keys=(Key("resolution", "rate", "what one count of a rate is", math.radians(0.005), bound="above_zero"),),
    proposed=ProposedImu("counted", "100 Hz", "0.005 deg/s/rtHz", "2 deg/h"),
    twin=CountedTwin,
)
