"""A VectorNav VN-100, 200 or 300 on a byte link: identity, configuration, and its output as blocks of rates."""

import asyncio
from collections.abc import AsyncIterator

import numpy as np

from drivers.clocks.sampling import Alignment, CounterClock, RegularClock
from drivers.errors import BadReply, DeviceFault, DeviceRefused, LinkLost
from drivers.imus.one_source import OneSource
from drivers.imus.samples import regular_block
from drivers.imus.vectornav import codec as vectornav
from drivers.protocols import ByteLink
from drivers.specs import ImuSetup, ImuSpec, described
from drivers.types import ByteChunk, Flags, Floats, Identity, ImuBlock, SourceCounts, Stamps

# Rates before the filter subtracts its bias estimate: that varies, and would hide the bias to be calibrated.
LAYOUT = vectornav.layout_of({vectornav.COMMON: 1 << 0, vectornav.IMU: 1 << 2 | 1 << 3 | 1 << 4})
"""TimeStartup, UncompAccel, UncompGyro, Temp."""

_ASYNC_OFF, _ASYNC_IMU = 0, 19
_REGISTER_TYPE, _REGISTER_RATE = "06", "07"
_REGISTERS_BINARY = ("75", "76", "77")
_REGISTERS_KEPT = ("26", "84", "85")  # not set here, and its samples depend on them: rotation, compensation, filters
_SHOWN = [6, 7, 8, 9, 3, 4, 5]  # of VNIMU, after three of magnetic field: rates, temperature, accelerations
_IMU_FIELDS = 11

_TRIES = 2
_FAULTS = (1, 10)
_DAMAGED = 3
_UNASKED = (2, 11, 255)
"""Errors that no command causes; what was lost by them shows as lost samples, or as no reply."""
_HINTS = {12: "; lower the rate, or raise the baud rate of the device (register 5) and of its link"}
_LONGEST_STEP_BACK_NS = 1_000_000_000
_STAMP_MODULUS = 1 << 62  # ns: it never wraps


