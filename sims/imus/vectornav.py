"""Twin of a VectorNav VN-100: its registers, and its gyros as ASCII sentences and binary frames on a byte link."""

import asyncio
import re
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from drivers.imus.vectornav import codec as vectornav
from drivers.packaged import packaged_codes, packaged_toml
from drivers.types import Floats, Ints
from sims.physics.geometry import tilt_deg, upright
from sims.wires.burst import burst_of, copies_sent
from sims.wires.frames import STANDARD_GRAVITY_MPS2, ImuTwinSetup
from sims.wires.line_controller import Refused

BAUD_RATES = (9600, 19200, 38400, 57600, 115200, 128000, 230400, 460800, 921600)

_TICK_NS = 1_000_000_000 // vectornav.IMU_RATE_HZ
_ON_SINCE_NS = 30_000_000_000
_DECIMAL = re.compile(r"[-+]?[0-9]+(\.[0-9]*)?([eE][-+]?[0-9]{1,2})?")
_GYRO_RANGE_RPS, _LITTLE_RPS = np.radians((2000.0, 10.0))
_BITS_PER_BYTE = 10

# Measured values at an instant, as columns; and the print format of each.
_YPR, _MAG, _ACCEL, _GYRO, _TEMPERATURE, _PRESSURE = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12), 12, 13
_RAW_GYRO = slice(14, 17)
_KNOWN = packaged_toml("sims", "codes.toml")["vectornav"]
_FORMATS: list[str] = _KNOWN["printed"]["formats"]
_MAG_GAUSS, _PRESSURE_KPA = (0.22, 0.0, 0.43), 101.325
_COLUMNS: dict[int, list[int]] = {int(register): columns for register, columns in _KNOWN["shown"].items()}
_MEASURED: dict[str, int | list[int]] = _KNOWN["measured"]
_ASYNC: dict[int, tuple[str, int]] = {int(kind): sentence for kind, sentence in _KNOWN["async"].items()}

_BINARY = (75, 76, 77)
_ONE_OF: dict[int, Sequence[int]] = {5: BAUD_RATES, 6: (0, *_ASYNC), 7: vectornav.ASCII_RATES_HZ}
_GYRO_COMPENSATION = 84
_MORE = packaged_codes("sims", "vectornav", "register")
_GROUPS = {vectornav.COMMON, vectornav.TIME, vectornav.IMU, vectornav.ATTITUDE}  # a VN-100 has no others
_CHECKSUM, _COMMAND, _TOO_FEW, _TOO_MANY, _PARAMETER, _REGISTER, _NOT_ALLOWED, _BAUD = 3, 4, 5, 6, 7, 8, 9, 12


