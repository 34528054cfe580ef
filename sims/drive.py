"""A CiA 402 servo drive over one axis of the table model: state machine, modes, set-points, watchdog."""

from __future__ import annotations

import asyncio
import math

from drivers.cia402 import (
    BIT_12,
    MODE_HOMING,
    MODE_PROFILE_POSITION,
    MODE_PROFILE_VELOCITY,
    TARGET_REACHED,
    VOLTAGE_ENABLED,
    DriveState,
)
from sims.table import TableModel

TURN = 2 * math.pi


class Drive:
    """One drive. Values are in turns, turns/s and turns/s2, as its registers carry them."""

    def __init__(self, table: TableModel, axis: str, watchdog_s: float) -> None:
        """Start in Switch-on disabled; ``watchdog_s`` of silence stops the axis (0: never)."""
        self._table, self._axis = table, axis
        self._state = DriveState.SWITCH_ON_DISABLED
        self._controlword = 0
        self._watchdog_s = watchdog_s
        self._last_heard_s = table.clock()
        self._watching = False
        self._acknowledged = False
        self._homed = False
        self._homing = False
        self.values: dict[str, float] = {
            "mode": MODE_PROFILE_VELOCITY,
            "target_position": 0.0,
            "profile_rate": 0.0,
            "acceleration": 0.0,
            "deceleration": 0.0,
            "homing_method": 0,
            "homing_rate_1": 0.0,
            "homing_rate_2": 0.0,
            "target_rate": 0.0,
        }

    def heard(self) -> None:
        """Note that the master has said something."""
        self._last_heard_s = self._table.clock()
        if self._watchdog_s and not self._watching and self._state is DriveState.OPERATION_ENABLED:
            self._watching = True
            asyncio.get_running_loop().call_later(self._watchdog_s, self._check_silence)

    def read(self, register: str) -> float:
        """Return what a register says now."""
        self._update()
        if register == "statusword":
            return self._statusword()
        if register == "controlword":
            return self._controlword
        if register == "position":
            return self._table.encoder_turns(self._axis)
        if register == "rate":
            return self._table.rate_rps(self._axis) / TURN
        return self.values[register]

    def write(self, register: str, value: float) -> None:
        """Take a value; a controlword acts at once."""
        self._update()
        if register == "controlword":
            self._control(int(value))
        elif register in self.values:
            self.values[register] = value
            if register == "target_rate" and self.values["mode"] == MODE_PROFILE_VELOCITY:
                self._follow_rate()

    def accepts(self, register: str, value: float) -> bool:
        """Return whether a value is within what the drive takes."""
        if register == "mode":
            return value in (MODE_PROFILE_POSITION, MODE_PROFILE_VELOCITY, MODE_HOMING)
        if register in ("target_rate", "profile_rate"):
            return abs(value) * TURN <= self._table.data[self._axis].max_rate_rps * 1.001
        return register not in ("statusword", "position", "rate")

    def _control(self, word: int) -> None:
        before, self._controlword = self._controlword, word
        rising = word & ~before
        if rising & 0x80 and self._state is DriveState.FAULT:
            self._table.tripped.pop(self._axis, None)
            self._state = DriveState.SWITCH_ON_DISABLED
            return
        if self._state in (DriveState.FAULT, DriveState.FAULT_REACTION):
            return
        self._walk(word)
        if self._state is DriveState.OPERATION_ENABLED:
            self._operate(word, rising)

    def _walk(self, word: int) -> None:
        """Carry out the device-control bits 0 to 3 (CiA 402 transitions 2 to 12 and 16)."""
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
        elif word & 0x07 == 0x07:
            if state is DriveState.READY_TO_SWITCH_ON:
                self._state = DriveState.SWITCHED_ON
            elif state is DriveState.OPERATION_ENABLED:
                self._release(DriveState.SWITCHED_ON)
        elif state is not DriveState.QUICK_STOP_ACTIVE or self._table.rate_rps(self._axis) == 0.0:
            self._release(DriveState.READY_TO_SWITCH_ON)

    def _enter_operation(self) -> None:
        self._state = DriveState.OPERATION_ENABLED
        self.values["target_rate"] = 0.0
        self._acknowledged = False
        self.heard()

    def _operate(self, word: int, rising: int) -> None:
        mode = self.values["mode"]
        if mode == MODE_PROFILE_VELOCITY:
            self._follow_rate()
        elif mode == MODE_HOMING and rising & 0x10:
            self._homed, self._homing = False, True
            self._table.seek_home(self._axis, self.values["homing_rate_1"] * TURN)
        elif mode == MODE_PROFILE_POSITION:
            if rising & 0x10:
                self._acknowledged = True
                self._table.move_encoder(
                    self._axis,
                    self.values["target_position"],
                    self.values["profile_rate"] * TURN,
                    self.values["acceleration"] * TURN,
                )
            elif not word & 0x10:
                self._acknowledged = False

    def _follow_rate(self) -> None:
        if self._state is DriveState.OPERATION_ENABLED:
            motion = self._table.motion[self._axis]
            motion.jog(self._table.clock(), self.values["target_rate"] * TURN, self.values["acceleration"] * TURN)

    def _release(self, state: DriveState) -> None:
        """Leave operation: an axis that turns brakes along its ramp."""
        if self._table.rate_rps(self._axis):
            self._table.stop(self._axis)
        self._state = state
        self._homing = False

    def _update(self) -> None:
        """Let what has happened since the last look take effect."""
        motion = self._table.motion[self._axis]
        settled = motion.settled(self._table.clock())
        if self._axis in self._table.tripped:
            self._state = DriveState.FAULT if settled else DriveState.FAULT_REACTION
            self._homing = False
        if self._homing and settled:
            self._homing, self._homed = False, True
            self._table.zero_encoder(self._axis)

    def _statusword(self) -> int:
        word = self._state.value[1] | VOLTAGE_ENABLED
        mode = self.values["mode"]
        settled = self._table.motion[self._axis].settled(self._table.clock())
        if settled and not self._homing:
            word |= TARGET_REACHED
        if mode == MODE_HOMING:
            word |= BIT_12 if self._homed else 0
        elif mode == MODE_PROFILE_POSITION:
            word |= BIT_12 if self._acknowledged else 0
        elif self._table.rate_rps(self._axis) == 0.0:
            word |= BIT_12
        return word

    def _check_silence(self) -> None:
        self._watching = False
        if self._state is not DriveState.OPERATION_ENABLED:
            return
        remaining = self._last_heard_s + self._watchdog_s - self._table.clock()
        if remaining > 1e-9:
            self._watching = True
            asyncio.get_running_loop().call_later(remaining, self._check_silence)
        else:
            self._release(DriveState.SWITCH_ON_DISABLED)
