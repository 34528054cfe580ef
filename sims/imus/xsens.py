"""Twin of an Xsens MTi: its gyros as MTData2 messages on a byte link, and its answers to requests."""

import asyncio
import math
from collections.abc import Callable
from itertools import pairwise

import numpy as np

from drivers.imus.xsens import mtdata2
from drivers.imus.xsens.xbus import Mid, XbusDecoder, encode
from drivers.packaged import packaged_codes
from drivers.types import Flags, Floats, Ints
from sims.physics.geometry import tilt_deg
from sims.wires.burst import burst_of, copies_sent
from sims.wires.frames import STANDARD_GRAVITY_MPS2, ImuTwinSetup

_TICKS_PER_S = round(1 / mtdata2.SAMPLE_TIME_TICK_S)
_GYRO_RANGE_RPS = math.radians(2000)
_INVALID_MESSAGE, _INVALID_PARAMETER = 4, 33
_SELF_TEST_PASSED = 1
_COUNTS_AND_STATUS = (
    mtdata2.PACKET_COUNTER,
    mtdata2.SAMPLE_TIME_FINE,
    mtdata2.SAMPLE_TIME_COARSE,
    mtdata2.STATUS_BYTE,
    mtdata2.STATUS_WORD,
)
_FROM_FORCE = (mtdata2.ACCELERATION, mtdata2.EULER_ANGLES)
_VALUES = (mtdata2.RATE_OF_TURN, mtdata2.TEMPERATURE, *_FROM_FORCE)
_MORE_ANSWERS = {mid: bytes.fromhex(text) for mid, text in packaged_codes("sims", "xsens", "answer").items()}
_CLOCK_HZ = 115_200  # unit of sampling periods
_LONGEST_PERIOD = 0xFFFF  # that two bytes can state: of 1.8 Hz
_FIRMWARE = bytes([1, 8, 2]) + (37).to_bytes(4, "big") + (70964).to_bytes(4, "big")
_HARDWARE = bytes([2, 0])


