"""The attitudes in which a table can rest a device, and a choice of them that shows its accelerometers."""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from drivers.types import AxisLimits, Floats
from estimator.geometry.kinematics import into_body
from station.scripts.steps.kind import turn_to

_STEP_RAD = math.pi / 4  # a whole number of counts of nearly every encoder: none of them rounds it
_SAME = 1 - 1e-6


@dataclass(frozen=True, slots=True)
class Attitude:
    """Angles from home by axis, and the direction of "up" in the body (3,)."""

    angles_rad: tuple[tuple[str, float], ...]
    up: tuple[float, float, float]

    @property
    def moved(self) -> int:
        """How many axes are not at home."""
        return sum(angle != 0 for _, angle in self.angles_rad)


def attitudes_of(gimbals: Sequence[str], limits: Mapping[str, AxisLimits]) -> list[Attitude]:
    """Return an attitude for each direction of gravity in the body that ``gimbals`` reach in steps of 45 deg.

    Of those with the same direction the one that moves the fewest axes, by the least angles, is taken; the list is in
    the order of these, from home. Axes stay within their travel, by ``limits``.
    """
    choices = [_angles_within(limits[axis]) for axis in gimbals]
    grid = sorted(
        itertools.product(*choices), key=lambda angles: (np.count_nonzero(angles), np.abs(angles).sum(), -sum(angles))
    )
    found: list[Attitude] = []
    for angles in grid:
        x, y, z = into_body(np.array([0.0, 0.0, 1.0]), np.array([angles]), gimbals)[0].tolist()
        if not any(np.dot((x, y, z), known.up) > _SAME for known in found):
            found.append(Attitude(tuple(zip(gimbals, angles, strict=True)), (x, y, z)))
    return found


def chosen(attitudes: Sequence[Attitude], count: int) -> list[Attitude]:
    """Return ``count`` of the attitudes, or all if there are fewer, that show bias and axes of accelerometers best.

    Each is the one that adds most to the determinant of the sum of [1, up][1, up]'. Of equal ones the first is taken.
    """
    total = 1e-3 * np.eye(4)
    left = list(attitudes)
    found: list[Attitude] = []
    while left and len(found) < count:
        gains = [_gain(total, attitude) for attitude in left]
        best = next(i for i, gain in enumerate(gains) if gain > _SAME * max(gains))
        attitude = left.pop(best)
        row = np.array([1.0, *attitude.up])
        total += np.outer(row, row)
        found.append(attitude)
    return found


def in_order(attitudes: Sequence[Attitude], limits: Mapping[str, AxisLimits]) -> list[Attitude]:
    """Return the attitudes in an order with short moves: each the nearest to that before it, from home."""
    left = list(attitudes)
    order: list[Attitude] = []
    angles = {axis: 0.0 for attitude in left for axis, _ in attitude.angles_rad}
    while left:
        nearest = min(left, key=lambda attitude: _move_s(angles, attitude, limits))
        left.remove(nearest)
        order.append(nearest)
        angles.update(nearest.angles_rad)
    return order


def _gain(total: Floats, attitude: Attitude) -> float:
    row = np.array([1.0, *attitude.up])
    return float(row @ np.linalg.solve(total, row))


def _angles_within(limit: AxisLimits) -> list[float]:
    """Return the angles from home, in steps of 45 deg, that an axis reaches; without a travel those of one turn."""
    low, high = limit.travel_rad or (-math.pi + 1e-9, math.pi)
    steps = range(-4, 5)
    return [step * _STEP_RAD for step in steps if low - 1e-9 <= step * _STEP_RAD <= high + 1e-9]


def _move_s(angles: Mapping[str, float], attitude: Attitude, limits: Mapping[str, AxisLimits]) -> float:
    """Return how long the axes take to an attitude, one after the other."""
    return sum(
        turn_to(axis, angles[axis], angle, limits[axis].rate_rps, limits[axis].acceleration_rps2).duration_s
        for axis, angle in attitude.angles_rad
    )
