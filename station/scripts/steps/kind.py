"""The base of all steps of a script, and the record of a kind of steps.

A kind is one module that holds a class of steps and its record, ``SPEC``; ``station.scripts.steps.registry`` names it.
Nothing else knows a kind: the station asks a step what it demands of the axes, how it moves them and for how long.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, Self

from drivers.specs import Key
from drivers.types import AxisLimits
from station.errors import ScriptError, sentence

_SAME = 1e-9  # relative; nearer accelerations count as equal
_COMMENTS = 44  # the column of comments in a script file

AXIS = Key(name="axis", kind="text", doc="axis", required=True, one_of=("x", "y", "z"))
ACCELERATION = Key(
    name="acceleration",
    kind="acceleration",
    doc="acceleration of the ramps",
    default="20 deg/s2",
    field="acceleration_rps2",
)
LABEL = Key(name="label", kind="text", doc="text shown to the operator; default: from the other keys")
"""A key of every kind; no record lists it."""


@dataclass(frozen=True, slots=True)
class Span:
    """Least and most duration, in s; equal where it is known in advance.

    ``most_s`` is infinite where there is no limit.
    """

    least_s: float
    most_s: float

    @classmethod
    def exactly(cls, duration_s: float) -> Self:
        """Return a span of exactly this duration."""
        return cls(duration_s, duration_s)

    @property
    def is_exact(self) -> bool:
        """Whether the duration is known in advance."""
        return self.least_s == self.most_s

    @property
    def longer_s(self) -> float:
        """Difference between the longest and the least duration."""
        return 0.0 if self.is_exact else self.most_s - self.least_s

    def elapsed_s(self, since_s: float) -> float:
        """Return how much of the time since the beginning counts as done: never more than it may take."""
        return min(since_s, self.most_s)

    def remaining(self, since_s: float) -> "Span":
        """Return what is left after ``since_s``."""
        return Span(max(self.least_s - since_s, 0.0), max(self.most_s - since_s, 0.0))


def total(spans: Sequence[Span]) -> Span:
    """Return the span of all of these, one after the other."""
    return Span(sum(span.least_s for span in spans), sum(span.most_s for span in spans))


@dataclass(frozen=True, slots=True, kw_only=True)
class Turn:
    """A motion of one axis from standstill to standstill: two ramps, and a constant rate in between if it is reached.

    Angles are from home. ``rate_rps`` is that of the step, possibly negative for a turn backwards.
    """

    axis: str
    from_rad: float
    to_rad: float
    rate_rps: float
    acceleration_rps2: float
    duration_s: float

    @property
    def way_rad(self) -> float:
        """Angle of the turn, with its sign."""
        return self.to_rad - self.from_rad

    @property
    def ramp_s(self) -> float:
        """How long one of its ramps takes; a short way ends before the rate is reached."""
        to_rate_s = abs(self.rate_rps) / self.acceleration_rps2
        half_way_s = math.sqrt(abs(self.way_rad) / self.acceleration_rps2)
        return min(to_rate_s, half_way_s)


def turn_to(axis: str, from_rad: float, to_rad: float, rate_rps: float, acceleration_rps2: float) -> Turn:
    """Return the turn of an axis between two angles, with the duration of its trapezoid of rate; 0 if they are equal.

    A short way is a triangle that does not reach ``rate_rps``, of which the sign is ignored.
    """
    way_rad = abs(to_rad - from_rad)
    peak_rps = min(abs(rate_rps), math.sqrt(way_rad * acceleration_rps2))
    duration_s = way_rad / peak_rps + peak_rps / acceleration_rps2 if peak_rps > 0 else 0.0
    return Turn(
        axis=axis,
        from_rad=from_rad,
        to_rad=to_rad,
        rate_rps=rate_rps,
        acceleration_rps2=acceleration_rps2,
        duration_s=duration_s,
    )


@dataclass(frozen=True, slots=True)
class Part:
    """A part of the plan of a step: a turn, or standstill if it has none.

    The parts of a step with several are recorded singly; ``label`` is the purpose of a standstill.
    """

    span: Span
    turn: Turn | None = None
    label: str = ""

    @classmethod
    def turning(cls, turn: Turn) -> Self:
        """Return the part in which an axis turns."""
        return cls(Span.exactly(turn.duration_s), turn)

    @classmethod
    def standing(cls, least_s: float, most_s: float | None = None, label: str = "") -> Self:
        """Return a part in which all axes stand, of a known duration without ``most_s``."""
        return cls(Span(least_s, least_s if most_s is None else most_s), label=label)


@dataclass(frozen=True, slots=True)
class Demand:
    """The largest rate and the acceleration that a step demands of an axis, for comparison with its limits."""

    axis: str
    rate_rps: float
    acceleration_rps2: float


class Stage(Protocol):
    """The interface on which a step is carried out: a homed table, and values of the devices."""

    async def turn(self, turn: Turn) -> None:
        """Turn an axis and see it arrive; DeviceRefused if it does not."""

    async def stand(self, duration_s: float, label: str = "") -> None:
        """Leave all axes at rest for a time; ``label`` gives its purpose."""

    def newest(self, quantity: str) -> Mapping[str, float]:
        """Return the newest value of a quantity by source; sources that do not measure it are left out.

        The quantities are "temperature_c".
        """

    def tell(self, text: str) -> None:
        """Keep a sentence with the events of the run."""


class Step(ABC):
    """A step of a script. Subclasses are frozen dataclasses with a ``label`` and the fields of their keys."""

    __slots__ = ()

    label: str

    @abstractmethod
    def words(self) -> str:
        """Return the label of a step that was given none."""

    @abstractmethod
    def parts(self, angles_rad: Mapping[str, float]) -> Sequence[Part]:
        """Return the planned parts in order, from these angles of the axes; 0 for an axis that is not listed."""

    def demands(self) -> Sequence[Demand]:
        """Return the demands on each axis that the step turns; empty if all axes stand."""
        return ()

    def problem(self) -> str:
        """Return what is wrong with the step's values, for any table; empty if nothing."""
        return ""

    def driven(self, limits: Mapping[str, AxisLimits]) -> Self:
        """Return the step with the accelerations that the controller has (``driven_acceleration``)."""
        return self

    async def carry_out(self, stage: Stage, parts: Sequence[Part]) -> None:
        """Carry out the plan. A step whose duration is not known in advance decides here when it has ended."""
        for part in parts:
            if part.turn is None:
                await stage.stand(part.span.least_s, part.label)
            else:
                await stage.turn(part.turn)

    @property
    def turns(self) -> bool:
        """Whether it turns an axis."""
        return bool(self.demands())

    # The following methods serve the makers of scripts from other scripts. A kind can do without.

    @property
    def ends_at_stated_angles(self) -> bool:
        """Whether it states angles from home, so that a step before it cannot leave an axis whole turns away."""
        return False

    @property
    def rest_s(self) -> float:
        """Time at rest that may be shortened; 0 for steps that turn an axis."""
        return 0.0

    def shortened(self, share: float) -> "Step":
        """Return the step with this share of its ``rest_s``."""
        return self

    def halved(self, limits: Mapping[str, AxisLimits]) -> "Step | None":
        """Return a step that does the same in half of the time, None if there is none."""
        return None

    def mirrored(self, sign: int) -> "Step":
        """Return the step with its rate or its angle times ``sign``, and a label to match."""
        return self

    def written(self, duration_s: float) -> Sequence[str]:
        """Return the lines of a script file for this step, without its label; the step takes ``duration_s``."""
        raise NotImplementedError(f"{type(self).__name__} steps are not written into files")


