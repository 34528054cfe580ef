"""The family of scripts for a whole IMU: turns there and back, and rests in attitudes, with few open numbers.

Rests at both ends, and between them turns about each direction, once or several times. The attitudes come after the
turns, or between their repetitions. How long turns, rests in the attitudes and rests at the ends last is open.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from drivers.types import AxisLimits, Floats
from station.scripts.script import Script
from station.scripts.script_family import Way, moves, turn_rate
from station.scripts.steps.kind import Step, driven_acceleration
from station.scripts.steps.pose import Aim, Pose
from station.scripts.steps.rest import Rest
from station.scripts.steps.rotate import Rotate
from station.scripts.whole_imu.attitudes import Attitude

SETTLE_S = 1.0
_SHORTEST_TURN_S = 4.0
_USUAL_S = (20.0, 10.0)  # of a turn and of a rest, where a search starts
_TIME_STEP_S = 0.01  # to which times are rounded, as a person would write


def driven_limits(limits: Mapping[str, AxisLimits]) -> dict[str, AxisLimits]:
    """Return the limits with accelerations that the controller can set; ScriptError if an axis has none of these."""
    return {
        axis: replace(limit, acceleration_rps2=driven_acceleration(limit.acceleration_rps2, axis, limit))
        for axis, limit in limits.items()
    }


@dataclass(frozen=True, slots=True, kw_only=True)
class Structure:
    """Which turns and attitudes a script has; how long they last are the variables.

    The variables v are the seconds of one turn of each way, of the rest in each attitude if there are any, and of the
    rest at each end. None of the rests is shorter than ``rest_s``. ``cycles`` is how often the turns are gone through.
    ``limits`` are those that the controller can set (``driven_limits``).
    """

    ways: tuple[Way, ...]
    attitudes: tuple[Attitude, ...]
    cycles: int
    rest_s: float
    limits: Mapping[str, AxisLimits]
    gimbals: tuple[str, ...]

    @property
    def least(self) -> Floats:
        """The least value of each variable."""
        return np.array([_SHORTEST_TURN_S] * len(self.ways) + [self.rest_s] * self._rests)

    @property
    def usual(self) -> Floats:
        """Usual values of the variables."""
        turn_s, rest_s = _USUAL_S
        usual = np.array([turn_s] * len(self.ways) + [rest_s] * self._rests)
        return np.asarray(np.maximum(usual, self.least))

    @property
    def _rests(self) -> int:
        return 2 if self.attitudes else 1

    @property
    def counts(self) -> Floats:
        """How often each variable is in the script's time."""
        rests = [float(len(self.attitudes))] * (self._rests - 1)
        return np.array([2.0 * self.cycles] * len(self.ways) + [*rests, 2.0])

    def time_s(self, v: Floats) -> float:
        """Return how long the script takes."""
        return self._moves_s() + float(self.counts @ v)

    def _moves_s(self) -> float:
        return self.script(self.least, "moves").least_s - float(self.counts @ self.least)

    def with_ramps(self, acceleration_rps2: float) -> "Structure":
        """Return the same with no ramp steeper than this, or than the controller's least acceleration."""
        gentle = {
            axis: replace(
                limit,
                acceleration_rps2=min(limit.acceleration_rps2, max(acceleration_rps2, limit.acceleration_step_rps2)),
            )
            for axis, limit in self.limits.items()
        }
        return replace(self, limits=driven_limits(gentle))

    def described(self) -> str:
        """Return in words about which axes the script turns, how often, and its number of poses.

        Angles of the inner axes are given where they are not at home.
        """
        turns = ", ".join(
            way.axis + "".join(f" with {axis} at {math.degrees(angle):g} deg" for axis, angle in way.pose if angle)
            for way in self.ways
        )
        times = f"; {self.cycles} times" if self.cycles > 1 else ""
        return f"turns about {turns}{times}; {len(self.attitudes)} poses"

    def script(self, v: Floats, name: str, *, up: bool = True) -> Script:
        """Return the script, its times rounded up or down to steps that a person would write."""
        steps = v / _TIME_STEP_S
        rounded = np.ceil(steps - 1e-6) if up else np.floor(steps + 1e-6)
        return Script(name, tuple(self._steps(rounded * _TIME_STEP_S)))

    def _steps(self, v: Floats) -> Iterator[Step]:
        """Yield the steps for variables v (s): rest, turns and poses in turn, moves home, rest.

        Variables are as in the class. Poses are spread over the gaps between cycles; with one cycle they come after it.
        """
        rest_s = float(v[-1])
        angles = dict.fromkeys(self.gimbals, 0.0)
        yield Rest(rest_s, "rest before")
        groups = max(self.cycles - 1, 1)
        for cycle in range(self.cycles):
            for way, turn_s in zip(self.ways, v, strict=False):
                yield from moves(angles, {**dict.fromkeys(self.gimbals, 0.0), **dict(way.pose)}, self.limits)
                yield from self._turns(way, float(turn_s))
            if cycle < groups:
                for attitude in self.attitudes[cycle::groups]:
                    yield self._pose(attitude, float(v[-2]))
                    angles.update(attitude.angles_rad)
        yield from moves(angles, dict.fromkeys(self.gimbals, 0.0), self.limits)
        yield Rest(rest_s, "rest after")

    def _turns(self, way: Way, turn_s: float) -> Iterator[Rotate]:
        """Yield the turns of a way there and back, so often that each stays within the travel of its axis.

        ``turn_s`` is the time of all turns in one direction together. The first goes to the side with more travel.
        """
        limit = self.limits[way.axis]
        low, high = limit.travel_rad or (-math.inf, math.inf)
        room_rad = max(high, -low)
        sign = 1.0 if high >= -low else -1.0
        times = 1
        while _turned_rad(turn_s / times, limit) > room_rad:
            times += 1
        rate = turn_rate(turn_s / times, limit)
        for _ in range(times):
            for signed in (sign * rate, -sign * rate):
                label = f"{way.axis} at {math.degrees(signed):.4g} deg/s"
                yield Rotate(way.axis, signed, turn_s / times, limit.acceleration_rps2, label)

    def _pose(self, attitude: Attitude, rest_s: float) -> Pose:
        """Return the step to an attitude and a rest of ``rest_s`` there, after one second to settle.

        Rate and acceleration are the least of the limits of all axes.
        """
        acceleration = min(limit.acceleration_rps2 for limit in self.limits.values())
        angles = sorted(attitude.angles_rad)
        pose = Pose(
            aims=tuple(Aim(axis, angle, acceleration) for axis, angle in angles),
            rate_rps=min(limit.rate_rps for limit in self.limits.values()),
            settle_s=SETTLE_S,
            duration_s=rest_s,
            label="",
        )
        return replace(pose, label=pose.words())


def _turned_rad(turn_s: float, limit: AxisLimits) -> float:
    rate = turn_rate(turn_s, limit)
    return rate * (turn_s - rate / limit.acceleration_rps2)


def spanning(ways: Sequence[Way]) -> tuple[Way, ...]:
    """Return those of the ways that turn the body about a direction that the ways before cannot make up.

    They are at most three.
    """
    found: list[Way] = []
    for way in ways:
        directions = np.array([one.direction for one in (*found, way)])
        if np.linalg.matrix_rank(directions, tol=1e-6) > len(found):
            found.append(way)
    return tuple(found)


def ways_within(ways: Sequence[Way], limits: Mapping[str, AxisLimits]) -> list[Way]:
    """Return the ways whose poses are within the travel of the axes."""
    return [way for way in ways if all(_within(angle, limits[axis]) for axis, angle in way.pose)]


def _within(angle_rad: float, limit: AxisLimits) -> bool:
    low, high = limit.travel_rad or (-math.inf, math.inf)
    return low <= angle_rad <= high
