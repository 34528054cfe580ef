"""An Xsens MTi on a byte link: identity, output configuration, and its MTData2 messages as blocks of rates."""

from collections.abc import AsyncIterator
from itertools import groupby

import numpy as np

from drivers.clocks.sampling import Alignment, CounterClock
from drivers.errors import BadReply, DeviceError, DeviceFault, DeviceRefused
from drivers.imus.xsens import mtdata2
from drivers.imus.xsens.requests import XbusDevice
from drivers.imus.xsens.xbus import Bytes, Messages, Mid, error_text, firmware_of, product_of, serial_of
from drivers.packaged import sentence
from drivers.protocols import ByteLink
from drivers.specs import ImuSetup, ImuSpec, described
from drivers.types import Flags, Floats, Identity, ImuBlock, SourceCounts, Stamps

HIGHEST_RATE_HZ = 2000

_BLOCK_S = 0.01
_EARLY_S = 0.25  # no sample comes this long before its time, so its count is damaged
_SETTLED_S = 2.0  # after which the clock knows early arrivals
_ASTRAY_S = 1.0  # samples out of sequence for this long mean that the device counts anew
_LOOK_FOR_RATE = 100  # messages
_LET_CONFIGURE = "let the station configure it (configure = true), or set its outputs with the manufacturer's software"

_Batch = tuple[Stamps, Stamps, Floats, Floats, Floats]
"""Count, arrival in ns, rate, temperature, acceleration."""