@dataclass(frozen=True, slots=True, kw_only=True)
class StepKind:
    """A kind of steps.

    ``what`` describes it in a few words. ``keys`` are those in a script file besides ``kind`` and ``label``; ``make``
    gets their values by field and a ``label``, and returns the step: usually it is the class.
    """

    name: str
    what: str
    keys: Sequence[Key]
    make: Callable[..., Step]


def with_comment(text: str, comment: str) -> str:
    """Return a line of a script file with a comment behind it."""
    return f"{text:<{_COMMENTS}}# {comment}"


def driven_acceleration(acceleration_rps2: float, axis: str, limit: AxisLimits) -> float:
    """Return the acceleration rounded down to the controller's step, at least one step; unchanged without one.

    ScriptError if the step is larger than the limit of the axis.
    """
    quantum = limit.acceleration_step_rps2
    if not quantum:
        return acceleration_rps2
    if quantum > limit.acceleration_rps2:
        least_dps2 = quantum / math.radians(1)
        most_dps2 = limit.acceleration_rps2 / math.radians(1)
        raise ScriptError(sentence("script.coarse", axis=axis, least_dps2=least_dps2, most_dps2=most_dps2))
    return max(math.floor(acceleration_rps2 / quantum * (1 + _SAME)), 1) * quantum
