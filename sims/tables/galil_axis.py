"""One axis of the twin of a Galil controller: its settings, its motion, its switches and stop code."""

import math

from drivers.packaged import packaged_toml
from drivers.tables.galil import language as galil
from sims.physics.table import FOLLOWING_ERROR, SAFE_TORQUE_OFF, TableModel
from sims.wires.line_controller import Refused

TURN = 2 * math.pi
_LARGEST_COUNT = 2**31 - 1
_SETTINGS: dict[str, tuple[float, float, float]] = packaged_toml("sims", "codes.toml")["galil"]["axis"]


class GalilAxisTwin:
    """One axis. Values are in counts, counts/s and counts/s2, as in the language."""

    def __init__(self, table: TableModel, axis: str, velocity_window_s: float) -> None:
        """Start with the motor off and settings as delivered; TV reports a mean over ``velocity_window_s``."""
        self._table, self._axis, self._window_s = table, axis, velocity_window_s
        self._per_turn = table.data[axis].counts_per_turn
        self._offset = 0
        self._mode = "PA"
        self._stood = 0  # where the last motion stopped, which PA reports
        self._way = 0  # direction of the motion under way
        self._end = galil.AT_TARGET  # stop code when the motion under way has ended
        self._stop_code = galil.AT_TARGET
        self._moving = False
        self.motor_off = True
        self._settings = {word: delivered for word, (delivered, _, _) in _SETTINGS.items()}

    def update(self) -> None:
        """Apply events since the last call: limit switches, trips, and the end of a motion.

        A limit switch that was hit for a moment stops the motion with the motor on; any other trip switches the motor
        off. A pressed switch in the direction of motion brakes.
        """
        motion, now = self._table.motion[self._axis], self._table.clock()
        pressed = self._table.pressed.get(self._axis, 0)
        reason = self._table.tripped.get(self._axis)
        if reason is not None and reason.startswith("limit switch"):
            # A switch that was hit for a moment: a Galil stops, keeps the motor on, and forgets nothing.
            del self._table.tripped[self._axis]
            self._moving, self._stop_code = False, galil.REVERSE_LIMIT if self._way < 0 else galil.FORWARD_LIMIT
        elif reason is not None and not self.motor_off:
            self.motor_off, self._moving = True, False
            codes = {FOLLOWING_ERROR: galil.OFF_ON_ERROR, SAFE_TORQUE_OFF: galil.ABORT_INPUT}
            self._stop_code = codes.get(reason, galil.AMPLIFIER_FAULT)
        if self._moving and pressed and pressed == self._way and self._end not in galil.LIMIT_STOPS:
            self._end = galil.FORWARD_LIMIT if pressed > 0 else galil.REVERSE_LIMIT
            self._brake(self._table.data[self._axis].max_acceleration_rps2)
        if self._moving and motion.settled(now) and (self._mode != "JG" or self._end != galil.AT_TARGET):
            self._moving, self._stop_code = False, self._end

    def get(self, word: str) -> float:
        """Return the value that a command or operand reports, in counts and counts/s; Refused for an unknown one.

        TV is a mean over the window of velocity, TE one more than its limit once the following error has tripped, else
        0. PA is where the last motion stopped while the axis moves, else where it stands. TD and TT are 0; a setting
        has what was set.
        """
        if word in ("TP", "DP"):
            return self._position()
        if word == "TV":
            now = self._table.clock()
            motion, rate_rps = self._table.motion[self._axis], self._table.rate_rps(self._axis)
            mean_rps = (motion.at(now)[0] - motion.at(now - self._window_s)[0]) / self._window_s
            return (mean_rps + self._table.read_rate_rps(self._axis) - rate_rps) / TURN * self._per_turn
        if word == "TE":
            lost = self._table.tripped.get(self._axis) == FOLLOWING_ERROR
            return self._settings["ER"] + 1 if lost else 0
        state: dict[str, float] = {
            "TS": self._switches(),
            "SC": self._stop_code,
            "BG": int(self._moving),
            "MO": int(self.motor_off),
            "PA": self._stood if self._moving else self._position(),
        }
        state |= {"TD": 0, "TT": 0.0}  # no dual encoders; torque is not simulated
        if word in state:
            return state[word]
        if word not in self._settings:
            raise Refused(galil.UNRECOGNIZED)
        return self._settings[word]

    def set(self, word: str, value: float) -> None:
        """Set a value, rounded as the controller does; a jog in progress follows at once.

        PA, PR and JG also select the kind of the next motion. DP defines the position and stores nothing else. Refused
        if the value is out of range, for PA, PR and DP during a motion, and for JG during one that is no jog.
        """
        if word in ("PA", "PR", "DP") and self._moving:
            raise Refused(galil.NOT_WHILE_RUNNING)
        if word == "JG" and self._moving and self._mode != "JG":
            raise Refused(galil.NOT_JOGGING)
        _, low, high = _SETTINGS.get(word, (0, -_LARGEST_COUNT - 1, _LARGEST_COUNT))
        if not low <= value <= high:
            raise Refused(galil.OUT_OF_RANGE)
        if word in ("AC", "DC"):
            value = galil.floor_acceleration(value)
        elif word == "SP":
            value = int(value) // 2 * 2 or 2  # in steps of two
        elif word == "JG":
            value = int(value)
        if word == "DP":
            self._table.zero_encoder(self._axis)
            self._offset = round(value)
            return
        self._settings[word] = value
        if word in ("PA", "PR", "JG"):
            self._mode = word
        if word == "JG" and self._moving:
            self._jog()

    def act(self, word: str) -> None:
        """Carry out ST, MO or SH, or store any other word, HM or FI, as the kind of the next motion.

        Refused during a motion, except ST. ST at rest does nothing, nor does SH while the axis turns or the interlock
        is open; otherwise SH clears a trip.
        """
        if word == "ST":
            if self._moving:
                self._end = galil.STOPPED
                self._brake(self._to_rad(self._settings["DC"]))
            return
        if self._moving:
            raise Refused(galil.NOT_WHILE_RUNNING)
        if word == "MO":
            self.motor_off = True
        elif word == "SH":
            if self._table.rate_rps(self._axis) == 0.0 and not self._table.interlock_open:
                self._table.tripped.pop(self._axis, None)
                self.motor_off = False
        else:
            self._mode = word

    def check_begin(self) -> None:
        """Raise Refused if a motion cannot begin: motor off, moving already, or on a limit switch in that direction."""
        if self.motor_off:
            raise Refused(galil.MOTOR_OFF)
        if self._moving:
            raise Refused(galil.RUNNING)
        pressed = self._table.pressed.get(self._axis, 0)
        if pressed and pressed == self._direction():
            raise Refused(galil.ON_LIMIT)

    def begin(self) -> None:
        """Start the motion that was set up: jog, homing, index search, or a move limited by the soft limits.

        Whether it may begin is checked by ``check_begin``, not here.
        """
        self._stood = self._position()
        self._way, self._moving, self._stop_code, self._end = self._direction(), True, 0, galil.AT_TARGET
        acceleration = self._to_rad(self._settings["AC"])
        motion, now = self._table.motion[self._axis], self._table.clock()
        if self._mode == "JG":
            self._jog()
        elif self._mode == "HM":
            self._end = galil.HOMED
            self._table.seek_home(self._axis, self._to_rad(self._settings["SP"]))
        elif self._mode == "FI":
            self._end = galil.HOMED
            turns = motion.at(now)[0] / TURN
            pulse = math.ceil(turns) if self._way > 0 else math.floor(turns)
            motion.move(now, pulse * TURN, self._to_rad(abs(self._settings["JG"])), acceleration)
        else:
            target = self._settings["PA"] if self._mode == "PA" else self._position() + self._settings["PR"]
            self._go(self._within_soft_limits(target), self._settings["SP"])

    def abort(self) -> None:
        """Brake with full torque, not along the ramp; the motor goes off if off-on-error is set."""
        if self._moving:
            self._moving, self._stop_code = False, galil.ABORTED
        self._table.stop(self._axis)
        self.motor_off |= bool(self._settings["OE"])

    def power_down(self) -> None:
        """Brake along the ramp and switch the motor off."""
        if self._moving:
            self._brake(self._to_rad(self._settings["DC"]))
            self._moving, self._stop_code = False, galil.STOPPED
        self.motor_off = True

    def _jog(self) -> None:
        """Turn at the rate of JG, up to the soft limit in that direction if one is set.

        The stop code is then that of the limit.
        """
        rate = self._settings["JG"]
        self._way = int(math.copysign(1, rate)) if rate else 0
        limit = self._settings["FL"] if rate > 0 else self._settings["BL"]
        if abs(limit) < _LARGEST_COUNT and rate:
            self._end = galil.FORWARD_LIMIT if rate > 0 else galil.REVERSE_LIMIT
            self._go(limit, abs(rate))
        else:
            motion = self._table.motion[self._axis]
            motion.jog(self._table.clock(), self._to_rad(rate), self._to_rad(self._settings["AC"]))

    def _within_soft_limits(self, target: float) -> float:
        """Return ``target``, in counts, limited to the soft limits.

        A limited one changes the stop code to be reported at the end.
        """
        if target > self._settings["FL"]:
            self._end = galil.FORWARD_LIMIT
            return self._settings["FL"]
        if target < self._settings["BL"]:
            self._end = galil.REVERSE_LIMIT
            return self._settings["BL"]
        return target

    def _go(self, counts: float, rate: float) -> None:
        turns = (counts - self._offset) / self._per_turn
        self._table.move_encoder(self._axis, turns, self._to_rad(rate), self._to_rad(self._settings["AC"]))

    def _brake(self, deceleration_rps2: float) -> None:
        self._table.motion[self._axis].stop(self._table.clock(), deceleration_rps2)

    def _direction(self) -> int:
        """Return the direction of the motion that is set up: 1, -1, or 0 if there is nothing to go.

        Homing goes to the nearest home, an index search in the direction of JG.
        """
        if self._mode == "PA":
            way = self._settings["PA"] - self._position()
        elif self._mode == "HM":
            way = -math.remainder(self._table.motion[self._axis].at(self._table.clock())[0], TURN)
        else:
            way = self._settings["PR" if self._mode == "PR" else "JG"]
        return int(math.copysign(1, way)) if way else 0

    def _switches(self) -> int:
        """Return the TS word; the home input is low in the first half of a turn."""
        pressed = self._table.pressed.get(self._axis, 0)
        lost = self._table.tripped.get(self._axis) == FOLLOWING_ERROR
        beyond_home = math.sin(self._table.motion[self._axis].at(self._table.clock())[0]) < 0
        bits = (self._moving, lost, self.motor_off, False, pressed <= 0, pressed >= 0, beyond_home, True)
        return sum(bit << 7 - place for place, bit in enumerate(bits))

    def _position(self) -> int:
        return round(self._table.encoder_turns(self._axis) * self._per_turn) + self._offset

    def _to_rad(self, counts: float) -> float:
        return counts / self._per_turn * TURN