class XsensImu(XbusDevice):
    """One source of three gyros, with accelerometer and temperature where the device sends them."""

    def __init__(self, setup: ImuSetup, link: ByteLink) -> None:
        """Prepare for samples at the rate of ``setup``, a whole number of Hz up to 2000 (not checked here).

        The option ``number_format`` (one of ``mtdata2``, by default FLOAT32) is that of the outputs to configure. With
        the option ``configure`` false nothing is ever sent: the device must already stream at this rate.
        """
        super().__init__(setup.name, link, setup.timeout_s)
        self._rate_hz = round(setup.rate_hz)
        self._format, self._configures = setup.options.get("number_format", mtdata2.FLOAT32), setup.options["configure"]
        self._counts = SourceCounts()
        self._unusable = 0
        self._has_accel: bool | None = None
        self._start_clock()

    def counts(self, name: str) -> SourceCounts:
        """Get the counts; ``corrupt`` are damaged messages, those with impossible contents included."""
        self._counts.corrupt = self._decoder.bad_messages + self._unusable
        return self._counts

    def alignment(self, name: str) -> Alignment | None:
        """Get how the device's clock lies to the loop's; None while that is not known."""
        return None if self._timing is None else self._timing.alignment

    async def identify(self) -> Identity:
        """Ask for product code, serial number and firmware, which stops the output; empty if ``configure`` is false.

        The product code is the model; there are no settings. LinkLost if it does not answer, DeviceRefused for an
        error. Product code and firmware stay empty if the device does not give them.
        """
        if not self._configures:
            return Identity()
        await self._request(Mid.GO_TO_CONFIG)
        serial = serial_of(await self._request(Mid.REQ_DEVICE_ID))
        product = product_of(await self._optional_answer(Mid.REQ_PRODUCT_CODE))
        return Identity(product, serial, firmware_of(await self._optional_answer(Mid.REQ_FIRMWARE)))

    async def configure(self) -> None:
        """Configure counters, rate of turn, acceleration and temperature as output, and start measuring.

        Acceleration and temperature may be granted at another rate or not at all, and it is noted whether acceleration
        is. LinkLost if it does not answer; BadReply for an invalid answer; DeviceRefused for an error, or if rates come
        at another rate or without times.
        """
        await self._request(Mid.GO_TO_CONFIG)
        wanted = mtdata2.encode_outputs(
            (
                mtdata2.Output(mtdata2.PACKET_COUNTER, mtdata2.EVERY),
                mtdata2.Output(mtdata2.SAMPLE_TIME_FINE, mtdata2.EVERY),
                *(
                    mtdata2.Output(kind | self._format, self._rate_hz)
                    for kind in (mtdata2.RATE_OF_TURN, mtdata2.ACCELERATION, mtdata2.TEMPERATURE)
                ),
            )
        )
        answer = await self._request(Mid.OUTPUT_CONFIGURATION, wanted, lambda answer: answer == wanted)
        granted = mtdata2.decode_outputs(answer)
        if granted is None:
            raise BadReply(self._device, "its answer to OutputConfiguration is invalid")
        self._check_granted(granted)
        self._has_accel = any(mtdata2.kind_of(output.data_id) == mtdata2.ACCELERATION for output in granted)
        await self._request(Mid.GO_TO_MEASUREMENT)

    async def blocks(self) -> AsyncIterator[tuple[str, ImuBlock]]:
        """Start its clock anew, configure it, unless told not to, and yield (device name, block of about 10 ms).

        Raises as ``configure``.

        LinkLost when the link ends, DeviceFault when the device reports an error or has restarted, BadReply if it sends
        nothing usable.
        """
        self._start_clock()
        if self._configures:
            await self.configure()
        while True:
            t_ns, messages = await self._receive()
            if messages.mid != Mid.MTDATA2:
                self._complain(messages)
                continue
            self._held.append((t_ns, messages.data))
            self._rows_held += len(messages.data)
            if self._rows_held >= self._rate_hz * _BLOCK_S:
                block = self._take_block()
                if block is not None:
                    yield self._device, block

    def flush(self) -> list[tuple[str, ImuBlock]]:
        """Return the samples of a block that was not full yet."""
        try:
            block = self._take_block()
        except DeviceError:
            return []  # unusable messages are dropped
        return [] if block is None else [(self._device, block)]

    def _start_clock(self) -> None:
        """Begin the times anew: the device may have been off since."""
        self._held: list[tuple[int, Bytes]] = []
        self._rows_held = 0
        self._timing: _Timing | None = None
        self._without_rate = 0
        self._temperature_c = np.nan

    def _complain(self, messages: Messages) -> None:
        """Raise DeviceFault if the device reports a fault of its own, or that it has restarted."""
        if messages.mid == Mid.ERROR:
            raise DeviceFault(self._device, f"it reports {error_text(messages.each()[0])}")
        if messages.mid == Mid.WAKE_UP:
            raise DeviceFault(self._device, "it has restarted. Check its power supply and start again")

    def _take_block(self) -> ImuBlock | None:
        """Return the held messages as one block, or None if they contain no new samples of rates.

        Malformed messages and samples with implausible counts are counted and left out. Accelerations are None if the
        device granted none, or, not configured, if its first rates came without. DeviceFault if the counts show that
        the device has restarted; BadReply as ``_batch``.
        """
        held, self._held, self._rows_held = self._held, [], 0
        batches: list[_Batch] = []
        for _, group in groupby(held, key=lambda part: part[1].shape[1]):
            parts = list(group)
            arrival_ns = np.repeat([t_ns for t_ns, _ in parts], [len(data) for _, data in parts]).astype(np.int64)
            found, malformed = mtdata2.parse_mtdata2(np.concatenate([data for _, data in parts]))
            self._unusable += malformed
            for samples in found:
                batch = self._batch(samples, arrival_ns[samples.start : samples.start + len(samples.data)])
                if batch is not None:
                    batches.append(batch)
        if not batches or self._timing is None:
            return None
        count, arrival_ns, rate, temperature, accel = (np.concatenate(part) for part in zip(*batches, strict=True))
        new, t_ns = self._timing.stamp(count, arrival_ns)
        self._unusable += self._timing.take_damaged()
        if self._timing.astray:
            raise DeviceFault(self._device, "its sample time jumped: it has restarted. Check its power and start again")
        if not len(t_ns):
            return None
        shown = accel[new] if self._has_accel else None
        return ImuBlock(
            t_ns=t_ns,
            arrival_ns=arrival_ns[new],
            rate_rps=rate[new],
            temperature_c=temperature[new],
            counter=count[new],
            accel_mps2=shown,
        )

    def _batch(self, samples: mtdata2.Samples, arrival_ns: Stamps) -> _Batch | None:
        """Return counts, arrivals, rates, temperatures and accelerations of ``samples``; None without rates or counts.

        ``arrival_ns`` (n,) are the arrivals of the n samples. A temperature that is missing keeps its last value;
        missing accelerations and rates that are not finite are NaN. Rates without a count are counted as unusable.
        BadReply for the first samples with rates if they have no count of time, or if the first 100 messages have no
        rates.
        """
        rate = samples.numbers(mtdata2.RATE_OF_TURN)
        if rate is None:
            rate = samples.numbers(mtdata2.RATE_OF_TURN_HR)
        if rate is None:
            self._look_for_rate(samples)
            return None
        if self._timing is None:
            self._timing = self._timing_by(samples)
        count = samples.integers(self._timing.kind)
        if count is None:
            self._unusable += len(rate)
            return None
        accel = samples.numbers(mtdata2.ACCELERATION)
        if self._has_accel is None:
            self._has_accel = accel is not None
        temperature = samples.numbers(mtdata2.TEMPERATURE)
        temperature_c = np.full(len(rate), self._temperature_c) if temperature is None else temperature[:, 0]
        self._temperature_c = float(temperature_c[-1])
        return (
            count[:, 0],
            arrival_ns,
            np.where(np.isfinite(rate), rate, np.nan),
            temperature_c,
            np.full((len(rate), 3), np.nan) if accel is None else accel,
        )

    def _look_for_rate(self, samples: mtdata2.Samples) -> None:
        if self._timing is not None:
            return  # messages of GNSS and the like between those with rates
        self._without_rate += len(samples.data)
        if self._without_rate > _LOOK_FOR_RATE:
            sent = ", ".join(mtdata2.name_of(packet.data_id) for packet in samples.packets)
            raise BadReply(self._device, f"it sends no RateOfTurn, only {sent}; {_LET_CONFIGURE}")

    def _timing_by(self, samples: mtdata2.Samples) -> "_Timing":
        """Return a clock that uses SampleTimeFine, else PacketCounter, as far as ``samples`` have them; it adds to the
        device's counts.

        BadReply if they have neither.
        """
        if samples.has(mtdata2.SAMPLE_TIME_FINE):
            ticks = max(round(1 / (mtdata2.SAMPLE_TIME_TICK_S * self._rate_hz)), 1)
            clock = CounterClock(mtdata2.SAMPLE_TIME_TICK_S, mtdata2.SAMPLE_TIME_MODULUS, ticks, counts=self._counts)
            return _Timing(mtdata2.SAMPLE_TIME_FINE, clock)
        if samples.has(mtdata2.PACKET_COUNTER):
            clock = CounterClock(1 / self._rate_hz, mtdata2.PACKET_COUNTER_MODULUS, 1, counts=self._counts)
            return _Timing(mtdata2.PACKET_COUNTER, clock)
        raise BadReply(self._device, f"it sends neither SampleTimeFine nor PacketCounter; {_LET_CONFIGURE}")

    def _check_granted(self, granted: tuple[mtdata2.Output, ...]) -> None:
        """Check that rates come at the rate asked for and with times; DeviceRefused if not.

        Acceleration and temperature may come less often or not at all.
        """
        by_kind = {mtdata2.kind_of(output.data_id): output for output in granted}
        wanted = mtdata2.Output(mtdata2.RATE_OF_TURN | self._format, self._rate_hz)
        rate = by_kind.get(mtdata2.RATE_OF_TURN)
        if rate is None:
            raise DeviceRefused(self._device, f"it does not provide {wanted}. Is it an MTi with rate outputs?")
        if rate.rate_hz != self._rate_hz:
            raise DeviceRefused(self._device, sentence("imu.other_rate", granted=rate, asked_hz=self._rate_hz))
        if mtdata2.SAMPLE_TIME_FINE not in by_kind and mtdata2.PACKET_COUNTER not in by_kind:
            raise DeviceRefused(self._device, sentence("imu.no_times"))

    async def _optional_answer(self, mid: Mid) -> bytes:
        """Return the answer to a request that some devices refuse; empty from these."""
        try:
            return await self._request(mid)
        except DeviceRefused:
            return b""


