"""Twin of an Ideal Aerosmith table with one axis, as far as public programs show its language. EXPERIMENTAL.

The bits of STA are its own, since nobody tells the real ones.
"""

import math
import re
from collections.abc import Callable

from sims.wires.line_controller import LineController, TableTwinSetup

STA_MOVING, STA_FAULT, STA_SERVO_OFF, STA_FORWARD_LIMIT, STA_REVERSE_LIMIT = 1, 2, 4, 8, 16

_COMMAND = re.compile(r"([A-Z]{3})([-+]?\d+(?:\.\d*)?)?")


class AerosmithController(LineController):
    """A controller of one axis; a line ends with CR."""

    def __init__(self, setup: TableTwinSetup, write: Callable[[bytes], None]) -> None:
        """Start with the servo off, at the largest rate and acceleration of the one axis."""
        super().__init__(setup, write)
        self._table, (self._axis,) = setup.table, setup.addresses
        self._servo_on = False
        self._faulty = False
        self._held_prompt = False
        self._homing = False
        data = self._table.data[self._axis]
        self._most_dps, self._most_dps2 = math.degrees(data.max_rate_rps), math.degrees(data.max_acceleration_rps2)
        self._velocity_dps, self._acceleration_dps2 = self._most_dps, self._most_dps2

    def _is_powered(self) -> bool:
        return self._servo_on

    def _take(self, line: bytes) -> None:
        """Carry out a line and send its answer and the prompt; a jog's prompt is held back until the next line.

        Unknown lines are answered with "?".
        """
        self._update()
        if self._held_prompt:
            self._held_prompt = False
            self._write(b">\r\n")
        found = _COMMAND.fullmatch(line.decode("ascii", "replace").strip())
        text = self._carry_out(found[1], float(found[2] or 0.0)) if found else "?"
        if text is None:
            self._held_prompt = True
        else:
            self._write(f"{text}\r\n>".encode() if text else b">")

    def _carry_out(self, word: str, value: float) -> str | None:
        """Carry out a command and return the answer: a value, "" without one, "?" for a refusal or an unknown command.

        None for a jog, whose prompt is held back. PPO (deg), PVE (deg/s) and STA ask; VEL and ACL set limits; SRV is
        the servo, on for 1 only; STO brakes, ZER zeroes the encoder, and the others move.
        """
        if word == "PPO":
            return f"{self._table.encoder_turns(self._axis) * 360.0:.4f}"
        if word == "PVE":
            return f"{math.degrees(self._table.read_rate_rps(self._axis)):.4f}"
        if word == "STA":
            return str(self._status())
        if word in ("VEL", "ACL"):
            return self._set(word, value)
        if word == "SRV":
            self._switch(value == 1.0)
        elif word == "STO":
            self._homing = False
            self._brake(self._acceleration_dps2)
        elif word == "ZER":
            self._table.zero_encoder(self._axis)
        elif word in ("JOG", "MOV", "RMO", "HOM"):
            return self._move(word, value)
        else:
            return "?"
        return ""

    def _set(self, word: str, value: float) -> str:
        """Set the velocity (``word`` VEL, deg/s), or else the acceleration (deg/s2); return "".

        Return "?" and set nothing unless the value is above 0 and at most 0.1 % above the rated one.
        """
        if not 0.0 < value <= (self._most_dps if word == "VEL" else self._most_dps2) * 1.001:
            return "?"
        if word == "VEL":
            self._velocity_dps = value
        else:
            self._acceleration_dps2 = value
        return ""

    def _move(self, word: str, value: float) -> str | None:
        """Start a jog at ``value`` deg/s, a move to (MOV) or by (RMO) that many deg, or, with ``word`` HOM, homing.

        Returns "?" if refused, None for a jog, whose prompt is held back, else "". All are refused with the servo off,
        a jog also if it is too fast, no whole number of deg/s, or towards a pressed limit switch. VEL and ACL limit
        moves. All but refused ones end a homing under way, as does a jog refused because of a switch.
        """
        if not self._servo_on or (word == "JOG" and (abs(value) > self._most_dps * 1.001 or value % 1.0)):
            return "?"
        motion, now = self._table.motion[self._axis], self._table.clock()
        self._homing = False
        acceleration = math.radians(self._acceleration_dps2)
        if word == "JOG":
            if value * self._table.pressed.get(self._axis, 0) > 0:
                return "?"
            motion.jog(now, math.radians(value), acceleration)
            return None
        if word == "HOM":
            self._table.seek_home(self._axis, math.radians(self._velocity_dps))
            self._homing = True
            return ""
        start = self._table.encoder_turns(self._axis) if word == "RMO" else 0.0
        self._table.move_encoder(self._axis, start + value / 360.0, math.radians(self._velocity_dps), acceleration)
        return ""

    def _switch(self, on: bool) -> None:
        """Switch the servo on, which clears faults and trips, or brake and switch it off, which ends homing."""
        if on:
            self._table.tripped.pop(self._axis, None)
            self._faulty = False
        else:
            self._homing = False
            self._brake(self._most_dps2)
        self._servo_on = on

    def _update(self) -> None:
        if self._axis in self._table.tripped:
            self._faulty, self._servo_on, self._homing = True, False, False
        if self._homing and self._table.motion[self._axis].settled(self._table.clock()):
            self._homing = False
            self._table.zero_encoder(self._axis)

    def _status(self) -> int:
        """Return the status word STA: moving, fault, servo off, limit switches."""
        pressed = self._table.pressed.get(self._axis, 0)
        return (
            STA_MOVING * (self._table.rate_rps(self._axis) != 0.0)
            + STA_FAULT * self._faulty
            + STA_SERVO_OFF * (not self._servo_on)
            + STA_FORWARD_LIMIT * (pressed > 0)
            + STA_REVERSE_LIMIT * (pressed < 0)
        )

    def _brake(self, deceleration_dps2: float) -> None:
        if self._table.rate_rps(self._axis):
            self._table.motion[self._axis].stop(self._table.clock(), math.radians(deceleration_dps2))

    def _master_is_silent(self) -> None:
        self._update()
        self._switch(False)
