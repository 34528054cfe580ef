"""The table as a thing of metal: axes, encoders, a fault input; one model under every protocol."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from drivers.types import Floats
from sims.physics.hidden.table import TableFaults
from sims.physics.motion import AxisMotion

FOLLOWING_ERROR = "following error"  # reason of a trip by which the servo itself gives up
SAFE_TORQUE_OFF = "safe torque off"  # of one by an open interlock


@dataclass(frozen=True, slots=True)
class AxisData:
    """The rated values of an axis, and its angle at power-on."""

    max_rate_rps: float
    max_acceleration_rps2: float
    counts_per_turn: int
    start_angle_rad: float = 0.0


class TableModel:
    """The axes x, y, z that the table has; angles are true angles from the mechanical home position.

    With ``faults`` an axis moves by what its encoder indicates; then only ``angles`` are true.
    """

    def __init__(
        self,
        axes: Mapping[str, AxisData],
        clock: Callable[[], float],
        faults: TableFaults | None = None,
        started_s: float = 0.0,
    ) -> None:
        """Start at rest, each axis at its start angle, where its encoder reads 0.

        ``clock`` gives seconds; ``started_s`` is the bench clock, which ``faults`` follow, when it is at 0.
        """
        faults = faults or TableFaults()
        self.clock = clock
        self.data = dict(axes)
        self.motion = {
            name: AxisMotion(data.start_angle_rad, data.max_rate_rps, data.max_acceleration_rps2)
            for name, data in axes.items()
        }
        self._true = {name: faults.true_angles(name, motion.angles, started_s) for name, motion in self.motion.items()}
        self.read = {name: faults.read(name, motion.at, started_s) for name, motion in self.motion.items()}
        """Angle from the mechanical home position (rad) and rate (rad/s) as they are read, by axis, at an instant."""
        self.tripped: dict[str, str] = {}
        self.interlock_open = False
        self.pressed: dict[str, int] = {}  # limit switches: 1 forward, -1 reverse
        # Encoders count from where they were switched on until a homing run zeroes them at home.
        self._zero = {name: data.start_angle_rad for name, data in axes.items()}

    def angles(self, axis: str, t_s: Floats) -> Floats:
        """Return the true angles of an axis; an axis that the table lacks stays at zero."""
        return self._true[axis](t_s) if axis in self._true else np.zeros(len(t_s))

    def revision(self) -> int:
        """Return a number that changes with every command to an axis."""
        return sum(motion.revision for motion in self.motion.values())

    def encoder_turns(self, axis: str) -> float:
        """Return the current encoder reading, a whole number of counts, in turns."""
        counts = self.data[axis].counts_per_turn
        angle = self.read[axis](self.clock())[0] - self._zero[axis]
        return math.floor(angle / (2 * math.pi) * counts + 0.5) / counts

    def read_rate_rps(self, axis: str) -> float:
        """Return the rate that an axis's drive reports now."""
        return self.read[axis](self.clock())[1]

    def freeze_readings(self, axis: str, *, angle: bool = True, rate: bool = True, zero: bool = False) -> None:
        """Freeze the readings of an axis for good, its angle, its rate or both; the axis itself moves on.

        They stay at the present values, or with ``zero`` at those of home and standstill.
        """
        read, home_rad = self.read[axis], self._zero[axis]
        held_rad, held_rps = (home_rad, 0.0) if zero else read(self.clock())

        def frozen(t_s: float) -> tuple[float, float]:
            now_rad, now_rps = read(t_s)
            return held_rad if angle else now_rad, held_rps if rate else now_rps

        self.read[axis] = frozen

    def rate_rps(self, axis: str) -> float:
        """Return the rate of an axis now."""
        return self.motion[axis].at(self.clock())[1]

    def at_rest(self) -> bool:
        """Return whether no axis turns."""
        return all(self.rate_rps(axis) == 0.0 for axis in self.motion)

    def move_encoder(self, axis: str, turns: float, rate_rps: float, acceleration_rps2: float) -> None:
        """Move until the encoder reads this many turns."""
        target = turns * 2 * math.pi + self._zero[axis]
        self.motion[axis].move(self.clock(), target, rate_rps, acceleration_rps2)

    def seek_home(self, axis: str, rate_rps: float) -> None:
        """Begin to turn to the nearest index pulse, which is at home once a turn, with the largest acceleration."""
        now = self.clock()
        angle = self.motion[axis].at(now)[0]
        home = 2 * math.pi * round(angle / (2 * math.pi))
        self.motion[axis].move(now, home, rate_rps, self.data[axis].max_acceleration_rps2)

    def zero_encoder(self, axis: str) -> None:
        """Let the encoder count from where the axis stands."""
        self._zero[axis] = self.motion[axis].at(self.clock())[0]

    def stop(self, axis: str) -> None:
        """Brake with the drive's full torque."""
        self.motion[axis].stop(self.clock(), self.data[axis].max_acceleration_rps2)

    def trip(self, axis: str, reason: str) -> None:
        """Set the fault input of an axis: it brakes by itself and its drive goes to fault."""
        self.tripped[axis] = reason
        self.stop(axis)

    def open_interlock(self) -> None:
        """Open the interlock, or press the emergency stop: every axis brakes, and no reset helps until it is closed."""
        self.interlock_open = True
        for axis in self.data:
            self.trip(axis, SAFE_TORQUE_OFF)

    def press_limit(self, axis: str, direction: int) -> None:
        """Press the limit switch of a direction, 1 or -1: an axis that turns that way brakes by itself."""
        self.pressed[axis] = direction
        if self.rate_rps(axis) * direction > 0:
            self.stop(axis)
