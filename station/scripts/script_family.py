"""The family of scripts that a table can do, as data with few open numbers; what a script shows, as sums over time.

Rests at both ends, and between them turns about each axis, the axes inside it at home or aside (an outer axis then
turns the body about another direction), gone through once or several times. How long each turn lasts is open. Turns
there and back keep the bias apart from the scale factors, end at home whatever their angle, and let a scale factor
that differs by direction show.

The sums are exact for a base that does not turn: a trapezoid about a fixed direction of the body adds its time, its
angle and its integral of rate squared.
"""

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from drivers.types import AxisLimits, Floats
from estimator.geometry.kinematics import body_rate
from station.scripts.script import Script
from station.scripts.steps.kind import Step
from station.scripts.steps.move import Move
from station.scripts.steps.rest import Rest
from station.scripts.steps.rotate import Rotate

_RAMP_SHARE = 0.4  # of a short turn, for each ramp: a part of every turn is at a steady rate
_SHORTEST_TURN_S = 1.0
_TIME_STEP_S = 0.01  # to which times are rounded, as a person would write
_PARALLEL = 1 - 1e-9


@dataclass(frozen=True, slots=True)
class Way:
    """One way to turn the body: an axis, the angles of the axes inside it, and the direction in body axes.

    ``sign`` 0 turns there and back, +1 and -1 in that direction only.
    """

    axis: str
    pose: tuple[tuple[str, float], ...]
    direction: tuple[float, float, float]
    sign: int = 0

    @property
    def moved(self) -> int:
        """How many axes inside are not at home."""
        return sum(angle != 0 for _, angle in self.pose)


def ways_of(gimbals: Sequence[str], poses_rad: Sequence[float]) -> list[Way]:
    """Return the ways to turn the body there and back, with the inner axes at any of the angles ``poses_rad``.

    Of ways of one axis with the same direction only the one with the fewest moves is kept. Ways that need no move come
    first.
    """
    ways: list[Way] = []
    for depth, axis in enumerate(gimbals):
        inside = tuple(gimbals[depth + 1 :])
        poses = sorted(itertools.product(poses_rad, repeat=len(inside)), key=lambda pose: np.count_nonzero(pose))
        for pose in poses:
            here = tuple(zip(inside, pose, strict=True))
            direction = _direction(axis, dict(here), gimbals)
            same = (abs(np.dot(direction, w.direction)) > _PARALLEL for w in ways if w.axis == axis)
            if not any(same):
                ways.append(Way(axis, here, direction))
    return sorted(ways, key=lambda way: way.moved > 0)


def one_way(ways: Sequence[Way]) -> Iterator[tuple[Way, ...]]:
    """Yield these ways turned in one direction only, in every choice of directions that matters.

    The first always turns forwards. They must be at home, outermost first: a turn then changes the direction of no turn
    after it, whatever its angle.
    """
    for signs in itertools.product((1, -1), repeat=len(ways) - 1):
        yield tuple(replace(way, sign=sign) for way, sign in zip(ways, (1, *signs), strict=True))


