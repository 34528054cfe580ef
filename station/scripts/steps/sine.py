"""A step in which one axis swings to and fro."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from drivers.specs import Key
from drivers.types import AxisLimits
from station.scripts.steps.kind import AXIS, Demand, Part, Step, StepKind, driven_acceleration, turn_to


@dataclass(frozen=True, slots=True, kw_only=True)
class Sine(Step):
    """Swing about the present angle: turns from one end to the other, and back to the middle.

    Each turn is a trapezoid of rate with the largest rate of the sine, and lasts half a cycle. Its acceleration is 0.88
    times the largest one of the sine.
    """

    axis: str
    amplitude_rad: float
    rate_rps: float
    acceleration_rps2: float
    cycles: int
    label: str

    @property
    def frequency_hz(self) -> float:
        """Frequency of the sine with this amplitude and rate."""
        return self.rate_rps / (2 * math.pi * self.amplitude_rad)

    def words(self) -> str:
        """Return axis, amplitude and frequency."""
        return f"{self.axis} ±{math.degrees(self.amplitude_rad):g} deg at {self.frequency_hz:g} Hz"

    def demands(self) -> Sequence[Demand]:
        """Return the largest rate and the acceleration."""
        return (Demand(self.axis, self.rate_rps, self.acceleration_rps2),)

    def driven(self, limits: Mapping[str, AxisLimits]) -> "Sine":
        """Return the same swings with the controller's acceleration, which may take longer."""
        acceleration_rps2 = driven_acceleration(self.acceleration_rps2, self.axis, limits[self.axis])
        return replace(self, acceleration_rps2=acceleration_rps2)

    def parts(self, angles_rad: Mapping[str, float]) -> Sequence[Part]:
        """Return the turns: to the positive end and the negative one for each cycle, then to the middle.

        The middle is where the axis stands in ``angles_rad``, else 0.
        """
        middle_rad = angles_rad.get(self.axis, 0.0)
        ends_rad = [middle_rad + self.amplitude_rad, middle_rad - self.amplitude_rad] * self.cycles
        angle_rad = middle_rad
        parts = []
        for next_rad in (*ends_rad, middle_rad):
            turn = turn_to(self.axis, angle_rad, next_rad, self.rate_rps, self.acceleration_rps2)
            parts.append(Part.turning(turn))
            angle_rad = next_rad
        return parts


def _make(*, axis: str, amplitude_rad: float, frequency_hz: float, cycles: int, label: str) -> Sine:
    """Return a swing from the keys of a script file, with the largest rate of the sine.

    ``amplitude_rad`` is to each side. The acceleration makes each turn between the ends last half a cycle.
    """
    rate_rps = 2 * math.pi * frequency_hz * amplitude_rad
    half_cycle_s = 0.5 / frequency_hz
    ramp_s = half_cycle_s - 2 * amplitude_rad / rate_rps
    return Sine(
        axis=axis,
        amplitude_rad=amplitude_rad,
        rate_rps=rate_rps,
        acceleration_rps2=rate_rps / ramp_s,
        cycles=cycles,
        label=label,
    )


SPEC = StepKind(
    name="sine",
    what="swing to and fro about an axis",
    keys=(
        AXIS,
        Key(
            name="amplitude",
            kind="angle",
            doc="amplitude about the present angle",
            required=True,
            field="amplitude_rad",
            bound="above_zero",
        ),
        Key(
            name="frequency",
            kind="frequency",
            doc="cycles per second; limited by rate and acceleration of the axis",
            required=True,
            field="frequency_hz",
            bound="above_zero",
        ),
        Key(name="cycles", kind="integer", doc="number of cycles", required=True, bound="1 to 10000"),
    ),
    make=_make,
)
