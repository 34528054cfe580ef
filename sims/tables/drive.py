"""A CiA 402 servo drive over one axis of the table model: state machine, modes, set-points, watchdog."""

import asyncio
import math
from collections.abc import Callable

from drivers.tables.modbus import cia402
from drivers.tables.modbus.cia402 import DriveState
from drivers.tables.modbus.registers import DriveProfile
from sims.physics.table import TableModel
from sims.wires.line_controller import Watchdog

TURN = 2 * math.pi
_RELATIVE, _HALT = 0x40, 0x100  # bits 6 and 8 of the controlword
_READ_ONLY = ("statusword", "position", "rate", "error_code", "serial_number", "firmware")


class Drive:
    """One drive. Values are in turns, turns/s and turns/s2, as in its registers.

    It behaves as its profile says: with a register ``access`` it accepts nothing from a master that has not written 1
    there; with ``node_guard`` it trips after so many milliseconds of silence (0: never). Unknown registers store what
    is written to them.
    """

    def __init__(
        self, table: TableModel, axis: str, profile: DriveProfile, watchdog_s: float, *, cycle_s: float = 0.0
    ) -> None:
        """Start in Switch-on disabled, as a drive of this profile; ``watchdog_s`` of silence stops the axis (0: never).

        The controlword is sampled once per ``cycle_s``, counted from the zero of the table's clock: status and motion
        follow at the next sample, and only the last of several controlwords within a cycle acts. With 0 it acts at
        once.
        """
        self._table, self._axis = table, axis
        self._errors, self._interlock = profile.errors, profile.interlock
        self._state = DriveState.SWITCH_ON_DISABLED
        self._controlword = 0
        self._cycle_s = cycle_s
        self._written: int | None = None  # controlword that has not been sampled yet
        self._watchdog_s = watchdog_s
        self._watchdog = Watchdog(table.clock, self._silence_s, self._master_is_silent)
        self._acknowledged = False
        self._homed = False
        self._homing = False
        self._goal: float | None = None  # where the last move was to end, in turns
        self.values: dict[str, float] = dict.fromkeys(profile.registers, 0.0)
        self.values |= {"mode": cia402.MODE_PROFILE_VELOCITY, "serial_number": 1.0, "firmware": 1.0}

    def heard(self) -> None:
        """Note that the master has sent something."""
        self._watchdog.heard(self._state is DriveState.OPERATION_ENABLED)

    def read(self, register: str) -> float:
        """Return the present value of a register, in turns and s; KeyError for one that the profile does not have.

        Status, position, rate, error and interlock are those of the table now; any other register holds what was
        written.
        """
        self._update()
        readers: dict[str, Callable[[], float]] = {
            "statusword": self._statusword,
            "controlword": lambda: self._controlword if self._written is None else self._written,
            "position": lambda: self._table.encoder_turns(self._axis),
            "rate": lambda: self._table.read_rate_rps(self._axis) / TURN,
            "error_code": self._error_code,
            self._interlock[0]: lambda: 0 if self._table.interlock_open else self._interlock[1],
        }
        return readers[register]() if register in readers else self.values[register]

    def write(self, register: str, value: float) -> None:
        """Write a register; a controlword acts when the drive samples it, a target rate at once in velocity mode.

        Registers that the profile does not have are ignored.
        """
        self._update()
        if register == "controlword":
            self._take_controlword(int(value))
        elif register in self.values:
            self.values[register] = value
            if register == "mode":
                self._goal = None
            if register == "target_rate" and self.values["mode"] == cia402.MODE_PROFILE_VELOCITY:
                self._follow_rate()

    def commanded_by_us(self, register: str) -> bool:
        """Return whether the master has the command, or is about to take it."""
        return register == "access" or self.values.get("access", 1.0) == 1.0

    def accepts(self, register: str, value: float) -> bool:
        """Return whether the drive accepts a value for a register: a known mode, or a rate that the axis can turn at.

        Any value of another register is accepted, unless that can only be read.
        """
        if register == "mode":
            return value in (cia402.MODE_PROFILE_POSITION, cia402.MODE_PROFILE_VELOCITY, cia402.MODE_HOMING)
        if register in ("target_rate", "profile_rate"):
            return abs(value) * TURN <= self._table.data[self._axis].max_rate_rps * 1.001
        return register not in _READ_ONLY

    def _take_controlword(self, word: int) -> None:
        """Store a controlword for the next sample, which is scheduled in the running loop if none is.

        Without a cycle it acts at once.
        """
        if not self._cycle_s:
            self._control(word)
            return
        if self._written is None:
            now_s = self._table.clock()
            sample_s = (math.floor(now_s / self._cycle_s) + 1) * self._cycle_s
            asyncio.get_running_loop().call_later(sample_s - now_s, self._sample)
        self._written = word

    def _sample(self) -> None:
        """Carry out the controlword that was written last."""
        word, self._written = self._written, None
        self._update()
        if word is not None:
            self._control(word)

    def _control(self, word: int) -> None:
        """Act on a controlword: reset a fault on the rise of bit 7, else change state, then operate if enabled.

        A drive in fault ignores everything but the reset, and that too while the interlock is open.
        """
        before, self._controlword = self._controlword, word
        rising = word & ~before
        if rising & 0x80 and self._state is DriveState.FAULT and not self._table.interlock_open:
            self._table.tripped.pop(self._axis, None)
            self._state = DriveState.SWITCH_ON_DISABLED
            return
        if self._state in (DriveState.FAULT, DriveState.FAULT_REACTION):
            return
        self._walk(word)
        if self._state is DriveState.OPERATION_ENABLED:
            self._operate(word, rising, (word ^ before) & _HALT)

    def _walk(self, word: int) -> None:
        """Change state by the bits 0 to 3 of the controlword (CiA 402 transitions 2 to 12 and 16).

        A word that leads nowhere from the present state changes nothing. Quick stop brakes an enabled axis and releases
        any other.
        """
        state = self._state
        if not word & 0x02:  # disable voltage
            self._release(DriveState.SWITCH_ON_DISABLED)
        elif not word & 0x04:  # quick stop
            if state is DriveState.OPERATION_ENABLED:
                self._table.stop(self._axis)
                self._state = DriveState.QUICK_STOP_ACTIVE
            elif state is not DriveState.QUICK_STOP_ACTIVE:
                self._release(DriveState.SWITCH_ON_DISABLED)
        elif word & 0x0F == 0x0F:
            if state in (DriveState.SWITCHED_ON, DriveState.READY_TO_SWITCH_ON, DriveState.QUICK_STOP_ACTIVE):
                self._enter_operation()
        elif state is DriveState.QUICK_STOP_ACTIVE:
            pass  # as with the quick stop options 5 to 8 (605Ah): neither shutdown nor switch on leads out of it
        elif word & 0x07 == 0x07:
            if state is DriveState.READY_TO_SWITCH_ON:
                self._state = DriveState.SWITCHED_ON
            elif state is DriveState.OPERATION_ENABLED:
                self._release(DriveState.SWITCHED_ON)
        else:
            self._release(DriveState.READY_TO_SWITCH_ON)

    def _enter_operation(self) -> None:
        self._state = DriveState.OPERATION_ENABLED
        self.values["target_rate"] = 0.0
        self._acknowledged, self._goal = False, None
        self.heard()

    def _operate(self, word: int, rising: int, halt_changed: int) -> None:
        """Start or change the motion of the present mode: follow the rate, start homing, or start or halt a move.

        ``rising`` are the bits of the controlword that have risen: homing and moves start with bit 4, by which a set
        point is also acknowledged until it is cleared. ``halt_changed`` is not 0 if bit 8 has changed. Other modes do
        nothing.
        """
        mode = self.values["mode"]
        if mode == cia402.MODE_PROFILE_VELOCITY:
            self._follow_rate()
        elif mode == cia402.MODE_HOMING and rising & 0x10:
            self._homed, self._homing = False, True
            self._table.seek_home(self._axis, self.values["homing_rate_1"] * TURN)
        elif mode == cia402.MODE_PROFILE_POSITION:
            if rising & 0x10:
                self._acknowledged = True
                self._goal = self._start_of_move(word) + self.values["target_position"]
            elif not word & 0x10:
                self._acknowledged = False
            if rising & 0x10 or halt_changed:
                self._follow_goal()

    def _start_of_move(self, word: int) -> float:
        """Return from where a target position counts, in turns: a relative one from the target before it (60F2h: 0).

        Without a target before it that is the position; an absolute one counts from 0.
        """
        if not word & _RELATIVE:
            return 0.0
        return self._table.encoder_turns(self._axis) if self._goal is None else self._goal

    def _follow_goal(self) -> None:
        if self._controlword & _HALT:
            self._jog(0.0)
        elif self._goal is not None:
            rate, acceleration = self.values["profile_rate"] * TURN, self.values["acceleration"] * TURN
            self._table.move_encoder(self._axis, self._goal, rate, acceleration)

    def _follow_rate(self) -> None:
        if self._state is DriveState.OPERATION_ENABLED:
            self._jog(self.values["target_rate"])

    def _jog(self, rate: float) -> None:
        rate, ramp = (0.0, "deceleration") if self._controlword & _HALT else (rate, "acceleration")
        self._table.motion[self._axis].jog(self._table.clock(), rate * TURN, self.values[ramp] * TURN)

    def _release(self, state: cia402.DriveState) -> None:
        """Enter ``state``, out of operation: an axis that turns brakes, and homing is given up."""
        if self._table.rate_rps(self._axis):
            self._table.stop(self._axis)
        self._state = state
        self._homing = False

    def _update(self) -> None:
        """Apply events since the last call: a trip, the end of a fault reaction, the end of homing.

        A tripped axis is in FAULT_REACTION until it stands, then in FAULT, and its homing is given up. Where homing
        ends the encoder is zeroed.
        """
        motion = self._table.motion[self._axis]
        settled = motion.settled(self._table.clock())
        if self._axis in self._table.tripped:
            self._state = DriveState.FAULT if settled else DriveState.FAULT_REACTION
            self._homing = False
        if self._homing and settled:
            self._homing, self._homed = False, True
            self._table.zero_encoder(self._axis)

    def _statusword(self) -> int:
        """Return the statusword: state, voltage, target reached, internal limit after a limit switch, bits 12 and 13.

        Bit 12 says homed, set point taken or at rest, by the mode; bit 13 a following error in position mode.
        """
        word = self._state.value[1] | cia402.VOLTAGE_ENABLED
        mode = self.values["mode"]
        tripped = self._table.tripped.get(self._axis, "")
        settled = self._table.motion[self._axis].settled(self._table.clock())
        if tripped.startswith("limit switch"):
            word |= cia402.INTERNAL_LIMIT
        if settled and not self._homing:
            word |= cia402.TARGET_REACHED
        if mode == cia402.MODE_HOMING:
            word |= cia402.BIT_12 if self._homed else 0
        elif mode == cia402.MODE_PROFILE_POSITION:
            word |= cia402.BIT_12 if self._acknowledged else 0
            word |= cia402.BIT_13 if tripped == "following error" else 0
        elif self._table.rate_rps(self._axis) == 0.0:
            word |= cia402.BIT_12
        return word

    def _error_code(self) -> int:
        """Return the code of the trip: of the first error whose name begins with its reason, else the first of all."""
        reason = self._table.tripped.get(self._axis)
        if reason is None:
            return 0
        named = [code for code, text in self._errors.items() if text.startswith(reason)]
        return next(iter([*named, *self._errors]), 0)

    def _silence_s(self) -> float:
        """Return how long the master may be silent, 0 for no limit: the drive's own guard, or the bench's watchdog."""
        limits = [limit for limit in (self.values.get("node_guard", 0.0) / 1000, self._watchdog_s) if limit]
        return min(limits, default=0.0)

    def _master_is_silent(self) -> None:
        """React to the silence of the master if the axis is in OPERATION_ENABLED; otherwise do nothing.

        The shorter of both limits has expired: if that is the bench's watchdog, power goes off, else (node guarding)
        the axis trips.
        """
        if self._state is not DriveState.OPERATION_ENABLED:
            return
        if self._silence_s() == self._watchdog_s:
            self._release(DriveState.SWITCH_ON_DISABLED)
        else:
            self._table.trip(self._axis, "node guarding")
            self._update()
