"""Twin of a STIM300: its gyros as normal datagrams on a byte link, and its answers to commands."""

import asyncio
import math
from collections.abc import Callable

import numpy as np

from drivers.imus.stim300 import codec as stim300
from drivers.imus.stim300.special import BiasTrim, ExtendedError, PartNumber, SerialNumber, Special
from drivers.imus.stim300.units import ACCEL_LSB_G, UNITS
from drivers.imus.stim300.utility import UtilityMessage, encode_message
from drivers.types import Flags, Floats, Ints
from sims.imus.stim300_output import GyroOutput
from sims.imus.stim300_settings import Settings, utility_reply
from sims.physics.geometry import upright
from sims.wires.burst import burst_of, copies_sent
from sims.wires.frames import ImuTwinSetup
from sims.wires.line_controller import LineDevice

_START_UP_TICKS = stim300.INTERNAL_RATE_HZ // 2
_LONGEST_LATENCY_US = 65_535
_GYRO_OVERLOAD_BIT = 101  # of x in the extended error register


class Stim300Device(LineDevice):
    """Sends datagrams in bursts of about 10 ms, as an operating system hands them over.

    The knobs of ``faults`` may be turned at any time; a saturated gyro shows the end of its range, with no status bit.
    """

    longest = 200

    def __init__(
        self,
        setup: ImuTwinSetup,
        write: Callable[[bytes], None],
        *,
        identifier: int = 0x94,
        gyro_unit: str = "rate",
        accel_range_g: int = 10,
        line_termination: bool = False,
        serial: str = "N25582405002002",
        cold: bool = False,
        seed: int = 0,
    ) -> None:
        """Prepare a device at the rate of the gyros, upright by default; ValueError for an unknown ``identifier``.

        ``gyro_unit`` is a name of ``UNITS``; ``seed`` is that of samples dropped and doubled by faults. A ``cold``
        device, or any but the first of several, is powered on when served: it sends its part number and the like, and
        its first half second has the start-up bit. Otherwise it has been on for long. Each of several has a serial
        number of its own.
        """
        if identifier not in stim300.DATAGRAM_CODES.values():
            raise ValueError(f"{identifier:02X} is no datagram of today's firmware")
        rate_hz = round(setup.rate_hz)
        self.settings = Settings(
            rate_hz=rate_hz,
            identifier=identifier,
            gyro_unit=next(code for code, name in UNITS.items() if name == gyro_unit),
            accel_range_g=accel_range_g,
            line_termination=line_termination,
            serial=serial[:-4] + f"{int(serial[-4:]) + setup.number:04d}",
        )
        super().__init__(write)
        self.faults = setup.faults
        self._base_hz = rate_hz
        self._temperature_c = setup.gyros.temperature_c
        self._force_g = setup.up or upright
        self._output = GyroOutput(setup.gyros.sample, rate_hz)
        self._period_s = 1 / (rate_hz * (1 + self.faults.clock_ppm * 1e-6))
        self._random = np.random.default_rng(seed)
        self._mode = "normal"
        self._answers: list[bytes] = []
        self._replaced = 0  # normal datagrams that answers still stand in for
        self._ticks = self._start_up_until = 0
        self._errors = 0
        self._held: Ints = np.zeros(3, dtype=np.int64)
        self.overload_gyro: int | None = None
        """Gyro that the status calls overloaded."""
        self.dropped = self.doubled = 0
        if cold or setup.number:
            self.reset()

    def reset(self) -> None:
        """Start anew as after power-on: part number, serial number, configuration, then samples of a start-up."""
        own = self.settings
        self._mode, self._replaced, self._ticks = "normal", 0, 0
        self._start_up_until = _START_UP_TICKS
        names = (PartNumber(own.part_number, own.revision), SerialNumber(own.serial), own.configuration())
        self._answers = [self._special(value) for value in names]

    def _take(self, line: bytes) -> None:
        if self._mode == "normal":
            self._command(line + b"\r")
        else:
            self._utility(line)

    async def serve(self) -> None:
        """Send datagrams, each of which states how late it is, and answers in bursts until cancelled.

        Outside normal mode it sends neither.
        """
        loop = asyncio.get_running_loop()
        start, sent = loop.time(), 0
        burst = burst_of(self._base_hz)
        tick = stim300.INTERNAL_RATE_HZ // self._base_hz
        while True:
            at = np.asarray(start + np.arange(sent + 1, sent + 1 + burst) * self._period_s, dtype=np.float64)
            await asyncio.sleep(max(float(at[-1]) - loop.time(), 0.0))
            sent += burst
            ticks = self._ticks + tick * np.arange(1, burst + 1)
            self._ticks = int(ticks[-1])
            data = self._burst(at, ticks, max(loop.time() - float(at[-1]), 0.0))
            if data:
                self._write(data)

    def _burst(self, at: Floats, ticks: Ints, late_s: float) -> bytes:
        """Return the bytes for the gyros' samples at instants ``at`` (n,): answers first, then datagrams.

        ``ticks`` (n,) is the device's count at 2000 Hz. Each answer displaces a datagram. Empty outside normal mode,
        where the gyros go on nevertheless. Datagrams are dropped or doubled by ``faults``; each states the latency
        ``late_s``.
        """
        own = self.settings
        step = stim300.INTERNAL_RATE_HZ // own.rate_hz
        first = int(ticks[0]) - stim300.INTERNAL_RATE_HZ // self._base_hz
        wanted = np.arange(first // step + 1, int(ticks[-1]) // step + 1, dtype=np.int64) * step
        raw, over = self._output.at(at, ticks, wanted, own.gyro_unit, own.rate_hz, self.faults.saturated)
        for gyro in self.faults.stuck:
            raw[:, gyro] = self._held[gyro]
        if len(raw):
            self._held = raw[-1]
        if self._mode != "normal":
            return b""
        answers, self._answers = b"".join(self._answers), []
        skipped = min(self._replaced, len(wanted))
        self._replaced -= skipped
        copies = copies_sent(self._random, len(wanted) - skipped, self.faults.dropped, self.faults.doubled)
        self.dropped += int((copies == 0).sum())
        self.doubled += int((copies == 2).sum())
        rows = np.repeat(np.arange(skipped, len(wanted)), copies)
        if not len(rows):
            return answers
        status = self._status(wanted, over)[rows]
        force = self._force_g(at)[np.minimum(np.searchsorted(ticks, wanted[rows]), len(ticks) - 1)]
        return answers + self._datagrams(raw[rows], status, wanted[rows], force, float(at[-1]), late_s)

    def _status(self, wanted: Ints, over: Flags) -> Ints:
        """Return the status byte (n,) of the gyros at each tick ``wanted`` (n,): start-up and overload.

        ``over`` (n, 3) marks overloaded gyros, to which ``overload_gyro`` is added in place; they are also noted in the
        error register.
        """
        if self.overload_gyro is not None:
            over[:, self.overload_gyro] = True
        status = np.where(wanted <= self._start_up_until, stim300.STATUS_START_UP, 0)
        if over.any():
            status |= over @ np.array(stim300.STATUS_AXES) + stim300.STATUS_OVERLOAD * over.any(axis=1)
            self._errors |= sum(1 << (_GYRO_OVERLOAD_BIT + axis) for axis in np.flatnonzero(over.any(axis=0)).tolist())
        return status

    def _datagrams(self, raw: Ints, status: Ints, ticks: Ints, force_g: Floats, t_s: float, late_s: float) -> bytes:
        """Return the bytes of n datagrams, with the groups of the present layout.

        ``raw`` (n, 3) and ``status`` (n,) are of the gyros, ``ticks`` (n,) the device's count at 2000 Hz, ``force_g``
        (n, 3) serves accelerometers and inclinometers. ``t_s`` is the instant of the temperature, which is marked as
        invalid if there is none; ``late_s`` the latency to state.
        """
        own = self.settings
        n = len(raw)
        start_up = status & stim300.STATUS_START_UP
        temperature_c = self._temperature_c(t_s)
        unknown = start_up if math.isfinite(temperature_c) else np.full(n, stim300.STATUS_INTEGRITY)
        temperature = np.full((n, 3), round(np.nan_to_num(temperature_c) / stim300.TEMPERATURE_LSB_C))
        since_pps = (ticks % stim300.INTERNAL_RATE_HZ) * (1_000_000 // stim300.INTERNAL_RATE_HZ)
        groups: dict[str, tuple[Ints, Ints]] = {
            "gyro": (raw, status),
            "accelerometer": (np.round(force_g / ACCEL_LSB_G[own.accel_range_g]).astype(np.int64), start_up),
            "inclinometer": (np.round(force_g / stim300.INCLINOMETER_LSB_G).astype(np.int64), start_up),
        }
        groups |= {f"{name}_temperature": (temperature, unknown) for name in groups}
        groups["extra"] = since_pps[:, None], start_up
        latency_us = np.full(n, min(round(late_s * 1e6), _LONGEST_LATENCY_US))
        return stim300.encode(
            stim300.Datagrams(own.identifier, ticks, latency_us, groups), line_termination=own.line_termination
        )

    def _special(self, value: Special) -> bytes:
        return stim300.encode_special(value, line_termination=self.settings.line_termination)

    def _command(self, line: bytes) -> None:
        """Carry out a command of normal mode; an unknown one is ignored.

        Answers to questions are queued and each displaces a sample; asking for the error register clears it. Reset and
        entering utility mode act at once.
        """
        own = self.settings
        values: dict[bytes, Special] = {
            stim300.ASK_PART_NUMBER: PartNumber(own.part_number, own.revision),
            stim300.ASK_SERIAL_NUMBER: SerialNumber(own.serial),
            stim300.ASK_CONFIGURATION: own.configuration(),
            stim300.ASK_BIAS_TRIM: BiasTrim(saves_left=own.saves_left),
            stim300.ASK_EXTENDED_ERROR: ExtendedError(self._errors),
        }
        if line in values:
            self._answers.append(self._special(values[line]))
            self._replaced += 1
        if line == stim300.ASK_EXTENDED_ERROR:
            self._errors = 0
        elif line == stim300.RESET:
            self.reset()
        elif line == stim300.UTILITY_MODE:
            self._mode = "utility"
            self._write(encode_message(UtilityMessage(True, ("UTILITYMODE",))))

    def _utility(self, line: bytes) -> None:
        reply = utility_reply(self.settings, line)
        if reply is not None:
            self._write(encode_message(reply))
            if reply.fields[:2] == ("xn", "0"):
                self._mode = "normal"
