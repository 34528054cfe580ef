"""A STIM300 in normal mode on a byte link: its datagrams as blocks of rates with true sample times."""

import asyncio
from collections import deque
from collections.abc import AsyncIterator
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from drivers.clocks.sampling import Alignment, CounterClock
from drivers.errors import DeviceRefused
from drivers.imus.one_source import OneSource
from drivers.imus.stim300 import codec as stim300
from drivers.imus.stim300.special import RATES_HZ, Configuration, PartNumber, SerialNumber, Special
from drivers.imus.stim300.units import ACCEL_LSB_G, UNITS, accel_unit_mps2, gyro_unit_rps
from drivers.packaged import sentence
from drivers.protocols import ByteLink
from drivers.specs import ImuSetup, ImuSpec, described
from drivers.types import ByteChunk, Identity, ImuBlock, SourceCounts, Stamps

_BLOCK_S = 0.01
_TRIES = 2
_MOST_REPLACED = 8
_NO_TEMPERATURE = stim300.STATUS_INTEGRITY | stim300.STATUS_START_UP
_CODES = {name: code for code, name in UNITS.items()}


@dataclass(frozen=True, slots=True, eq=False)
class _Arrived:
    """Normal datagrams and the arrival time of the last byte of each."""

    data: stim300.Datagrams
    arrival_ns: Stamps