class Shape:
    """Ways in order, repeated ``cycles`` times; the durations of turns and rests are variables.

    The variables v are the seconds of one turn of each way, then those of the rest at each end.
    """

    def __init__(
        self, ways: Sequence[Way], cycles: int, rest_s: float, limits: Mapping[str, AxisLimits], gimbals: Sequence[str]
    ) -> None:
        """Prepare for ``ways`` of a table with these ``limits`` and ``gimbals``, outermost first.

        ``rest_s`` is the least rest at each end.
        """
        self.ways, self.cycles = tuple(ways), cycles
        self._limits, self._gimbals = limits, tuple(gimbals)
        self.least = np.array([_SHORTEST_TURN_S] * len(ways) + [rest_s])
        moves = tuple(step for step in self._steps(self.least) if step.ends_at_stated_angles)
        self._fixed = sums(Script("moves", moves), gimbals)

    def again(self, cycles: int) -> "Shape":
        """Return the same ways with this number of cycles."""
        return Shape(self.ways, cycles, float(self.least[-1]), self._limits, self._gimbals)

    def with_ramps(self, acceleration_rps2: float) -> "Shape":
        """Return the same ways, no ramp steeper than this."""
        limits = {
            axis: replace(limit, acceleration_rps2=min(limit.acceleration_rps2, acceleration_rps2))
            for axis, limit in self._limits.items()
        }
        return Shape(self.ways, self.cycles, float(self.least[-1]), limits, self._gimbals)

    def information(self, v: Floats) -> Floats:
        """Return the summed [1, w][1, w]' (4, 4) over time, in s, rad and rad^2/s; the first entry is the time."""
        total = self._fixed + _entry(2 * v[-1], 0.0, 0.0, (0.0, 0.0, 0.0))
        for way, turn_s in zip(self.ways, v[:-1], strict=True):
            total += self._turns(way, float(turn_s))[0]
        return np.asarray(total)

    def slopes(self, v: Floats) -> Floats:
        """Return how the sums change with each variable (v, 4, 4)."""
        slopes = [self._turns(way, float(turn_s))[1] for way, turn_s in zip(self.ways, v[:-1], strict=True)]
        return np.array([*slopes, _entry(2.0, 0.0, 0.0, (0.0, 0.0, 0.0))])

    def script(self, v: Floats, name: str, *, up: bool = True) -> Script:
        """Return the script, its times rounded up or down to steps that a person would write."""
        steps = v / _TIME_STEP_S
        return Script(
            name, tuple(self._steps((np.ceil(steps - 1e-6) if up else np.floor(steps + 1e-6)) * _TIME_STEP_S))
        )

    def _steps(self, v: Floats) -> Iterator[Step]:
        """Yield the steps for variables v: rest, moves and turns of each cycle, moves home, rest.

        A way with a sign turns that way only, others there and back. Moves take what the axes need, beside the
        variables.
        """
        yield Rest(float(v[-1]), "rest before")
        angles = dict.fromkeys(self._gimbals, 0.0)
        for _ in range(self.cycles):
            for way, turn_s in zip(self.ways, v[:-1], strict=True):
                yield from moves(angles, dict(way.pose), self._limits)
                limit = self._limits[way.axis]
                rate = turn_rate(float(turn_s), limit)
                for signed in (way.sign * rate,) if way.sign else (rate, -rate):
                    label = f"{way.axis} at {math.degrees(signed):.4g} deg/s"
                    yield Rotate(way.axis, signed, float(turn_s), limit.acceleration_rps2, label)
        yield from moves(angles, dict.fromkeys(self._gimbals, 0.0), self._limits)
        yield Rest(float(v[-1]), "rest after")

    def _turns(self, way: Way, turn_s: float) -> tuple[Floats, Floats]:
        """Return what all turns of a way add to the sums (4, 4), and its derivative by their duration (4, 4).

        All cycles are counted. Of turns there and back the angles cancel.
        """
        limit = self._limits[way.axis]
        rate, push = turn_rate(turn_s, limit), limit.acceleration_rps2
        rate_slope = 0.0 if rate == limit.rate_rps else _RAMP_SHARE * push
        turn, square = rate * (turn_s - rate / push), _square(rate, turn_s, push)
        turn_slope = rate + rate_slope * (turn_s - 2 * rate / push)
        square_slope = rate**2 + rate_slope * (2 * rate * turn_s - 4 * rate**2 / push)
        count, net = (self.cycles, way.sign * self.cycles) if way.sign else (2 * self.cycles, 0)
        return (
            _entry(count * turn_s, net * turn, count * square, way.direction),
            _entry(count, net * turn_slope, count * square_slope, way.direction),
        )


def sums(script: Script, gimbals: Sequence[str]) -> Floats:
    """Return the sum of [1, w][1, w]' (4, 4) over the time of a script in s, for body rate w without Earth rate.

    Steps of open duration take their least.
    """
    total = np.zeros((4, 4))
    angles = dict.fromkeys(gimbals, 0.0)
    for timed in script.timeline():
        for part in timed.parts:
            turn = part.turn
            if turn is None:
                total[0, 0] += part.span.least_s
                continue
            peak = min(abs(turn.rate_rps), math.sqrt(abs(turn.way_rad) * turn.acceleration_rps2))
            square = _square(peak, turn.duration_s, turn.acceleration_rps2)
            total += _entry(turn.duration_s, turn.way_rad, square, _direction(turn.axis, angles, gimbals))
            angles[turn.axis] = turn.to_rad
    return total


def turn_rate(turn_s: float, limit: AxisLimits) -> float:
    """Return the rate of a turn of this length, as high as its axis and ramps allow."""
    return min(limit.rate_rps, _RAMP_SHARE * limit.acceleration_rps2 * turn_s)


def _square(peak_rps: float, duration_s: float, acceleration_rps2: float) -> float:
    """Return the integral of rate squared over a trapezoid."""
    return peak_rps**2 * (duration_s - 4 * peak_rps / (3 * acceleration_rps2))


def _entry(duration_s: float, turn_rad: float, square: float, direction: Sequence[float]) -> Floats:
    d = np.asarray(direction)
    out = np.empty((4, 4))
    out[0, 0] = duration_s
    out[0, 1:] = out[1:, 0] = turn_rad * d
    out[1:, 1:] = square * np.outer(d, d)
    return out


def _direction(axis: str, angles: Mapping[str, float], gimbals: Sequence[str]) -> tuple[float, float, float]:
    """Return the axis (a unit vector in body axes) about which the body turns when this gimbal turns."""
    here = np.array([[angles.get(gimbal, 0.0) for gimbal in gimbals]])
    x, y, z = body_rate(here, np.array([[float(gimbal == axis) for gimbal in gimbals]]), gimbals)[0]
    return float(x), float(y), float(z)


def moves(angles: dict[str, float], aims: Mapping[str, float], limits: Mapping[str, AxisLimits]) -> Iterator[Move]:
    """Yield the moves of axes from ``angles`` to ``aims`` (rad), as fast as their limits allow.

    Axes that are there already are skipped. ``angles`` are updated.
    """
    for axis, angle in aims.items():
        if angles[axis] != angle:
            angles[axis] = angle
            limit = limits[axis]
            label = f"{axis} to {math.degrees(angle):g} deg"
            yield Move(axis, angle, limit.rate_rps, limit.acceleration_rps2, label)
