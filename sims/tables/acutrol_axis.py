"""One axis of the twin of an ACUTROL controller: interlock, mode, demands, limits."""

import math

from sims.physics.table import TableModel

TURN = 2 * math.pi

LIMITED_MODES = ("rate", "position", "synthesis")


class AclError(Exception):
    """A refusal; its text is the controller's answer."""


class AcutrolAxisTwin:
    """One axis; values are in deg, deg/s, deg/s2."""

    def __init__(self, table: TableModel, axis: str, wrapped: bool) -> None:
        """Start in mode off, with the interlock open and the rated limits in every mode.

        ``wrapped`` angles are reported within 0 to 360 deg.
        """
        self._table, self._axis, self._wrapped = table, axis, wrapped
        data = table.data[axis]
        self.most = {"rate": math.degrees(data.max_rate_rps), "acceleration": math.degrees(data.max_acceleration_rps2)}
        self.limits = {(quantity, mode): self.most[quantity] for quantity in self.most for mode in LIMITED_MODES}
        self.mode = "off"
        self.powered = False
        """Whether the interlock is closed."""
        self.faulty = False
        """Whether the interlock is in fault."""
        self._rate_demand = 0.0
        self._position_demand = 0.0

    def update(self) -> None:
        """Let a trip, or a limit switch pressed ahead, open the interlock: mode off, in fault, braking."""
        if self._axis in self._table.tripped or (self.powered and self._pressed_ahead()):
            self.faulty, self.powered, self.mode = True, False, "off"
            self._brake()

    def interlock(self, word: str) -> None:
        """Open or reset the interlock, or close it for any other word; AclError on closing in fault.

        Opening switches the axis off; a reset clears a trip, and the fault unless the table's interlock is open.
        """
        if word == "open":
            self.power_down()
        elif word == "reset":
            self._table.tripped.pop(self._axis, None)
            self.faulty = self._table.interlock_open
        elif self.faulty:
            raise AclError("Interlock fault")
        else:
            self.powered = True

    def enter(self, mode: str) -> None:
        """Change the mode; AclError for any but "off" with an open interlock.

        Rate mode follows the rate demand. Any other mode brakes, and takes the present angle as position demand.
        """
        if mode != "off" and not self.powered:
            raise AclError("Interlock not closed")
        self.mode = mode
        if mode == "rate":
            self._follow_rate()
        else:
            self._brake()
            self._position_demand = self.angle_deg()

    def demand(self, quantity: str, value: float) -> None:
        """Accept a demand for ``quantity``: rate, acceleration, delta or, for any other word, position; in deg and s.

        A rate acts at once in rate mode and is stored otherwise; an acceleration becomes the limit of rate mode. Delta
        and position start a move: delta is added to the demanded position, and to a position the axis turns by the
        shorter way if angles are wrapped. AclError for a rate more than 0.1 % beyond its limit, an acceleration that is
        not positive or more than 0.1 % beyond the absolute limit, a delta beyond 180 deg, and delta or position outside
        position mode.
        """
        if quantity == "rate":
            if abs(value) > self.limits["rate", "rate"] * 1.001:
                raise AclError("Demand exceeds limit")
            self._rate_demand = value
            if self.mode == "rate":
                self._follow_rate()
        elif quantity == "acceleration":
            self.set_limit("acceleration", "rate", value)
        elif self.mode != "position":
            raise AclError("Not in position mode")
        elif quantity == "delta":
            if abs(value) > 180.0:
                raise AclError("Demand exceeds limit")
            self._go(self._position_demand + value)
        else:
            way = value - self._position_demand
            self._go(self._position_demand + (math.remainder(way, 360.0) if self._wrapped else way))

    def demanded(self, quantity: str) -> float:
        """Return the present demand for rate, acceleration or position, this from 0 to 360 if the axis is wrapped.

        AclError for any other word, such as delta, which ends in a position.
        """
        if quantity == "rate":
            return self._rate_demand
        if quantity == "acceleration":
            return self.limits["acceleration", "rate"]
        if quantity == "position":
            return self._position_demand % 360.0 if self._wrapped else self._position_demand
        raise AclError("Command not recognized")

    def set_limit(self, quantity: str, mode: str, value: float) -> None:
        """Set a limit of a mode; AclError unless it is above 0 and at most 0.1 % beyond the absolute one."""
        if not 0.0 < value <= self.most[quantity] * 1.001:
            raise AclError("Value out of range")
        self.limits[quantity, mode] = value

    def angle_deg(self) -> float:
        """Return the angle of the absolute encoder in deg, in whole counts, over any number of turns."""
        counts = self._table.data[self._axis].counts_per_turn
        angle = self._table.read[self._axis](self._table.clock())[0]
        return math.floor(angle / TURN * counts + 0.5) / counts * 360.0

    def read(self, quantity: str) -> float:
        """Return the measured position (deg) or rate (deg/s), or for any other word the acceleration (deg/s2).

        The position is from 0 to 360 if the axis is wrapped.
        """
        if quantity == "position":
            return self.angle_deg() % 360.0 if self._wrapped else self.angle_deg()
        if quantity == "rate":
            return math.degrees(self._table.read_rate_rps(self._axis))
        motion, now = self._table.motion[self._axis], self._table.clock()
        return math.degrees(motion.at(now + 1e-6)[1] - motion.at(now)[1]) * 1e6

    def power_down(self) -> None:
        """Open the interlock: the drive brakes and lets go."""
        self._brake()
        self.powered, self.mode = False, "off"

    def _follow_rate(self) -> None:
        self._table.motion[self._axis].jog(
            self._table.clock(), math.radians(self._rate_demand), math.radians(self.limits["acceleration", "rate"])
        )

    def _go(self, angle_deg: float) -> None:
        """Set the position demand and start the move there, with the limits of position mode."""
        self._position_demand = angle_deg
        self._table.motion[self._axis].move(
            self._table.clock(),
            math.radians(angle_deg),
            math.radians(self.limits["rate", "position"]),
            math.radians(self.limits["acceleration", "position"]),
        )

    def _brake(self) -> None:
        if self._table.rate_rps(self._axis):
            self._table.stop(self._axis)

    def _pressed_ahead(self) -> bool:
        """Return whether the axis stands on a limit switch and is sent further on."""
        pressed = self._table.pressed.get(self._axis, 0)
        if self.mode == "rate":
            return self._rate_demand * pressed > 0
        return self.mode == "position" and (self._position_demand - self.angle_deg()) * pressed > 1e-3
