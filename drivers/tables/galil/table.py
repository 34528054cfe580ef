"""A turntable on a Galil DMC motion controller: up to eight axes on one controller, told apart by letter."""

import math
from collections.abc import Iterable

from drivers.errors import DeviceFault, DeviceRefused
from drivers.packaged import sentence
from drivers.protocols import ByteLink
from drivers.requests.exchange import Answer
from drivers.specs import TableSetup, TableSpec, described
from drivers.tables.base import INTERLOCK_OPEN
from drivers.tables.galil import language as galil
from drivers.tables.halting import bring_to_rest
from drivers.tables.line_table import LineTable
from drivers.types import AxisState, AxisStatus, Identity

TURN = 2 * math.pi

_LETTERS = "ABCDEFGH"
_POLL_S = 0.02
_HOMING_RATE_RPS = math.radians(30.0)
_LARGEST_COUNT = 2**31 - 1


class _RefusedError(DeviceRefused):
    """A refusal with its TC code as a number."""

    def __init__(self, device: str, message: str, code: int) -> None:
        super().__init__(device, message)
        self.code = code


class GalilTable(LineTable):
    """Turntable driver over a byte link, serial or TCP."""

    def __init__(self, setup: TableSetup, link: ByteLink) -> None:
        """Prepare for axes whose addresses are different letters; ValueError for others.

        The travel of each axis is set as soft limits after homing. Options of an axis: ``error_limit`` is the following
        error (rad) at which the controller switches the motor off; not given, the controller's own stays. Options of
        the table: ``homing`` is HM (home switch) or FI (index pulse, in positive direction); ``velocity_window`` (s) is
        the averaging time of TV, which depends on the controller's sample time (TM).
        """
        letters = [str(axis.address) for axis in setup.axes.values()]
        if not set(letters) <= set(_LETTERS) or len(set(letters)) != len(letters):
            raise ValueError(f"axis letters must be different ones of {_LETTERS}, not {', '.join(letters)}")
        super().__init__(setup, link, galil.GalilFraming())
        self._axes, self._homing = setup.axes, setup.options["homing"]
        self._velocity_delay_s = setup.options["velocity_window"] / 2
        self._powered: set[str] = set()
        self._jogs: dict[str, int] = {}  # rate in counts/s of axes with a jog command
        self._known_stops: dict[str, int] = {}  # stop codes that an operator has seen and reset

    async def open(self) -> None:
        """Open the link, get in step and ask every axis; LinkLost if the controller does not answer."""
        await self._exchange.open()
        for axis in self._axes:
            await self._switches(axis)

    async def identify(self) -> Identity:
        """Ask for model and firmware (^R^V) and for the serial number (_BN) where the controller has it."""
        model, firmware = galil.revision((await self._ask("\x12\x16", galil.TEXT)).text)
        number = await self._exchange.ask("MG _BN", galil.NUMBER)
        serial = "" if number.refused else f"{float(number.text):.0f}"
        return Identity(model, serial, firmware)

    async def enable(self) -> None:
        """Switch on every motor that is off, where it stands, with its error limit if that is stated.

        The controller is told to switch it off on errors; that it goes off later is a fault. Motors that are on are
        left alone. DeviceFault if an axis is in fault or its motor stays off.
        """
        for axis, own in self._axes.items():
            if (await self._sound(axis)).enabled:
                continue
            await self._tell(f"OE{own.address}=1")
            if (error_rad := own.options.get("error_limit")) is not None:
                await self._tell(f"ER{own.address}={max(self._counts(axis, error_rad), 1)}")
            await self._tell(f"SH{own.address}")
            if (await self._switches(axis)).motor_off:
                raise DeviceFault(self._device, f"the motor of axis {axis} remains off after it was switched on (SH)")
            self._powered.add(axis)

    async def home(self) -> None:
        """Run the controller's homing on all axes at once, define zero there, and set the travel as soft limits.

        It runs at 30 deg/s at most. An axis that moves is halted first; an axis without a travel gets no soft limits.
        DeviceFault or DeviceRefused if an axis does not find home, DeviceRefused as well if it takes more than a
        minute.
        """
        self.homing = set(self.limits)
        for axis, own in self._axes.items():
            if (await self._switches(axis)).moving:
                await self._halt(axis)
            rate = max(self._counts(axis, min(_HOMING_RATE_RPS, own.limits.rate_rps)), 1)
            await self._set_ramps(axis, own.limits.acceleration_rps2)
            await self._tell(f"JG{own.address}={rate}" if self._homing == "FI" else f"SP{own.address}={rate}")
            await self._tell(f"{self._homing}{own.address}")
        await self._begin(self._axes)
        await self._wait_for_home(_POLL_S)
        for axis, own in self._axes.items():
            await self._tell(f"DP{own.address}=0")
            if own.limits.travel_rad is not None:
                low, high = (self._counts(axis, angle) for angle in own.limits.travel_rad)
                await self._tell(f"BL{own.address}={low}")
                await self._tell(f"FL{own.address}={high}")

    async def _give_up_homing(self) -> None:
        await self.stop()

    async def _at_home(self, axis: str) -> bool:
        """Return whether an axis has ended its homing at home.

        DeviceFault for a fault, DeviceRefused if it ended without finding home.
        """
        switches, stop, fault = await self._condition(axis)
        if fault:
            raise DeviceFault(self._device, fault)
        if not switches.moving and stop != galil.HOMED:
            raise DeviceRefused(
                self._device, f"axis {axis} ended homing without finding home: SC {stop}, {galil.stop_text(stop)}"
            )
        return not switches.moving

    async def jog(self, axis: str, rate_rps: float, acceleration_rps2: float) -> None:
        """Turn an axis at a rate, rounded to counts/s; a jogging axis changes its rate without a halt.

        An axis that moves otherwise, or has ended its jog, is halted first, which raises as ``bring_to_rest``.
        DeviceRefused beyond the limits of the axis, which the gentlest ramp may be, or below half a count/s unless
        zero.
        """
        self._moved, letter = axis, self._axes[axis].address
        rate = self._rate(axis, rate_rps, acceleration_rps2)
        if (await self._switches(axis)).moving:
            if axis in self._jogs and await self._change_jog(axis, rate, acceleration_rps2):
                return
            await self._halt(axis)
        await self._set_ramps(axis, acceleration_rps2)
        await self._tell(f"JG{letter}={rate}")
        self._jogs[axis] = rate
        await self._begin([axis])

    async def move(self, axis: str, angle_rad: float, rate_rps: float, acceleration_rps2: float) -> None:
        """Start a move to an angle from home; an axis that moves is halted first, which raises as ``bring_to_rest``.

        ``rate_rps`` is a speed, of which the sign is ignored; it is rounded down to an even number of counts/s, at
        least 2. DeviceRefused beyond the limits of the axis, which the gentlest ramp may be, or of the controller's
        counter, or below half a count/s.
        """
        self._moved, letter = axis, self._axes[axis].address
        target, rate = self._counts(axis, angle_rad), abs(self._rate(axis, rate_rps, acceleration_rps2))
        if abs(target) > _LARGEST_COUNT:
            raise DeviceRefused(self._device, f"axis {axis}: the controller cannot count to {target}. Use fewer turns")
        if (await self._switches(axis)).moving:
            await self._halt(axis)
        self._jogs.pop(axis, None)
        await self._set_ramps(axis, acceleration_rps2)
        await self._tell(f"SP{letter}={max(rate // 2 * 2, 2)}")  # the controller has it in steps of two
        await self._tell(f"PA{letter}={target}")
        await self._begin([axis])

    async def read(self, axis: str) -> AxisState:
        """Measure angle (TP) and rate (TV). The rate is a mean, so its instant is the middle of that time."""
        letter, counts = self._axes[axis].address, self._axes[axis].counts_per_turn
        position = await self._ask(f"TP{letter}", galil.NUMBER)
        velocity = await self._ask(f"TV{letter}", galil.NUMBER)
        angle, rate = ((one.sent_s, one.received_s, float(one.text) / counts * TURN) for one in (position, velocity))
        return AxisState.told(angle, rate, 2 * self._velocity_delay_s)

    async def status(self, axis: str) -> AxisStatus:
        """Read TS word and stop code of an axis, and TV of one that jogs.

        Enabled means that its motor is on. A target is reached if the axis stopped there or at home, or jogs within a
        thousandth (and 1 count/s) of its rate, with its motor on. A fault is described with both codes. The interlock
        is said to be open if the motor is off and the abort input is active.
        """
        switches, stop, fault = await self._condition(axis)
        reached = not switches.moving and stop in (galil.AT_TARGET, galil.HOMED)
        if switches.moving and axis in self._jogs:
            reached = abs(await self._number("TV", axis) - self._jogs[axis]) <= 1.0 + 1e-3 * abs(self._jogs[axis])
        return AxisStatus(
            enabled=not switches.motor_off,
            target_reached=reached and not switches.motor_off,
            fault=fault,
            text=f"{switches.text} (TS {switches.word}); SC {stop}, {galil.stop_text(stop)}",
            interlock=INTERLOCK_OPEN if switches.motor_off and await self._abort_input() else "",
        )

    async def _abort_input(self) -> bool:
        """Return whether the abort input is active (_AB is 0): an emergency stop; OE then has the motors off."""
        answer = await self._exchange.ask("MG _AB", galil.NUMBER)
        return not answer.refused and float(answer.text) == 0.0

    async def stop(self) -> str:
        """Stop every axis with its allowed deceleration, on a new connection if necessary; return what was seen.

        Raises as ``bring_to_rest``.
        """

        async def idle(axis: str) -> bool:
            return not (await self._switches(axis)).moving

        braking = self._hardest_deceleration()
        return await self._rest(lambda axis: (braking, f"ST{self._axes[axis].address}"), self.read, idle)

    async def abort(self) -> None:
        """Stop at once, without a ramp, and wait for rest; the motors go off, as off-on-error is set.

        That they go off counts as no fault of theirs. Raises as ``bring_to_rest``.
        """
        self._powered.clear()
        self._jogs.clear()
        await self._rest(lambda axis: ("AB",), self.read)

    async def reset_fault(self) -> None:
        """Acknowledge the faults within this driver; DeviceFault at the first axis whose cause is still present.

        A Galil has no command for it: a motor that was switched off is switched on again by ``enable``. A cause is
        present while the abort input is active, or the following error of a motor that is on is too large.
        """
        for axis in self._axes:
            switches, stop, fault = await self._condition(axis)
            if not fault:
                continue
            if await self._abort_input() or (not switches.motor_off and switches.error_exceeded):
                raise DeviceFault(
                    self._device, f"axis {axis} remains in fault because its cause is still present: {fault}"
                )
            self._known_stops[axis] = stop
            if switches.motor_off:
                self._powered.discard(axis)

    async def disable(self) -> None:
        """Switch every motor off; DeviceRefused while an axis moves."""
        await self._tell("MO" + "".join(sorted(str(axis.address) for axis in self._axes.values())))
        self._powered.clear()

    async def _condition(self, axis: str) -> tuple[galil.Switches, int, str]:
        """Return TS word, stop code and the fault of an axis in words, empty if there is none.

        Faults are a motor that is off after this driver had switched it on, or by a stop code of that kind; too large a
        following error; and a limit that was run into. Stop codes that were acknowledged by ``reset_fault`` are no
        fault.
        """
        switches = await self._switches(axis)
        stop = round(await self._number("SC", axis))
        known = self._known_stops.get(axis) == stop
        reason = ""
        if switches.motor_off and axis in self._powered:
            reason = "its motor has switched off"
        elif switches.motor_off and stop in galil.FATAL_STOPS and not known:
            reason = "its motor was switched off by a fault"
        elif not switches.motor_off and switches.error_exceeded:
            reason = "its following error is too large"
        elif not switches.motor_off and stop in galil.LIMIT_STOPS and not known:
            reason = "it ran into a limit"
        fault = f"axis {axis}: {reason} (SC {stop}, {galil.stop_text(stop)}; TS {switches.word})" if reason else ""
        return switches, stop, fault

    async def _switches(self, axis: str) -> galil.Switches:
        return galil.Switches(round(await self._number("TS", axis)) & 0xFF)

    async def _number(self, word: str, axis: str) -> float:
        return float((await self._ask(f"{word}{self._axes[axis].address}", galil.NUMBER)).text)

    async def _begin(self, axes: Iterable[str]) -> None:
        """Start the motions that were set up; DeviceRefused if the controller refuses: none of the axes jogs then.

        Stop codes of these axes that were acknowledged count again. A refusal of a repeated BG as "already running" is
        ignored: the answer to the first one was lost.
        """
        names = list(axes)
        for axis in names:
            self._known_stops.pop(axis, None)
        line = "BG" + "".join(sorted(str(self._axes[axis].address) for axis in names))
        answer = await self._exchange.ask(line, galil.NOTHING)
        if answer.refused:
            error = await self._refusal(line, answer)
            if not (answer.repeated and error.code == galil.RUNNING):
                for axis in names:
                    self._jogs.pop(axis, None)
                raise error

    async def _change_jog(self, axis: str, rate: int, acceleration_rps2: float) -> bool:
        """Change the rate (counts/s) and ramps of a jogging axis; return False if it does not jog or move any more.

        Any other refusal is raised, DeviceRefused for a ramp as by ``_set_ramps``.
        """
        await self._set_ramps(axis, acceleration_rps2)
        try:
            await self._tell(f"JG{self._axes[axis].address}={rate}")
        except _RefusedError as error:
            if error.code == galil.NOT_JOGGING:
                return False
            raise
        self._jogs[axis] = rate
        return bool((await self._switches(axis)).moving)

    async def _halt(self, axis: str) -> None:
        self._jogs.pop(axis, None)
        line = f"ST{self._axes[axis].address}"
        await bring_to_rest(self._device, [axis], lambda _: self._tell(line), self.read, self._timeout_s)

    def _hardest_deceleration(self) -> str:
        by_letter = {
            str(own.address): str(galil.floor_acceleration(own.limits.acceleration_rps2 / TURN * own.counts_per_turn))
            for own in self._axes.values()
        }
        return "DC " + ",".join(by_letter.get(letter, "") for letter in _LETTERS[: ord(max(by_letter)) - 64])

    async def _set_ramps(self, axis: str, acceleration_rps2: float) -> None:
        """Set acceleration and deceleration of an axis, rounded down to steps of 1024 counts/s2, at least one of them.

        DeviceRefused if that is above the limit of the axis.
        """
        own = self._axes[axis]
        acceleration = galil.floor_acceleration(acceleration_rps2 / TURN * own.counts_per_turn)
        allowed = own.limits.acceleration_rps2 / TURN * own.counts_per_turn
        if acceleration > allowed:
            least = math.degrees(acceleration / own.counts_per_turn * TURN)
            raise DeviceRefused(self._device, sentence("table.gentlest", axis=axis, counts=acceleration, dps2=least))
        for command in ("AC", "DC"):
            await self._tell(f"{command}{own.address}={acceleration}")

    def _rate(self, axis: str, rate_rps: float, acceleration_rps2: float) -> int:
        """Return a rate in counts/s; DeviceRefused beyond the limits of the axis, or for one below half a count/s.

        The controller does not know these limits, which may be exceeded by a thousandth; ``acceleration_rps2`` is
        compared with its own. Rate zero is returned as it is.
        """
        limits = self._axes[axis].limits
        if abs(rate_rps) > limits.rate_rps * 1.001 or abs(acceleration_rps2) > limits.acceleration_rps2 * 1.001:
            dps, dps2 = math.degrees(rate_rps), math.degrees(acceleration_rps2)
            raise DeviceRefused(self._device, sentence("table.beyond_limits", axis=axis, dps=dps, dps2=dps2))
        rate = self._counts(axis, rate_rps)
        if rate == 0 and rate_rps != 0.0:
            raise DeviceRefused(self._device, sentence("table.half_a_count", axis=axis, dps=math.degrees(rate_rps)))
        return rate

    def _counts(self, axis: str, turns_rad: float) -> int:
        return round(turns_rad / TURN * self._axes[axis].counts_per_turn)

    async def _refusal(self, line: str, answer: Answer) -> _RefusedError:
        """Return why a line was refused. TC1 gives the code of the last refusal and clears it."""
        reason = await self._exchange.ask("TC1", galil.TEXT)
        code, words = galil.error_of("" if reason.refused else reason.text)
        return _RefusedError(self._device, f"refuses {line!r}: TC {code}, {words}", code)


SPEC = described(TableSpec, __package__, make=GalilTable, acceleration_step=galil.ACCELERATION_STEP)
