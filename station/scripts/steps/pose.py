"""A step that goes to stated angles of the axes and rests there."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from drivers.specs import Key
from drivers.types import AxisLimits
from station.scripts.steps.kind import (
    ACCELERATION,
    Demand,
    Part,
    Step,
    StepKind,
    driven_acceleration,
    turn_to,
    with_comment,
)

_AXES = ("x", "y", "z")


@dataclass(frozen=True, slots=True)
class Aim:
    """The target angle of an axis from home, and its acceleration."""

    axis: str
    angle_rad: float
    acceleration_rps2: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Pose(Step):
    """Go to angles from home, one axis after the other, wait for ``settle_s``, and rest for ``duration_s``."""

    aims: tuple[Aim, ...]
    rate_rps: float
    settle_s: float
    duration_s: float
    label: str

    def words(self) -> str:
        """Return axes and angles."""
        angles = (f"{aim.axis} {math.degrees(aim.angle_rad):g}" for aim in self.aims)
        return f"pose {', '.join(angles)} deg"

    def demands(self) -> Sequence[Demand]:
        """Return rate and acceleration of each axis."""
        return [Demand(aim.axis, self.rate_rps, aim.acceleration_rps2) for aim in self.aims]

    def problem(self) -> str:
        """Return what is wrong: no axis is stated, or a time is not above zero or not finite; empty if nothing.

        The time to settle may be zero.
        """
        if not self.aims:
            return f"a pose states the angle of one axis or more: {', '.join(_AXES)}"
        if not (0 < self.duration_s < math.inf and 0 <= self.settle_s < math.inf):
            return f"a rest of {self.duration_s:g} s after {self.settle_s:g} s; give times above zero"
        return ""

    def driven(self, limits: Mapping[str, AxisLimits]) -> "Pose":
        """Return the pose with the accelerations that the controller has for each axis."""
        aims = []
        for aim in self.aims:
            acceleration_rps2 = driven_acceleration(aim.acceleration_rps2, aim.axis, limits[aim.axis])
            aims.append(replace(aim, acceleration_rps2=acceleration_rps2))
        return replace(self, aims=tuple(aims))

    def parts(self, angles_rad: Mapping[str, float]) -> Sequence[Part]:
        """Return a turn for each axis that is not there yet, the time to settle, and the rest."""
        return list(self._parts(angles_rad))

    def _parts(self, angles_rad: Mapping[str, float]) -> Iterator[Part]:
        """Yield a turn for each axis that is not at its angle, the settling time if any, and the rest."""
        for aim in self.aims:
            from_rad = angles_rad.get(aim.axis, 0.0)
            if from_rad != aim.angle_rad:
                turn = turn_to(aim.axis, from_rad, aim.angle_rad, self.rate_rps, aim.acceleration_rps2)
                yield Part.turning(turn)
        if self.settle_s:
            yield Part.standing(self.settle_s, label="settling")
        yield Part.standing(self.duration_s)

    @property
    def ends_at_stated_angles(self) -> bool:
        """True: the angles are from home."""
        return True

    def written(self, duration_s: float) -> Sequence[str]:
        """Return the lines of a script file for this step; ``duration_s`` with its moves is told in a comment.

        The acceleration is the least of all axes.
        """
        return (
            'kind = "pose"',
            *(f'{aim.axis} = "{math.degrees(aim.angle_rad):.10g} deg"' for aim in self.aims),
            f'rate = "{math.degrees(self.rate_rps):.10g} deg/s"',
            f'acceleration = "{math.degrees(min(aim.acceleration_rps2 for aim in self.aims)):.10g} deg/s2"',
            f'settle = "{self.settle_s:.10g} s"',
            with_comment(f'duration = "{self.duration_s:.10g} s"', f"of the rest; takes {duration_s:.2f} s in all"),
        )


def _make(
    *,
    rate_rps: float,
    acceleration_rps2: float,
    settle_s: float,
    duration_s: float,
    label: str,
    **angles_rad: float | None,
) -> Pose:
    """Return a pose from the keys of a script file; axes without an angle stay where they are."""
    aims = tuple(Aim(axis, angle, acceleration_rps2) for axis, angle in angles_rad.items() if angle is not None)
    return Pose(aims=aims, rate_rps=rate_rps, settle_s=settle_s, duration_s=duration_s, label=label)


SPEC = StepKind(
    name="pose",
    what="go to stated angles of the axes and rest there",
    keys=(
        *(Key(name=axis, kind="angle", doc=f"angle of {axis} from home; default: it stays") for axis in _AXES),
        Key(name="rate", kind="rate", doc="rate", required=True, field="rate_rps", bound="above_zero"),
        ACCELERATION,
        Key(
            name="settle",
            kind="time",
            doc="settling time before the rest counts",
            default="0 s",
            field="settle_s",
            bound="not_negative",
        ),
        Key(name="duration", kind="time", doc="duration of the rest", required=True, field="duration_s"),
    ),
    make=_make,
)
