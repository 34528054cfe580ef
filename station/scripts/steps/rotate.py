"""A step that turns at a rate."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from drivers.specs import Key
from drivers.types import AxisLimits
from station.errors import sentence
from station.scripts.steps.kind import (
    ACCELERATION,
    AXIS,
    Demand,
    Part,
    Step,
    StepKind,
    Turn,
    driven_acceleration,
    with_comment,
)

_RAMPS_OF_A_HALF = 3.0  # a turn that is halved lasts at least so many of its ramps; one of two has no steady part


@dataclass(frozen=True, slots=True)
class Rotate(Step):
    """Turn at a rate for a time, both ramps included; negative rates turn backwards."""

    axis: str
    rate_rps: float
    duration_s: float
    acceleration_rps2: float
    label: str

    @property
    def turn_rad(self) -> float:
        """Angle of the rotation, with its sign."""
        return self.rate_rps * (self.duration_s - abs(self.rate_rps) / self.acceleration_rps2)

    def words(self) -> str:
        """Return axis and rate."""
        return f"{self.axis} at {math.degrees(self.rate_rps):g} deg/s"

    def demands(self) -> Sequence[Demand]:
        """Return rate and acceleration of the axis."""
        return (Demand(self.axis, self.rate_rps, self.acceleration_rps2),)

    def problem(self) -> str:
        """Return in words that the duration is too short for both ramps, "" if it is not."""
        ramp_s = abs(self.rate_rps) / self.acceleration_rps2
        if self.duration_s > 2 * ramp_s:
            return ""
        return sentence("script.too_short", length_s=self.duration_s, ramp_s=ramp_s)

    def driven(self, limits: Mapping[str, AxisLimits]) -> "Rotate":
        """Return a rotation by the same angle at the same rate with the controller's acceleration."""
        if not limits[self.axis].acceleration_step_rps2:
            return self
        acceleration_rps2 = driven_acceleration(self.acceleration_rps2, self.axis, limits[self.axis])
        duration_s = abs(self.turn_rad / self.rate_rps) + abs(self.rate_rps) / acceleration_rps2
        return replace(self, acceleration_rps2=acceleration_rps2, duration_s=duration_s)

    def parts(self, angles_rad: Mapping[str, float]) -> Sequence[Part]:
        """Return one part: the turn by the angle of the trapezoid, from where the axis stands.

        That is its angle in ``angles_rad``, else 0.
        """
        from_rad = angles_rad.get(self.axis, 0.0)
        turn = Turn(
            axis=self.axis,
            from_rad=from_rad,
            to_rad=from_rad + self.turn_rad,
            rate_rps=self.rate_rps,
            acceleration_rps2=self.acceleration_rps2,
            duration_s=self.duration_s,
        )
        return (Part.turning(turn),)

    def halved(self, limits: Mapping[str, AxisLimits]) -> "Rotate | None":
        """Return a rotation of half the time, None if that is less than three of its ramps.

        Ramps of half the length make half of the turn: an even number of full turns stays whole. If the axis cannot
        accelerate that fast, the turn is smaller. The label is made anew from the values.
        """
        duration_s = 0.5 * self.duration_s
        acceleration_rps2 = min(2 * self.acceleration_rps2, limits[self.axis].acceleration_rps2)
        if duration_s < _RAMPS_OF_A_HALF * abs(self.rate_rps) / acceleration_rps2:
            return None
        return replace(self, duration_s=duration_s, acceleration_rps2=acceleration_rps2, label=self.words())

    def mirrored(self, sign: int) -> "Rotate":
        """Return the rotation at the rate times ``sign``."""
        mirrored = replace(self, rate_rps=sign * self.rate_rps)
        return replace(mirrored, label=mirrored.words())

    def written(self, duration_s: float) -> Sequence[str]:
        """Return the lines of a script file for this step, with ``duration_s`` as its duration.

        The angle of the step is told in a comment.
        """
        return (
            'kind = "rotate"',
            f'axis = "{self.axis}"',
            f'rate = "{math.degrees(self.rate_rps):.10g} deg/s"',
            with_comment(
                f'duration = "{duration_s:.10g} s"', f"ramps included; turns {math.degrees(self.turn_rad):.1f} deg"
            ),
            f'acceleration = "{math.degrees(self.acceleration_rps2):.10g} deg/s2"',
        )


SPEC = StepKind(
    name="rotate",
    what="turn at a rate for a time",
    keys=(
        AXIS,
        Key(name="rate", kind="rate", doc="rate; negative rates turn backwards", required=True, field="rate_rps"),
        Key(name="duration", kind="time", doc="duration, including both ramps", required=True, field="duration_s"),
        ACCELERATION,
    ),
    make=Rotate,
)