class VectorNavDevice:
    """A VN-100 with its link at serial port 1, as delivered: VNYMR at 40 Hz, no binary output.

    The knobs of ``faults`` may be turned at any time; if one gyro is saturated, the range of all is small. Otherwise it
    is ``range_rps``.
    """

    def __init__(
        self, setup: ImuTwinSetup, write: Callable[[bytes], None], *, serial: str = "0100012345", baud: int = 921600
    ) -> None:
        """Prepare a device whose gyros sample at the rate of ``setup``, 800 Hz over a whole number; else ValueError.

        Faster output repeats samples. ``baud`` is the rate as delivered, which limits the outputs that can be set.
        Upright by default. Each of several has a serial number of its own.
        """
        rate_hz = setup.rate_hz
        if vectornav.IMU_RATE_HZ % rate_hz:
            raise ValueError(
                f"a VectorNav samples at {vectornav.IMU_RATE_HZ} Hz over a whole number, not at {rate_hz:g} Hz"
            )
        self.faults = setup.faults
        self.range_rps = float(_GYRO_RANGE_RPS)
        self._gyros, self._write, self._up = setup.gyros, write, setup.up or upright
        self._decoder = vectornav.VectorNavDecoder(binary=False)
        self._random = np.random.default_rng(list(serial.encode()))
        self._ticks_per_sample = vectornav.IMU_RATE_HZ // round(rate_hz)
        self._tick_s = 1 / (vectornav.IMU_RATE_HZ * (1 + self.faults.clock_ppm * 1e-6))
        self._identity = {1: ("VN-100S-CR",), 2: ("7",), 3: (f"{int(serial) + setup.number:010d}",), 4: ("2.1.0.0",)}
        off = ("0", "1", "01", "0001")
        self._factory = {5: (str(baud),), 6: ("14",), 7: ("40",), **dict.fromkeys(_BINARY, off)}
        self._factory |= {register: tuple(values.split(",")) for register, values in _MORE.items()}
        self._flash = dict(self._factory)
        self._tick, self._zero_ns = 0, -_ON_SINCE_NS
        self._last = np.zeros(len(_FORMATS))
        self._wake_up()

    async def serve(self) -> None:
        """Send outputs until cancelled, in bursts of about 10 ms, as an operating system hands them over.

        While paused it sends none, and goes on measuring.
        """
        loop = asyncio.get_running_loop()
        start = loop.time()
        burst = burst_of(vectornav.IMU_RATE_HZ / self._ticks_per_sample)
        while True:
            ticks = self._tick + self._ticks_per_sample * np.arange(1, burst + 1)
            at = np.asarray(start + ticks * self._tick_s, dtype=np.float64)
            await asyncio.sleep(max(float(at[-1]) - loop.time(), 0.0))
            rows = np.vstack([self._last, self._measured(at)])
            if not self._paused and (data := self._outputs(rows, self._tick, int(ticks[-1]))):
                self._write(data)
            self._tick, self._last = int(ticks[-1]), rows[-1]

    def received(self, data: bytes) -> None:
        """Reply to each command completed by ``data``, and after these with a checksum error to each damaged one."""
        damaged = self._decoder.bad_sentences
        for command in self._decoder.feed(data):
            if isinstance(command, vectornav.Sentence):
                reply = self._reply(command)
                self._write(reply if isinstance(reply, bytes) else vectornav.encode_sentence(reply))
        for _ in range(self._decoder.bad_sentences - damaged):
            self._write(vectornav.encode_sentence(_error(_CHECKSUM)))

    def _wake_up(self) -> None:
        """Start with the settings in flash."""
        self._registers = dict(self._flash)
        self._layouts = {register: _layout(self._registers[register]) for register in _BINARY}
        self._paused = False

    def _restart(self) -> None:
        self._zero_ns = self._tick * _TICK_NS
        self._wake_up()

    def _measured(self, at: Floats) -> Floats:
        """Return all measured values (n, 17) at instants ``at`` (n,) in s, in the columns named above.

        Stuck, clipped and spoilt gyros show in the raw rates; the compensated ones are the raw ones with the register's
        bias and matrix applied. Magnetic field and pressure are constant.
        """
        rows = np.empty((len(at), len(_FORMATS)))
        up = self._up(at)
        rows[:, _YPR] = tilt_deg(-up)[:, ::-1]  # from north, east, down
        rows[:, _MAG] = _MAG_GAUSS
        rows[:, _ACCEL] = up * STANDARD_GRAVITY_MPS2
        range_rps = _LITTLE_RPS if self.faults.saturated else self.range_rps
        rows[:, _RAW_GYRO] = np.clip(self._gyros.sample(at), -range_rps, range_rps)
        for gyro in self.faults.stuck:
            rows[:, _RAW_GYRO.start + gyro] = self._last[_RAW_GYRO.start + gyro]
        rows[:, _RAW_GYRO] = self.faults.spoilt(rows[:, _RAW_GYRO], float(np.finfo(np.float32).max))
        *matrix, bx, by, bz = map(float, self._registers[_GYRO_COMPENSATION])
        rows[:, _GYRO] = (rows[:, _RAW_GYRO] - (bx, by, bz)) @ np.reshape(matrix, (3, 3)).T
        rows[:, _TEMPERATURE] = self._gyros.temperatures_c(at)
        rows[:, _PRESSURE] = _PRESSURE_KPA
        return rows

    def _outputs(self, rows: Floats, after: int, last: int) -> bytes:
        """Return the bytes sent after tick ``after`` up to tick ``last`` (of 800 Hz), in order.

        ``rows`` (n, 17) are measured values, the first of them at ``after``; outputs faster than the gyros repeat rows.
        Outputs are dropped or doubled by ``faults``.
        """
        sent: list[tuple[int, bytes]] = []
        for period, encode in self._periodic():
            ticks = np.arange(after - after % period + period, last + 1, period)
            if len(ticks):
                held = rows[(ticks - after) // self._ticks_per_sample]
                sent += zip(ticks.tolist(), encode(held, ticks * _TICK_NS - self._zero_ns), strict=True)
        sent.sort(key=lambda output: output[0])
        copies = copies_sent(self._random, len(sent), self.faults.dropped, self.faults.doubled)
        return b"".join(data * times for (_, data), times in zip(sent, copies.tolist(), strict=True))

    def _periodic(self) -> list[tuple[int, Callable[[Floats, Ints], list[bytes]]]]:
        """Return the active outputs, each as its period in ticks of 800 Hz and a function that encodes rows.

        Binary outputs count if they are for serial port 1 and have a divisor; the ASCII output if its type is not 0.
        The function takes measured values (n, 17) and device times (n,) in ns.
        """
        outputs: list[tuple[int, Callable[[Floats, Ints], list[bytes]]]] = []
        for register, layout in self._layouts.items():
            mode, divisor = map(int, self._registers[register][:2])
            if layout is not None and mode & 1 and divisor:  # at serial port 1
                outputs.append((divisor, partial(_frames, layout)))
        kind = int(self._registers[6][0])
        if kind:
            header, register = _ASYNC[kind]

            def sentences(rows: Floats, _: Ints) -> list[bytes]:
                return [vectornav.encode_sentence(vectornav.Sentence(header, _printed(row, register))) for row in rows]

            outputs.append((vectornav.IMU_RATE_HZ // int(self._registers[7][0]), sentences))
        return outputs

    def _reply(self, command: vectornav.Sentence) -> vectornav.Sentence | bytes:
        """Carry out a command and return the reply: a sentence, or bytes for a polled frame.

        A refusal, also of an unknown command, is a VNERR sentence. Pausing, saving to flash, factory settings and
        restart act as on the device; tare and the filter's switches are only acknowledged.
        """
        try:
            if command.header == "VNRRG":
                return self._read(command)
            if command.header == "VNWRG":
                return self._store(command)
            if command.header == "VNBOM":
                return self._polled(_number(_exactly(1, command.fields)[0]))
            if command.header in ("VNASY", "VNKMD", "VNKAD"):
                (choice,) = _exactly(1, command.fields)
                if choice not in ("0", "1"):
                    raise Refused(_PARAMETER)
                if command.header == "VNASY":
                    self._paused = choice == "0"
                return command
            _exactly(0, command.fields)
            if command.header == "VNWNV":
                self._flash = dict(self._registers)
            elif command.header == "VNRFS":
                self._flash = dict(self._factory)
                self._restart()
            elif command.header == "VNRST":
                self._restart()
            elif command.header != "VNTAR":
                raise Refused(_COMMAND)
        except Refused as refusal:
            return _error(refusal.code)
        return command

    def _polled(self, output: int) -> bytes:
        """Return the current frame of binary output 1 to 3; Refused for one that is off."""
        layout = self._layouts.get(_BINARY[0] - 1 + output)
        if layout is None:
            raise Refused(_PARAMETER)
        return _frames(layout, self._last[None], np.array([self._tick * _TICK_NS - self._zero_ns]))[0]

    def _read(self, command: vectornav.Sentence) -> vectornav.Sentence:
        """Return the reply to a read of a register: the last measured values, the identity or a setting.

        Refused for any other register.
        """
        register = _number(_exactly(1, command.fields)[0])
        if register in _COLUMNS:
            values = _printed(self._last, register)
        else:
            values = {**self._identity, **self._registers}.get(register, ())
        if not values:
            raise Refused(_REGISTER)
        return vectornav.Sentence("VNRRG", (f"{register:02d}", *values))

    def _store(self, command: vectornav.Sentence) -> vectornav.Sentence:
        """Write a register and return the reply.

        Refused for an unknown or read-only register, for wrong values, and if the outputs then asked for more than the
        baud rate; the register is unchanged in all these cases.
        """
        if not command.fields:
            raise Refused(_TOO_FEW)
        register, values = _number(command.fields[0]), command.fields[1:]
        if register not in self._registers:
            raise Refused(_NOT_ALLOWED if register in self._identity or register in _COLUMNS else _REGISTER)
        if register in _BINARY:
            if not values:
                raise Refused(_TOO_FEW)
            values = (*(str(_number(value)) for value in values[:2]), *values[2:])
            self._set_binary(register, values)
        elif not _fit(register, _exactly(len(self._factory[register]), values)):
            raise Refused(_PARAMETER)
        before, self._registers[register] = self._registers[register], values
        if self._busy_bps() > int(self._registers[5][0]):
            self._registers[register] = before
            if register in _BINARY:
                self._layouts[register] = _layout(before)
            raise Refused(_BAUD)
        return vectornav.Sentence("VNWRG", (f"{register:02d}", *values))

    def _set_binary(self, register: int, values: tuple[str, ...]) -> None:
        if len(values) < 3:
            raise Refused(_TOO_FEW)
        if not int(values[0]) <= 3:
            raise Refused(_PARAMETER)
        self._layouts[register] = _layout(values)

    def _busy_bps(self) -> float:
        """Return how many bits a second all that is set to be sent takes."""
        row, time_ns = np.zeros((1, len(_FORMATS))), np.zeros(1, dtype=np.int64)
        sizes = [(period, len(encode(row, time_ns)[0])) for period, encode in self._periodic()]
        return sum(size * _BITS_PER_BYTE * vectornav.IMU_RATE_HZ / period for period, size in sizes)


def _error(code: int) -> vectornav.Sentence:
    return vectornav.Sentence("VNERR", (f"{code:02X}",))


def _exactly(count: int, values: tuple[str, ...]) -> tuple[str, ...]:
    if len(values) != count:
        raise Refused(_TOO_FEW if len(values) < count else _TOO_MANY)
    return values


def _number(text: str) -> int:
    if not (text.isdecimal() and text.isascii() and len(text) < 10):
        raise Refused(_PARAMETER)
    return int(text)


def _fit(register: int, values: tuple[str, ...]) -> bool:
    """Return whether a register takes these: 0 any text, the others numbers, some only certain ones."""
    numbers = register == 0 or all(map(_DECIMAL.fullmatch, values))
    return numbers and (register not in _ONE_OF or _number(values[0]) in _ONE_OF[register])


def _layout(values: tuple[str, ...]) -> vectornav.Layout | None:
    """Return the frame layout that the values of registers 75 to 77 select (mode, divisor, groups, fields in hex).

    None if no group is selected. Refused if they are no hexadecimal numbers, are too few or too many for the groups, or
    name a field that is unknown or a group that a VN-100 does not have.
    """
    try:
        words = [int(text, 16) for text in values[2:]]
        groups, fields = words[0], words[1:]
        header = bytes([0xFA, groups]) + b"".join(word.to_bytes(2, "little") for word in fields)
    except (ValueError, OverflowError):
        raise Refused(_PARAMETER) from None
    if len(fields) != groups.bit_count():
        raise Refused(_TOO_FEW if len(fields) < groups.bit_count() else _TOO_MANY)
    if not groups:
        return None
    try:
        layout = vectornav.layout_of_header(header)
    except ValueError:
        raise Refused(_PARAMETER) from None
    if not {group for group, _ in layout.masks} <= _GROUPS:
        raise Refused(_PARAMETER)
    return layout


def _frames(layout: vectornav.Layout, rows: Floats, time_ns: Ints) -> list[bytes]:
    data = vectornav.encode_frames(layout, _values(layout, rows, time_ns))
    return [data[at : at + layout.size] for at in range(0, len(data), layout.size)]


def _values(layout: vectornav.Layout, rows: Floats, time_ns: Ints) -> NDArray[np.void]:
    """Return frames (n,) filled with measured rows and times; fields that the twin does not simulate are 0."""
    values: NDArray[np.void] = np.zeros(len(rows), dtype=layout.dtype)
    for name in layout.dtype.names or ():
        field = name.partition(".")[2]
        if field == "time_startup":
            values[name] = time_ns
        elif field in _MEASURED:
            values[name] = rows[:, _MEASURED[field]]
    return values


def _printed(row: Floats, register: int) -> tuple[str, ...]:
    return tuple(format(row[column], _FORMATS[column]) for column in _COLUMNS[register])