class Stim300Imu(OneSource[ByteLink]):
    """One source of three gyros, with accelerometer and temperatures where the datagram carries them."""

    def __init__(self, setup: ImuSetup, link: ByteLink) -> None:
        """Expect datagrams at the rate of ``setup``, which is 125, 250, 500, 1000 or 2000 Hz (not checked here).

        The options ``gyro_unit`` (a name of ``UNITS``) and ``accel_range`` (g) are settings that the device must have.
        None accepts the device's own; of a device that does not answer, angular rates and 10 g are assumed.
        """
        super().__init__(setup.name, link)
        self._rate_hz = rate_hz = round(setup.rate_hz)
        self._timeout_s = setup.timeout_s
        self._ticks = stim300.INTERNAL_RATE_HZ // rate_hz
        self._wanted_unit, self._wanted_range_g = (setup.options[key] for key in ("gyro_unit", "accel_range"))
        self._gyro = gyro_unit_rps(_CODES[self._wanted_unit or UNITS[0]], rate_hz)
        self._accel = accel_unit_mps2(0, self._wanted_range_g or 10, rate_hz)
        self._decoder = stim300.Stim300Decoder()
        self._clock = CounterClock(1 / stim300.INTERNAL_RATE_HZ, stim300.COUNTER_MODULUS, self._ticks)
        self._chunks: list[ByteChunk] = []  # not yet decoded
        self._chunk_bytes, self._block_bytes = 0, 1
        self._fed = 0
        self._arrived: deque[_Arrived | Special] = deque()  # decoded, not yet made into blocks
        self._said: dict[type, Special] = {}
        self._last_counter = -1
        self._answered = False  # since the last normal datagram

    def counts(self, name: str) -> SourceCounts:
        """Return the counts; ``corrupt`` are places that began like a datagram but had a wrong CRC."""
        counts = self._clock.counts
        counts.corrupt = self._decoder.bad_datagrams
        return counts

    def alignment(self, name: str) -> Alignment | None:
        """Get how the device's clock lies to the loop's; None while that is not known."""
        return self._clock.alignment

    async def open(self) -> None:
        """Open the link."""
        self._said.clear()  # it may be another device now
        await super().open()

    async def identify(self) -> Identity:
        """Ask for configuration, serial and part number; all empty if the device does not answer the first question.

        The model has the part number and its revision; firmware and settings, in hex, are those of the configuration.
        Each question is asked twice at most, and not if its answer has come since the link was opened; an answer that
        does not come stays empty. Units and ranges are taken from the configuration; DeviceRefused if it contradicts
        the bench file, LinkLost if the link is gone. Samples that arrive meanwhile are kept.
        """
        for question, kind in (
            (stim300.ASK_CONFIGURATION, Configuration),
            (stim300.ASK_SERIAL_NUMBER, SerialNumber),
            (stim300.ASK_PART_NUMBER, PartNumber),
        ):
            await self._ask(question, kind)
            if not self._said:
                return Identity()
        configuration, serial, part = (self._said.get(kind) for kind in (Configuration, SerialNumber, PartNumber))
        if isinstance(configuration, Configuration):
            self._accept(configuration)
        return Identity(
            f"STIM300 {part.text} rev {part.revision}" if isinstance(part, PartNumber) else "",
            serial.text if isinstance(serial, SerialNumber) else "",
            str(configuration.firmware) if isinstance(configuration, Configuration) else "",
            configuration.data.hex() if isinstance(configuration, Configuration) else "",
        )

    async def blocks(self) -> AsyncIterator[tuple[str, ImuBlock]]:
        """Yield (device name, block of about 10 ms); samples that arrived before the call come first.

        Nothing is sent: the device streams by itself.

        LinkLost when the link ends; DeviceRefused if a configuration arrives that contradicts the bench file.
        """
        while True:
            for block in self._blocks():
                yield self._device, block
            self._take(await self._link.receive())

    def flush(self) -> list[tuple[str, ImuBlock]]:
        """Return the last samples, which were too few for a block."""
        self._decode()
        return [(self._device, block) for block in self._blocks()]

    async def _ask(self, question: bytes, kind: type) -> None:
        """Send a question until an answer of type ``kind`` has come, twice at most; no error if none comes.

        Nothing is sent if there is one already. Samples that arrive meanwhile are kept; LinkLost if the link is gone.
        """
        for _ in range(_TRIES):
            if kind in self._said:
                return
            self._link.write(question)
            with suppress(TimeoutError):
                async with asyncio.timeout(self._timeout_s):
                    while kind not in self._said:
                        self._take(await self._link.receive())
                        self._decode()

    def _take(self, chunk: ByteChunk) -> None:
        """Add bytes, and decode them once they may hold a block, as a line delivers them in small pieces."""
        self._chunks.append(chunk)
        self._chunk_bytes += len(chunk.data)
        if self._chunk_bytes >= self._block_bytes or chunk.t_ns - self._chunks[0].t_ns >= _BLOCK_S * 1e9:
            self._decode()

    def _decode(self) -> None:
        """Decode the chunks received, if any, and give each datagram the arrival time of the chunk with its last byte.

        Configurations and other replies are also kept in ``_said``, the last of each kind. How many bytes make a block
        follows from the last datagram.
        """
        chunks, self._chunks, self._chunk_bytes = self._chunks, [], 0
        if not chunks:
            return
        ends = self._fed + np.cumsum([len(chunk.data) for chunk in chunks])
        self._fed = int(ends[-1])
        t_ns = np.array([chunk.t_ns for chunk in chunks], dtype=np.int64)
        for found in self._decoder.feed(b"".join(chunk.data for chunk in chunks)):
            if isinstance(found, stim300.Datagrams):
                assert found.ends is not None  # those of a decoder have them
                self._arrived.append(_Arrived(found, t_ns[np.searchsorted(ends, found.ends)]))
                self._block_bytes = max(round(self._rate_hz * _BLOCK_S), 1) * stim300.LAYOUTS[found.identifier].size
            else:
                self._said[type(found)] = found
                self._arrived.append(found)

    def _blocks(self) -> list[ImuBlock]:
        """Return blocks of the new samples of all decoded datagrams, and forget these.

        Any other item is noted as an answer. A configuration is checked as by ``identify``: DeviceRefused if it
        contradicts the bench file.
        """
        blocks = []
        while self._arrived:
            item = self._arrived.popleft()
            if isinstance(item, _Arrived):
                block = self._block(item.data, item.arrival_ns)
                if block is not None:
                    blocks.append(block)
            else:
                self._answered = True
                if isinstance(item, Configuration):
                    self._accept(item)
        return blocks

    def _block(self, data: stim300.Datagrams, arrival_ns: Stamps) -> ImuBlock | None:
        """Return a block of the new samples among these datagrams, or None if there are none.

        They are timed by ``arrival_ns`` (n,) less the latency that the device states, and by the delay of the unit in
        use; the block has the arrivals as they are. Values that the device declares invalid are NaN, as is the
        temperature where the datagrams carry none; it is the mean of the three gyros'. Accelerations are None without
        such a group. Losses that an answer caused are not counted.
        """
        # The device states how long it held each sample before it began to send.
        new, t_ns = self._clock.stamp(data.counter, arrival_ns - data.latency_us * 1000)
        self._forgive_replaced(data.counter)
        if not len(t_ns):
            return None
        counter = data.counter[new]
        raw = {name: (values[new], status[new]) for name, (values, status) in data.groups.items()}
        rate = self._gyro.rates(stim300.vouched(*raw["gyro"]), counter, t_ns, self._ticks)
        temperature, accel = np.full(len(t_ns), np.nan), None
        if "gyro_temperature" in raw:
            values, status = raw["gyro_temperature"]
            temperature = values.mean(axis=1) * stim300.TEMPERATURE_LSB_C
            temperature[(status & _NO_TEMPERATURE) != 0] = np.nan
        if "accelerometer" in raw:
            accel = self._accel.rates(stim300.vouched(*raw["accelerometer"]), counter, t_ns, self._ticks)
        centre_ns = round(self._gyro.centre_s * 1e9)
        return ImuBlock(
            t_ns=t_ns - centre_ns,
            arrival_ns=arrival_ns[new],
            rate_rps=rate,
            temperature_c=temperature,
            counter=counter,
            accel_mps2=accel,
        )

    def _forgive_replaced(self, counter: Stamps) -> None:
        """Subtract from the losses the samples in whose place the device sent an answer.

        ``counter`` (n,) are those of the next normal datagrams. Only the gap before the first of them is forgiven, if
        an answer came since the last datagram and the gap is of at most 8 samples. The answer counts once; the last
        counter is noted for the next call.
        """
        if self._answered and self._last_counter >= 0:
            missing = int(counter[0] - self._last_counter) % stim300.COUNTER_MODULUS // self._ticks - 1
            if 0 < missing <= _MOST_REPLACED:
                self._clock.counts.lost -= missing
        self._answered = False
        self._last_counter = int(counter[-1])

    def _accept(self, configuration: Configuration) -> None:
        """Take the units of gyros and accelerometers and the range from the configuration.

        DeviceRefused if the rate, gyro unit or range differs from the bench file's, the gyro unit is unknown, a gyro is
        off, or the accelerometers have different ranges or one that is unknown. No rate, as with an external trigger,
        is another rate. Accelerometers are looked at only if the datagrams carry them.
        """
        unit, ranges = UNITS.get(configuration.gyro_unit), configuration.accel_ranges_g
        if configuration.rate_hz != self._rate_hz:
            found = f"sends at {configuration.rate_hz} Hz" if configuration.rate_hz else "waits for an external trigger"
            self._refuse(found, f"rate {self._rate_hz} Hz", f"m {RATES_HZ.index(self._rate_hz)}")
        if unit is None or self._wanted_unit not in (None, unit):
            wanted = self._wanted_unit or UNITS[0]
            self._refuse(f"has the gyro unit {unit or 'unknown here'}", wanted, f"u g,{_CODES[wanted]}")
        if not all(configuration.gyros_on):
            off = ", ".join(axis for axis, on in zip("xyz", configuration.gyros_on, strict=True) if not on)
            raise DeviceRefused(self._device, sentence("imu.gyro_off", gyros=off))
        self._gyro = gyro_unit_rps(configuration.gyro_unit, self._rate_hz)
        if configuration.accelerometer:
            range_g = ranges[0]
            if range_g is None or set(ranges) != {range_g}:
                text = ", ".join("unknown" if each is None else f"{each} g" for each in ranges)
                raise DeviceRefused(self._device, sentence("imu.accel_ranges", ranges=text))
            if self._wanted_range_g not in (None, range_g):
                self._refuse(f"has accelerometers of {range_g} g", f"{self._wanted_range_g} g", "")
            self._accel = accel_unit_mps2(configuration.accel_unit, range_g, self._rate_hz)

    def _refuse(self, granted: str, wanted: str, command: str) -> None:
        otherwise = f", or configure the device (service mode: {command}, then s)" if command else ""
        raise DeviceRefused(self._device, sentence("imu.otherwise", found=granted, wanted=wanted, otherwise=otherwise))


_RANGES = {"one_of": ACCEL_LSB_G, "told": f"is one of {', '.join(map(str, ACCEL_LSB_G))} g"}
SPEC = described(
    ImuSpec,
    __package__,
    {"gyro_unit": {"one_of": UNITS.values()}, "accel_range": _RANGES},
    make=Stim300Imu,
    rates_hz=RATES_HZ,
)
