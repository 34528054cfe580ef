"""How late, slow and coarsely read an axis may be before it is said to stand."""

from __future__ import annotations

import asyncio
import itertools
import math

import pytest

from drivers.types import AxisLimits, AxisState, AxisStatus
from station.run.event_loop.loops import VirtualLoop
from station.run.uncommanded import AT_REST_S, Commanded, Course, MotionGuard, UntrueReadings

DEG = math.pi / 180
SOUND = AxisStatus(enabled=True, target_reached=False, fault="", text="operation enabled")


class LateAxis:
    """A table whose axis follows its course later, slower and in counts, and whose readings take their time."""

    def __init__(
        self, course: Course, *, late_s: float, slow: float, counts: int, answer_s: float, freeze_s: float
    ) -> None:
        """``slow`` is the share of its rate that is missing; from ``freeze_s`` on readings do not change."""
        self.limits = {"x": AxisLimits(100 * DEG, 50 * DEG, resolution_rad=math.tau / counts)}
        rate_rps = course.rate_rps * (1 - slow)
        longer_s = course.way_rad / rate_rps + rate_rps / course.acceleration_rps2
        reaches_rate = course.way_rad > rate_rps**2 / course.acceleration_rps2
        self.course = course._replace(
            sent_s=course.sent_s + late_s,
            rate_rps=rate_rps,
            duration_s=longer_s if reaches_rate else course.duration_s,
        )
        self.homing: set[str] = set()
        self._count_rad, self._answer_s, self._freeze_s = math.tau / counts, answer_s, freeze_s

    def angle_rad(self, at_s: float) -> float:
        steps = 500
        since_s = max(at_s - self.course.sent_s, 0.0)
        times = (self.course.sent_s + since_s * (step + 0.5) / steps for step in range(steps))
        return sum(self.course.speed_rps(t) for t in times) * since_s / steps

    async def read(self, axis: str) -> AxisState:
        loop = asyncio.get_running_loop()
        await asyncio.sleep(self._answer_s / 2)
        at_s = loop.time()
        told_s = min(at_s, self._freeze_s)
        angle = round(self.angle_rad(told_s) / self._count_rad) * self._count_rad
        await asyncio.sleep(self._answer_s / 2)
        t_ns, half_ns = round(at_s * 1e9), round(self._answer_s / 2 * 1e9)
        return AxisState(
            angle_t_ns=t_ns,
            angle_rad=angle,
            rate_t_ns=t_ns,
            rate_rps=self.course.speed_rps(told_s),
            half_width_ns=half_ns,
        )

    async def status(self, axis: str) -> AxisStatus:
        await asyncio.sleep(self._answer_s)
        return SOUND


def alarmed_s(
    rate: float,
    acceleration: float,
    *,
    way: float,
    late_s: float = 0.0,
    slow: float = 0.0,
    counts: int = 65536,
    answer_s: float = 0.002,
    freeze_s: float = math.inf,
) -> float:
    """Return when an axis that is read ten times a second is said to stand, infinite for never; angles in deg."""
    rate_rps, acceleration_rps2, way_rad = rate * DEG, acceleration * DEG, way * DEG
    ramp_s = min(rate_rps / acceleration_rps2, math.sqrt(way_rad / acceleration_rps2))
    duration_s = way_rad / rate_rps + ramp_s if ramp_s == rate_rps / acceleration_rps2 else 2 * ramp_s
    course = Course(
        sent_s=1.0,
        duration_s=duration_s,
        rate_rps=rate_rps,
        acceleration_rps2=acceleration_rps2,
        way_rad=way_rad,
        target_rad=way_rad,
    )
    table = LateAxis(course, late_s=late_s, slow=slow, counts=counts, answer_s=answer_s, freeze_s=freeze_s)

    async def main() -> float:
        loop = asyncio.get_running_loop()
        guard = MotionGuard(table, lambda axis: Commanded(0.0, way_rad, rate_rps, 1.0, course))  # type: ignore[arg-type]
        while loop.time() < 1.0 + duration_s:
            try:
                await guard.look("x", await table.read("x"))
            except UntrueReadings:
                return loop.time()
            await asyncio.sleep(0.1)
        return math.inf

    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        return runner.run(main())


MOTIONS = [
    (0.01, 20.0, 0.2),
    (0.1, 0.05, 1.0),
    (1.0, 50.0, 5.0),
    (20.0, 6.67, 90.0),
    (60.0, 50.0, 200.0),
    (30.0, 50.0, 3.0),
]


@pytest.mark.parametrize(("rate", "acceleration", "way"), MOTIONS)
def test_an_axis_that_moves_is_not_said_to_stand(rate: float, acceleration: float, way: float) -> None:
    for late_s, slow, counts, answer_s in itertools.product((0.0, 0.3), (0.0, 0.05), (4096, 65536), (0.002, 0.3)):
        when_s = alarmed_s(rate, acceleration, way=way, late_s=late_s, slow=slow, counts=counts, answer_s=answer_s)
        assert when_s == math.inf, (late_s, slow, counts, answer_s)


@pytest.mark.parametrize("part", [0.0, 0.1, 0.5])
@pytest.mark.parametrize(("rate", "acceleration"), [(1.0, 50.0), (10.0, 5.0), (20.0, 20.0), (50.0, 50.0)])
def test_one_whose_readings_freeze_is_said_so_in_time_to_brake(rate: float, acceleration: float, part: float) -> None:
    way = 20 * rate
    freeze_s = 1.0 + part * 20.0
    when_s = alarmed_s(rate, acceleration, way=way, freeze_s=freeze_s)
    turns_dps = min(rate, acceleration * (when_s - 1.0))
    assert when_s + turns_dps / 50.0 <= freeze_s + AT_REST_S