class _Timing:
    """Sample times from a count in the messages; since the checksum has only 8 bits, implausible counts are
    rejected.
    """

    def __init__(self, kind: int, clock: CounterClock) -> None:
        """Start without a count; ``kind`` is the kind of packet that carries it."""
        self.kind = kind
        self._clock = clock
        self._newest: int | None = None  # continues over the wrap
        self._first = 0
        self._damaged = 0
        self._in_a_row = 0

    @property
    def alignment(self) -> Alignment | None:
        return self._clock.alignment

    @property
    def astray(self) -> bool:
        """Whether samples have been out of sequence for so long that the device must count anew."""
        return self._in_a_row * self._clock.ticks_per_sample * self._clock.tick_s > _ASTRAY_S

    def take_damaged(self) -> int:
        """Return how many samples were left out as damaged since the last call."""
        damaged, self._damaged = self._damaged, 0
        return damaged

    def stamp(self, count: Stamps, arrival_ns: Stamps) -> tuple[Flags, Stamps]:
        """Return as flags (n,) which samples are new and plausible, and the times in ns of these.

        ``count`` (n,) are the wrapping counts, at least one, ``arrival_ns`` (n,) the arrivals. Implausible ones are
        counted, see ``take_damaged``; repeats in the clock's counts.
        """
        sound = self._sound(count, arrival_ns)
        if not sound.any():
            return sound, np.empty(0, dtype=np.int64)
        new, t_ns = self._clock.stamp(count[sound], arrival_ns[sound])
        sound[np.flatnonzero(sound)[~new]] = False
        return sound, t_ns

    def _sound(self, count: Stamps, arrival_ns: Stamps) -> Flags:
        """Return as flags (n,) which counts continue the ones before and are not ahead of their arrival; count the
        others.

        The first count ever is taken as it is; later ones that are left out in a row make the device ``astray``. A
        count may be less than two samples behind the newest. That it is more than 0.25 s ahead of its arrival is looked
        at only after 2 s.
        """
        if self._newest is None:
            self._first = self._newest = int(count[0])
        clock, newest = self._clock, self._newest
        half = clock.modulus // 2
        unwrapped = newest + (count - newest + half) % clock.modulus - half
        ahead = np.zeros(len(count), dtype=np.bool_)
        if (newest - self._first) * clock.tick_s > _SETTLED_S:
            device_s = np.asarray(unwrapped * clock.tick_s, dtype=np.float64)
            ahead = clock.fit.lateness_of(device_s, arrival_ns) < -_EARLY_S
        sound = np.zeros(len(count), dtype=np.bool_)
        for i, now in enumerate(unwrapped.tolist()):
            if ahead[i] or now <= newest - 2 * clock.ticks_per_sample:
                self._damaged += 1
                self._in_a_row += 1
            else:
                sound[i], newest, self._in_a_row = True, max(newest, now), 0
        self._newest = newest
        return sound


SPEC = described(ImuSpec, __package__, make=XsensImu, rates_hz=range(1, HIGHEST_RATE_HZ + 1))
