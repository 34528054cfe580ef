"""A step that goes to an angle."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from drivers.specs import Key
from drivers.types import AxisLimits
from station.scripts.steps.kind import (
    ACCELERATION,
    AXIS,
    Demand,
    Part,
    Step,
    StepKind,
    driven_acceleration,
    turn_to,
    with_comment,
)


@dataclass(frozen=True, slots=True)
class Move(Step):
    """Go to an angle from home and stop there. The sign of the rate is ignored."""

    axis: str
    angle_rad: float
    rate_rps: float
    acceleration_rps2: float
    label: str

    def words(self) -> str:
        """Return axis and angle."""
        return f"{self.axis} to {math.degrees(self.angle_rad):g} deg"

    def demands(self) -> Sequence[Demand]:
        """Return rate and acceleration of the axis."""
        return (Demand(self.axis, self.rate_rps, self.acceleration_rps2),)

    def driven(self, limits: Mapping[str, AxisLimits]) -> "Move":
        """Return the move with the controller's acceleration."""
        acceleration_rps2 = driven_acceleration(self.acceleration_rps2, self.axis, limits[self.axis])
        return replace(self, acceleration_rps2=acceleration_rps2)

    def parts(self, angles_rad: Mapping[str, float]) -> Sequence[Part]:
        """Return one part, the turn to the angle; it takes no time if the axis is there already."""
        from_rad = angles_rad.get(self.axis, 0.0)
        turn = turn_to(self.axis, from_rad, self.angle_rad, self.rate_rps, self.acceleration_rps2)
        return (Part.turning(turn),)

    @property
    def ends_at_stated_angles(self) -> bool:
        """True: the angle is one from home."""
        return True

    def halved(self, limits: Mapping[str, AxisLimits]) -> "Move":
        """Return the move unchanged: it cannot be done in half of the time."""
        return self

    def mirrored(self, sign: int) -> "Move":
        """Return the move to the angle times ``sign``."""
        mirrored = replace(self, angle_rad=sign * self.angle_rad)
        return replace(mirrored, label=mirrored.words())

    def written(self, duration_s: float) -> Sequence[str]:
        """Return the lines of a script file for this step; ``duration_s`` is told in a comment."""
        return (
            'kind = "move"',
            f'axis = "{self.axis}"',
            f'rate = "{math.degrees(self.rate_rps):.10g} deg/s"',
            with_comment(f'angle = "{math.degrees(self.angle_rad):.10g} deg"', f"from home; takes {duration_s:.2f} s"),
            f'acceleration = "{math.degrees(self.acceleration_rps2):.10g} deg/s2"',
        )


def _make(*, axis: str, angle_rad: float, rate_rps: float, acceleration_rps2: float, label: str) -> Move:
    """Return a move of a script file, which may state the rate with a sign."""
    return Move(axis, angle_rad, abs(rate_rps), acceleration_rps2, label)


SPEC = StepKind(
    name="move",
    what="go to an angle",
    keys=(
        AXIS,
        Key(name="angle", kind="angle", doc="angle from home", required=True, field="angle_rad"),
        Key(name="rate", kind="rate", doc="rate", required=True, field="rate_rps"),
        ACCELERATION,
    ),
    make=_make,
)
