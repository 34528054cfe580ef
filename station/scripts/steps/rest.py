"""A step in which the table stands still."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from drivers.specs import Key
from drivers.types import AxisLimits
from station.scripts.steps.kind import Part, Step, StepKind


@dataclass(frozen=True, slots=True)
class Rest(Step):
    """Stand still."""

    duration_s: float
    label: str = "rest"

    def words(self) -> str:
        """Return the name of the kind: all rests are alike."""
        return "rest"

    def problem(self) -> str:
        """Return what is wrong with the duration; empty if nothing."""
        if 0 < self.duration_s < math.inf:
            return ""
        return f"a rest of {self.duration_s:g} s. Give a time above zero"

    def parts(self, angles_rad: Mapping[str, float]) -> Sequence[Part]:
        """Return one part, the rest."""
        return (Part.standing(self.duration_s),)

    @property
    def rest_s(self) -> float:
        """All of its time."""
        return self.duration_s

    def shortened(self, share: float) -> "Rest":
        """Return a rest of this share of the time."""
        return replace(self, duration_s=share * self.duration_s)

    def halved(self, limits: Mapping[str, AxisLimits]) -> "Rest":
        """Return a rest of half the time."""
        return Rest(0.5 * self.duration_s)

    def written(self, duration_s: float) -> Sequence[str]:
        """Return the lines of kind and duration."""
        return (
            'kind = "rest"',
            f'duration = "{duration_s:.10g} s"',
        )


SPEC = StepKind(
    name="rest",
    what="stand still for a time",
    keys=(Key(name="duration", kind="time", doc="duration", required=True, field="duration_s"),),
    make=Rest,
)
