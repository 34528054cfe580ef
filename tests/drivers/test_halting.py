"""How long an axis that was told to stop is watched: as long as it slows down, and hardly longer."""

from __future__ import annotations

import asyncio
import random

import pytest
from turntable_rigs import DEG

from drivers.errors import DeviceRefused
from drivers.tables.halting import bring_to_rest
from drivers.types import AxisState
from station.run.event_loop.loops import VirtualLoop


def halted_s(
    rates_dps: dict[str, float], brakes_dps2: dict[str, float], noise_dps: float = 0.0, answer_s: float = 0.002
) -> tuple[float, str]:
    """Tell axes to stop that turn so fast and brake so hard; return after how long it ended, and how."""
    chance = random.Random(1)

    async def halt() -> tuple[float, str]:
        loop = asyncio.get_running_loop()

        async def tell(axis: str) -> None:
            await asyncio.sleep(0.002)

        async def read(axis: str) -> AxisState:
            await asyncio.sleep(answer_s)
            now_s, rate, brake = loop.time(), rates_dps[axis], brakes_dps2[axis]
            turned_s = min(now_s, rate / brake) if brake else now_s
            angle, left = rate * turned_s - brake * turned_s**2 / 2, rate - brake * turned_s
            t_ns = round(now_s * 1e9)
            noise = noise_dps * (left > 0) * chance.gauss(0, 1)
            return AxisState(
                angle_t_ns=t_ns, angle_rad=angle * DEG, rate_t_ns=t_ns, rate_rps=(left + noise) * DEG, half_width_ns=0
            )

        try:
            said = await bring_to_rest("table", sorted(rates_dps), tell, read, 0.2)
        except DeviceRefused as error:
            said = error.message
        return loop.time(), said

    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        return runner.run(halt())


@pytest.mark.parametrize(("rate_dps", "brake_dps2"), [(60.0, 3.0), (30.0, 0.5), (100.0, 1.0), (5.0, 0.05)])
@pytest.mark.parametrize("noise_dps", [0.0, 0.02])
def test_an_axis_that_slows_at_all_is_watched_until_it_stands(
    rate_dps: float, brake_dps2: float, noise_dps: float
) -> None:
    took_s, said = halted_s({"x": rate_dps}, {"x": brake_dps2}, noise_dps)
    assert "seen at rest" in said
    assert took_s == pytest.approx(rate_dps / brake_dps2, abs=1.5)  # noise hides the last of it


@pytest.mark.parametrize(("noise_dps", "within_s"), [(0.0, 1.2), (0.5, 3.0)])
@pytest.mark.parametrize("rate_dps", [1.0, 60.0])
def test_one_that_does_not_is_given_up_soon(rate_dps: float, noise_dps: float, within_s: float) -> None:
    took_s, said = halted_s({"x": rate_dps}, {"x": 0.0}, noise_dps)
    assert "it keeps turning. Cut its power" in said
    assert took_s < within_s


def test_one_that_slows_wins_no_time_for_one_that_does_not() -> None:
    took_s, said = halted_s({"x": 60.0, "y": 20.0}, {"x": 3.0, "y": 0.0})
    assert said.startswith("told to stop, axis y turned at 20.00 deg/s")
    assert took_s < 1.2


def test_a_slow_link_gets_the_looks_that_it_takes() -> None:
    took_s, said = halted_s(dict.fromkeys("xyz", 20.0), {"x": 2.0, "y": 5.0, "z": 1.0}, answer_s=0.15)
    assert "seen at rest" in said
    assert took_s < 21.5