class XsensDevice:
    """An MTi that measures since it was switched on, and sends in bursts of 10 ms as an operating system does.

    The knobs of ``faults`` may be turned at any time.
    """

    def __init__(
        self,
        setup: ImuTwinSetup,
        write: Callable[[bytes], None],
        *,
        serial: str = "03700715",
        product: str = "MTI-300-2A5G4",
        uptime_ticks: int = 0,
        seed: int = 0,
    ) -> None:
        """Prepare a device that already measures, at the rate of the gyros; outputs may have that over a whole number.

        ``serial`` is eight hex digits, counted on for each of several; ``uptime_ticks`` of 100 us is the time since
        power-on. Without ``setup.up`` it has no accelerometers. ``seed`` is that of messages dropped and doubled by
        faults.
        """
        self._gyros, self._write, self._force_g, self.faults = setup.gyros, write, setup.up, setup.faults
        self._rate_hz = rate_hz = round(setup.rate_hz)
        self._period_s = 1 / (rate_hz * (1 + self.faults.clock_ppm * 1e-6))
        self._random = np.random.default_rng(seed)
        self._decoder = XbusDecoder()
        felt = [] if setup.up is None else [mtdata2.ACCELERATION]
        self.outputs = (
            mtdata2.Output(mtdata2.PACKET_COUNTER, mtdata2.EVERY),
            mtdata2.Output(mtdata2.SAMPLE_TIME_FINE, mtdata2.EVERY),
            *(mtdata2.Output(kind, rate_hz) for kind in (mtdata2.RATE_OF_TURN, *felt, mtdata2.TEMPERATURE)),
        )
        """Output configuration, which it keeps when it is switched off."""
        self.measuring = True
        own, period = (int(serial, 16) + setup.number).to_bytes(4), min(_CLOCK_HZ // rate_hz, _LONGEST_PERIOD)
        self._answers: dict[int, bytes] = {
            **_MORE_ANSWERS,
            Mid.REQ_DEVICE_ID: own,
            Mid.INIT: own,
            # Of one device, at byte 98; trigger, dates and earlier settings are left at 0.
            Mid.REQ_CONFIGURATION: own + period.to_bytes(2) + bytes(90) + (1).to_bytes(2) + own + bytes(16),
            Mid.REQ_PRODUCT_CODE: product.ljust(20).encode("ascii"),
            Mid.REQ_FIRMWARE: _FIRMWARE,
            Mid.REQ_HARDWARE: _HARDWARE,
        }
        self._sample = 0  # since the device was switched on
        self._uptime_ticks = uptime_ticks
        self._messages = 0
        self._last = np.zeros(3)

    def received(self, data: bytes) -> None:
        """Take bytes from the host, cut anywhere, and answer the requests that they complete."""
        for messages in self._decoder.feed(data):
            for request in messages.each():
                self._answer(messages.mid, request)

    async def serve(self) -> None:
        """Send in bursts while measuring, until cancelled; the gyros keep sampling while nothing is sent."""
        loop = asyncio.get_running_loop()
        start, burst, sent = loop.time(), burst_of(self._rate_hz), 0
        while True:
            at = np.asarray(start + np.arange(sent + 1, sent + 1 + burst) * self._period_s, dtype=np.float64)
            await asyncio.sleep(max(float(at[-1]) - loop.time(), 0.0))
            sent += burst
            index = np.arange(self._sample + 1, self._sample + 1 + burst)
            self._sample += burst
            rate = self._sensed(at)  # also while nothing is sent: gyros do not rest
            data = self._stream(at, index, rate) if self.measuring else b""
            if data:
                self._write(data)

    def restart(self) -> None:
        """Switch off and on: times and counts begin anew, and a WakeUp is sent."""
        self._sample = self._uptime_ticks = self._messages = 0
        self.measuring = True
        self._write(encode(Mid.WAKE_UP))

    def report(self, error: int) -> None:
        """Send an Error unasked."""
        self._write(encode(Mid.ERROR, bytes([error])))

    def _answer(self, mid: int, data: bytes) -> None:
        """Carry out a message of type ``mid`` and answer it; messages that are answers themselves are ignored.

        While measuring only Reset and GoToConfig are carried out. Anything else then, and unknown ones, get an Error.
        What is set is the answer from then on; measuring starts with message 0.
        """
        if mid % 2:
            return  # an answer itself
        if mid == Mid.RESET:
            self._write(encode(mid + 1))
            self.restart()
        elif mid == Mid.GO_TO_CONFIG:
            self.measuring = False
            self._write(encode(mid + 1))
        elif self.measuring:
            self.report(_INVALID_MESSAGE)
        elif mid == Mid.GO_TO_MEASUREMENT:
            self._messages = 0
            self.measuring = True
            self._write(encode(mid + 1))
        elif mid == Mid.OUTPUT_CONFIGURATION:
            self._configure(data)
        elif mid == Mid.REQ_FACTORY_PAGE:
            self._write(encode(mid + 1, data))  # which page, and nothing of it
        elif data and mid in _MORE_ANSWERS:
            self._answers[mid] = data
            self._write(encode(mid + 1))
        elif mid in self._answers:
            self._write(encode(mid + 1, self._answers[mid]))
        else:
            self.report(_INVALID_MESSAGE)

    def _configure(self, data: bytes) -> None:
        """Adopt the known part of an output configuration, and answer with what is granted.

        An Error if it cannot be read or no part is known. Without data the present one is answered. Rates are granted
        as the sampling rate over a whole number; counts and status come with every message. Outputs of acceleration and
        angles are left out on a device without accelerometers.
        """
        wanted = mtdata2.decode_outputs(data)
        known = [o for o in wanted or () if mtdata2.kind_of(o.data_id) in _COUNTS_AND_STATUS + _VALUES]
        if wanted is None or (wanted and not known):
            self.report(_INVALID_PARAMETER)
            return
        if known:
            held = [o for o in known if mtdata2.kind_of(o.data_id) not in _FROM_FORCE or self._force_g is not None]
            self.outputs = tuple(self._granted(o) for o in held)
        self._write(encode(Mid.OUTPUT_CONFIGURATION + 1, mtdata2.encode_outputs(self.outputs)))

    def _granted(self, wanted: mtdata2.Output) -> mtdata2.Output:
        if mtdata2.kind_of(wanted.data_id) in _COUNTS_AND_STATUS:
            return mtdata2.Output(wanted.data_id, mtdata2.EVERY)
        return mtdata2.Output(wanted.data_id, self._rate_hz // self._divider(wanted))

    def _divider(self, output: mtdata2.Output) -> int:
        """Return of how many samples one is sent; neither 0 nor EVERY is a rate."""
        rate_hz = self._rate_hz if output.rate_hz in (0, mtdata2.EVERY) else output.rate_hz
        return max(round(self._rate_hz / rate_hz), 1)

    def _sensed(self, at: Floats) -> Floats:
        rate = np.clip(self._gyros.sample(at), -_GYRO_RANGE_RPS, _GYRO_RANGE_RPS)
        rate[:, list(self.faults.saturated)] = _GYRO_RANGE_RPS
        for gyro in self.faults.stuck:
            rate[:, gyro] = self._last[gyro]
        self._last = rate[-1]
        return self.faults.spoilt(rate, float(np.finfo(np.float32).max))

    def _stream(self, at: Floats, index: Ints, rate: Floats) -> bytes:
        """Return the messages of n samples, some dropped or doubled by ``faults``; none for samples with no output due.

        Dropped ones are numbered as well, and a doubled one has the same number twice.
        ``at`` (n,) are the instants in s, ``index`` (n,) the numbers of the samples since power-on, ``rate`` (n, 3) in
        rad/s.
        """
        due = self._due(index)
        rows = np.flatnonzero(due.any(axis=1))
        numbers = self._messages + np.arange(len(rows))
        self._messages += len(rows)
        copies = copies_sent(self._random, len(rows), self.faults.dropped, self.faults.doubled)
        rows, numbers = np.repeat(rows, copies), np.repeat(numbers, copies)
        # Messages of the same packets are made together.
        changes = np.flatnonzero((due[rows[1:]] != due[rows[:-1]]).any(axis=1)) + 1
        parts: list[bytes] = []
        for start, stop in pairwise([0, *changes.tolist(), len(rows)]):
            if stop > start:
                some = rows[start:stop]
                present = [o.data_id for o, now in zip(self.outputs, due[some[0]], strict=True) if now]
                values = self._values(at[some], index[some], rate[some], numbers[start:stop])
                parts.append(
                    mtdata2.encode_mtdata2([(data_id, values(mtdata2.kind_of(data_id))) for data_id in present])
                )
        return b"".join(parts)

    def _due(self, index: Ints) -> Flags:
        """Return as flags (n, outputs) which outputs the messages of samples number ``index`` (n,) contain.

        Each output is due every so many samples. An output of rate EVERY accompanies the others and makes no message
        alone; if all outputs have that rate, each sample has all.
        """
        steps = np.array([1 if o.rate_hz == mtdata2.EVERY else self._divider(o) for o in self.outputs])
        timed = [o.rate_hz != mtdata2.EVERY for o in self.outputs]
        due = index[:, None] % steps == 0
        if any(timed):
            due &= due[:, timed].any(axis=1, keepdims=True)
        return np.asarray(due, dtype=np.bool_)

    def _values(self, at: Floats, index: Ints, rate: Floats, numbers: Ints) -> Callable[[int], Floats | Ints]:
        """Return a function that gives the values (n, fields) of a kind of packet at n samples, or else the status.

        ``numbers`` (n,) are the numbers of the messages; the other arguments are as for ``_stream``.
        """
        ticks = self._uptime_ticks + index * _TICKS_PER_S // self._rate_hz
        force_g = self._force_g(at) if self._force_g is not None else np.full((len(at), 3), np.nan)
        made: dict[int, Callable[[], Floats | Ints]] = {
            mtdata2.RATE_OF_TURN: lambda: rate,
            mtdata2.ACCELERATION: lambda: force_g * STANDARD_GRAVITY_MPS2,
            mtdata2.EULER_ANGLES: lambda: tilt_deg(force_g),
            mtdata2.TEMPERATURE: lambda: np.full((len(at), 1), self._gyros.temperature_c(float(at[-1]))),
            mtdata2.PACKET_COUNTER: lambda: (numbers % mtdata2.PACKET_COUNTER_MODULUS)[:, None],
            mtdata2.SAMPLE_TIME_FINE: lambda: (ticks % mtdata2.SAMPLE_TIME_MODULUS)[:, None],
            mtdata2.SAMPLE_TIME_COARSE: lambda: (ticks // _TICKS_PER_S)[:, None],
        }
        status = np.full((len(at), 1), _SELF_TEST_PASSED)  # byte and word
        return lambda kind: made[kind]() if kind in made else status