class VectorNavImu(OneSource[ByteLink]):
    """One source of three gyros and three accelerometers, uncompensated, with temperature."""

    def __init__(self, setup: ImuSetup, link: ByteLink) -> None:
        """Prepare for the ``output`` ("binary" or "ascii") that ``setup`` states, at its rate in whole Hz; send
        nothing.

        The option ``output`` is required. ``serial_port`` (1 or 2, default 1) is the device's own port at the end of
        the link. The options are taken as they are: the specification of the IMU has them checked before.
        """
        super().__init__(setup.name, link)
        self._rate_hz, self._timeout_s = round(setup.rate_hz), setup.timeout_s
        self._output, self._serial_port = setup.options["output"], setup.options.get("serial_port", 1)
        self._decoder = vectornav.VectorNavDecoder()
        self._counts = SourceCounts()
        self._unreadable = 0
        self._fresh: list[tuple[int, Floats]] | None = None
        self._start_clocks()

    def counts(self, name: str) -> SourceCounts:
        """Get the counts; ``corrupt`` are frames and sentences that began well and were damaged."""
        self._counts.corrupt = self._decoder.bad_frames + self._decoder.bad_sentences + self._unreadable
        return self._counts

    def alignment(self, name: str) -> Alignment | None:
        """Get how the device's clock lies to the loop's; None while that is not known."""
        return (self._stamped if self._output == "binary" else self._regular).alignment

    async def identify(self) -> Identity:
        """Read model, hardware revision, serial number, firmware and settings; output stays paused afterwards.

        The hardware revision is part of the model. Settings are the values of registers 26, 84 and 85, those left out
        that the firmware refuses. LinkLost if the device does not answer; DeviceRefused, DeviceFault or BadReply for
        its other answers.
        """
        await self._pause()
        model, hardware, serial, firmware = [await self._read(register) for register in ("01", "02", "03", "04")]
        settings = [await self._kept(register) for register in _REGISTERS_KEPT]
        return Identity(f"{model}, hardware {hardware}", serial, firmware, "; ".join(filter(None, settings)))

    async def _kept(self, register: str) -> str:
        """Return how a register is set that not every firmware has."""
        try:
            return f"register {register} at {await self._read(register)}"
        except DeviceRefused:
            return ""

    async def configure(self) -> None:
        """Turn every output of the device off except the wanted one, set that, and start it. Nothing is written to its
        flash.

        LinkLost if it does not answer; DeviceRefused, DeviceFault or BadReply for its other answers.
        """
        await self._pause()
        await self._write(_REGISTER_TYPE, str(_ASYNC_OFF))
        for register in _REGISTERS_BINARY:
            await self._write(register, "0", "1", *LAYOUT.register_fields)
        if self._output == "binary":
            divisor = str(vectornav.IMU_RATE_HZ // self._rate_hz)
            await self._write(_REGISTERS_BINARY[0], str(self._serial_port), divisor, *LAYOUT.register_fields)
        else:
            await self._write(_REGISTER_RATE, str(self._rate_hz))
            await self._write(_REGISTER_TYPE, str(_ASYNC_IMU))
        await self._ask(vectornav.Sentence("VNASY", ("1",)))

    async def blocks(self) -> AsyncIterator[tuple[str, ImuBlock]]:
        """Configure the device, start its clocks anew, and yield (device name, block) as bytes arrive.

        Raises as ``configure``, and LinkLost when the link ends.

        DeviceFault when the device reports a fault of its own (errors 1 and 10), or when its clock shows that it has
        restarted. Other errors are ignored, as are sentences and frames of other outputs.
        """
        await self.configure()
        self._start_clocks()
        while True:
            chunk = await self._link.receive()
            for item in self._decoder.feed(chunk.data):
                if isinstance(item, vectornav.Frames):
                    block = self._of_frames(chunk, item)
                else:
                    block = self._of_sentence(chunk, item)
                if block is not None:
                    yield self._device, block

    def flush(self) -> list[tuple[str, ImuBlock]]:
        """Return the samples still held back for their timing: ASCII output has no time stamp."""
        block = regular_block(self._regular, [], gyros=3, flush=True)
        return [] if block is None else [(self._device, block)]

    def arrived(self) -> list[tuple[str, Stamps, Floats]]:
        """Return arrivals (n,) in ns and rates (n, 3) of ASCII samples since the last call, before they are timed."""
        fresh, self._fresh = self._fresh or [], []
        t_ns, rates = np.array([t_ns for t_ns, _ in fresh], dtype=np.int64), [row[:3] for _, row in fresh]
        return [(self._device, t_ns, np.array(rates))] if fresh else []

    def _start_clocks(self) -> None:
        """Begin the times anew: the device may have been off since."""
        period_ns = round(1e9 / self._rate_hz)
        self._stamped = CounterClock(1e-9, _STAMP_MODULUS, period_ns, counts=self._counts)
        self._newest_ns = -1
        self._regular = RegularClock(1 / self._rate_hz, self._counts)

    def _of_frames(self, chunk: ByteChunk, frames: vectornav.Frames) -> ImuBlock | None:
        """Return a block of the new samples in binary frames that arrived with ``chunk``.

        Rates and accelerations are the device's uncompensated ones. None if all are repeats, or if the layout is not
        the one asked for. The counter of the block is the device's time since start-up in ns. DeviceFault if that
        jumped back by more than 1 s.
        """
        if frames.layout != LAYOUT:
            return None  # left over from an earlier setting
        values = frames.values
        device_ns = values["common.time_startup"].astype(np.int64)
        new = self._new(device_ns)
        if not new.any():
            return None
        values, device_ns = values[new], device_ns[new]
        arrival_ns = np.full(len(values), chunk.t_ns, dtype=np.int64)
        _, t_ns = self._stamped.stamp(device_ns, arrival_ns)
        return ImuBlock(
            t_ns=t_ns,
            arrival_ns=arrival_ns,
            rate_rps=values["imu.uncomp_gyro"].astype(np.float64),
            temperature_c=values["imu.temperature"].astype(np.float64),
            counter=device_ns,
            accel_mps2=values["imu.uncomp_accel"].astype(np.float64),
        )

    def _new(self, device_ns: Stamps) -> Flags:
        """Return as flags (n,) which samples are later than all before; the others are counted as repeats.

        ``device_ns`` (n,) is the device's time since start-up. DeviceFault if it jumps back by more than 1 s: the
        device has restarted.
        """
        newest = np.maximum.accumulate(np.concatenate([[self._newest_ns], device_ns]))
        if (newest[:-1] - device_ns).max() > _LONGEST_STEP_BACK_NS:
            raise DeviceFault(
                self._device, "its clock jumped back, so it has restarted. Check its power, then run again"
            )
        new = np.asarray(device_ns > newest[:-1])
        self._newest_ns = int(newest[-1])
        self._counts.repeated += int(np.sum(~new))
        return new

    def _of_sentence(self, chunk: ByteChunk, sentence: vectornav.Sentence) -> ImuBlock | None:
        """Return a block of the samples that a VNIMU sentence makes ready; None while later ones are needed to time it.

        The sample is also noted for ``arrived``, once that has been called. None also for other sentences and in binary
        output. DeviceFault if the sentence reports a fault of the device; one that cannot be read is counted and
        skipped.
        """
        self._complain(sentence)
        if sentence.header != "VNIMU" or self._output != "ascii":
            return None
        try:
            row = np.array(sentence.fields, dtype=np.float64)
        except ValueError:
            row = np.empty(0)
        if len(row) != _IMU_FIELDS:
            self._unreadable += 1
            return None
        if self._fresh is not None:
            self._fresh.append((chunk.t_ns, row[_SHOWN]))
        return regular_block(self._regular, [(chunk.t_ns, row[_SHOWN], sentence.text.encode("ascii"))], gyros=3)

    def _complain(self, sentence: vectornav.Sentence) -> None:
        """Raise DeviceFault if the device reports a fault of its own."""
        if sentence.header == "VNERR" and (code := _code(sentence)) in _FAULTS:
            raise DeviceFault(self._device, f"it reports {vectornav.error_text(code)}. Switch it off and on again")

    async def _pause(self) -> None:
        await self._ask(vectornav.Sentence("VNASY", ("0",)))

    async def _read(self, register: str) -> str:
        return ",".join((await self._ask(vectornav.Sentence("VNRRG", (register,)))).fields[1:])

    async def _write(self, register: str, *values: str) -> None:
        await self._ask(vectornav.Sentence("VNWRG", (register, *values)))

    async def _ask(self, command: vectornav.Sentence) -> vectornav.Sentence:
        """Send a command and return its reply; send it a second time if no reply comes within the time limit.

        After a repetition it waits until the second reply may have passed. DeviceRefused for an error reply, BadReply
        if the second try brought only answers that do not match, LinkLost if none, DeviceFault if the device reports a
        fault of its own.
        """
        other: vectornav.Sentence | None = None
        for attempt in range(_TRIES):
            self._link.write(vectornav.encode_sentence(command))
            reply, other = await self._reply_to(command, self._timeout_s)
            if reply is None:
                continue
            if attempt:
                # Sent twice, it may be answered twice, a time-out apart: let the second answer pass.
                await self._reply_to(command, 2 * self._timeout_s)
            if reply.header == "VNERR":
                code = _code(reply)
                raise DeviceRefused(
                    self._device, f"it refused {command.text} with {vectornav.error_text(code)}{_HINTS.get(code, '')}"
                )
            return reply
        if other is not None:
            raise BadReply(self._device, f"to {command.text} it answered {other.text}")
        raise LinkLost(
            self._device,
            f"no reply to {command.text} within {_TRIES * self._timeout_s:g} s. Is it powered? Does its baud "
            "rate match the link?",
        )

    async def _reply_to(
        self, command: vectornav.Sentence, limit_s: float
    ) -> tuple[vectornav.Sentence | None, vectornav.Sentence | None]:
        """Return the reply to ``command`` if it comes within ``limit_s``, else None; and the last answer to such a
        command that did not match it, None if there was none.

        Samples that arrive meanwhile are dropped. A reply that lies within an unfinished frame is found at the end.
        DeviceFault if the device reports a fault of its own meanwhile, LinkLost if the link is gone.
        """
        other: vectornav.Sentence | None = None
        try:
            async with asyncio.timeout(limit_s):
                while True:
                    items = self._decoder.feed((await self._link.receive()).data)
                    for sentence in (item for item in items if isinstance(item, vectornav.Sentence)):
                        self._complain(sentence)
                        if _answers(sentence, command):
                            return sentence, other
                        if _is_about(sentence, command):
                            other = sentence
        except TimeoutError:
            # The reply may be inside bytes that looked like the beginning of a frame.
            for sentence in (item for item in self._decoder.flush() if isinstance(item, vectornav.Sentence)):
                if _answers(sentence, command):
                    return sentence, other
        return None, other


def _answers(sentence: vectornav.Sentence, command: vectornav.Sentence) -> bool:
    """Return whether ``sentence`` is the reply to ``command``.

    A late reply to another command names another register or other values: a reading must name the register and hold a
    value, anything else must repeat the fields. An error counts as a reply unless it may have come unasked or reports a
    damaged command.
    """
    if sentence.header == "VNERR":
        return _code(sentence) not in (*_UNASKED, _DAMAGED)
    if not _is_about(sentence, command):
        return False
    given = command.fields
    return len(sentence.fields) > len(given) if command.header == "VNRRG" else _same(sentence.fields, given)


def _is_about(sentence: vectornav.Sentence, command: vectornav.Sentence) -> bool:
    if sentence.header == "VNERR":
        return _code(sentence) == _DAMAGED
    return sentence.header == command.header and _same(sentence.fields[:1], command.fields[:1])


def _same(left: tuple[str, ...], right: tuple[str, ...]) -> bool:
    """Return whether these are the same numbers, decimal or hex, with or without leading zeros."""
    return [text.lstrip("0").upper() for text in left] == [text.lstrip("0").upper() for text in right]


def _code(sentence: vectornav.Sentence) -> int:
    return vectornav.error_code(sentence.fields[0]) if sentence.fields else -1


SPEC = described(
    ImuSpec,
    __package__,
    {"output": {"one_of": vectornav.RATES_HZ}},
    make=VectorNavImu,
    rates_hz=vectornav.RATES_HZ,
)
