"""What every turntable driver does with its twin, whatever language the two speak."""

from __future__ import annotations

import asyncio
import inspect
from contextlib import suppress

import pytest
from turntable_rigs import (
    COUNTS,
    DEG,
    LIMITS,
    MAX_ACCELERATION,
    MAX_RATE,
    START_RAD,
    Rig,
    rig,
    settle,
    virtually,
)

from drivers.errors import DeviceFault, DeviceRefused, LinkLost
from drivers.types import AxisLimits, Identity

KINDS = ("modbus", "galil", "acutrol", "aerosmith")
every_table = pytest.mark.parametrize("kind", KINDS)

# What a language can say of a rate and of an acceleration, in deg/s and deg/s2: half a step each way.
RATE_STEP_DPS = {"modbus": 360 / (60 * 512 / 1875 * COUNTS["modbus"]), "galil": 1e-4, "acutrol": 1e-6, "aerosmith": 1}
ACCELERATION_STEP_DPS2 = {
    "modbus": 360 / (65536 / 4e6 * COUNTS["modbus"]),
    "galil": 2 * 1024 * 1e-4,
    "acutrol": 2e-6,
    "aerosmith": 2e-6,
}
ANGLE_DEG = {"modbus": 0.0028, "galil": 6e-5, "acutrol": 6e-4, "aerosmith": 6e-5}  # how near a target is reached


def last(axes: str) -> str:
    return axes[-1]


def truth_deg(made: Rig, axis: str) -> float:
    return made.model.motion[axis].at(made.model.clock())[0] / DEG


@every_table
def test_enabled_axes_hold_their_position(kind: str) -> None:
    async def main() -> None:
        async with rig(kind) as made:
            before = await made.table.status("x")
            assert (before.enabled, before.fault) == (False, "")
            await made.table.enable()
            for axis in made.axes:
                status = await made.table.status(axis)
                assert (status.enabled, status.fault) == (True, "")
                assert truth_deg(made, axis) == pytest.approx(START_RAD[axis] / DEG, abs=1e-12)
            assert made.model.at_rest()
            await made.table.enable()  # once more does no harm
            assert made.model.at_rest()

    virtually(main)


@every_table
def test_homing_brings_every_axis_home_and_counts_from_there(kind: str) -> None:
    async def main() -> None:
        async with rig(kind) as made:
            await made.table.enable()
            await made.table.home()
            for axis in made.axes:
                assert truth_deg(made, axis) == pytest.approx(0.0, abs=ANGLE_DEG[kind])
                assert made.model.rate_rps(axis) == 0.0
                state = await made.table.read(axis)
                assert state.angle_rad / DEG == pytest.approx(0.0, abs=ANGLE_DEG[kind])
                assert (await made.table.status(axis)).enabled

    virtually(main)


@every_table
@pytest.mark.parametrize("rate_dps", [20.0, -20.0, 0.5, 100.0, -0.001])
def test_a_jog_reads_back_its_rate_to_the_last_digit(kind: str, rate_dps: float) -> None:
    async def main() -> None:
        async with rig(kind) as made:
            axis = last(made.axes)
            await made.table.enable()
            await made.table.home()
            if kind == "aerosmith" and rate_dps % 1.0:
                with pytest.raises(DeviceRefused, match="only accepts whole deg/s"):
                    await made.table.jog(axis, rate_dps * DEG, 20 * DEG)
                return
            await made.table.jog(axis, rate_dps * DEG, 20 * DEG)
            await asyncio.sleep(10.0)
            state = await made.table.read(axis)
            step = min(RATE_STEP_DPS[kind], 1e-4) if kind == "aerosmith" else RATE_STEP_DPS[kind]
            assert state.rate_rps / DEG == pytest.approx(rate_dps, abs=0.5001 * step)
            assert made.model.rate_rps(axis) / DEG == pytest.approx(rate_dps, abs=0.5001 * step)
            assert all(made.model.rate_rps(other) == 0.0 for other in made.axes if other != axis)
            truth = float(made.model.motion[axis].at(state.angle_t_ns * 1e-9)[0])
            assert state.angle_rad == pytest.approx(truth, abs=max(0.51 * made.count_rad, 6e-5 * DEG))
            assert (await made.table.status(axis)).target_reached

    virtually(main)


@every_table
def test_a_jog_takes_another_rate_while_it_turns(kind: str) -> None:
    async def main() -> None:
        async with rig(kind) as made:
            await made.table.enable()
            await made.table.jog("x", 40 * DEG, 20 * DEG)
            await asyncio.sleep(4.0)
            await made.table.jog("x", 30 * DEG, 20 * DEG)
            slowest = made.model.rate_rps("x")
            for _ in range(100):
                await asyncio.sleep(0.02)
                slowest = min(slowest, made.model.rate_rps("x"))
            assert slowest / DEG == pytest.approx(30.0, abs=0.01)  # no halt between the two
            await made.table.jog("x", -10 * DEG, 20 * DEG)
            await asyncio.sleep(4.0)
            assert made.model.rate_rps("x") / DEG == pytest.approx(-10.0, abs=0.01)

    virtually(main)


@every_table
def test_a_ramp_is_as_steep_as_told(kind: str) -> None:
    async def main() -> None:
        async with rig(kind) as made:
            axis = last(made.axes)
            await made.table.enable()
            await made.table.jog(axis, 20 * DEG, 8 * DEG)
            first = made.model.rate_rps(axis)
            await asyncio.sleep(1.0)
            assert (made.model.rate_rps(axis) - first) / DEG == pytest.approx(
                8.0, abs=0.5001 * ACCELERATION_STEP_DPS2[kind]
            )
            await asyncio.sleep(5.0)
            assert made.model.rate_rps(axis) / DEG == pytest.approx(20.0, abs=0.01)

    virtually(main)


@every_table
@pytest.mark.parametrize("angle_deg", [90.0, -123.456, 1440.0, -400.0, 0.01])
def test_a_move_ends_on_its_target_and_counts_turns(kind: str, angle_deg: float) -> None:
    async def main() -> None:
        async with rig(kind) as made:
            await made.table.enable()
            await made.table.home()
            await made.table.move("x", angle_deg * DEG, 80 * DEG, 40 * DEG)
            assert not (await made.table.status("x")).target_reached
            await settle(made.table, "x")
            assert made.model.at_rest()
            await asyncio.sleep(0.3)  # a rate that is a mean has no motion in it any more
            state = await made.table.read("x")
            assert state.rate_rps == 0.0
            assert state.angle_rad / DEG == pytest.approx(angle_deg, abs=ANGLE_DEG[kind])
            assert truth_deg(made, "x") == pytest.approx(angle_deg, abs=ANGLE_DEG[kind])

    virtually(main)


@every_table
def test_a_long_move_takes_the_time_it_must(kind: str) -> None:
    async def main() -> None:
        async with rig(kind) as made:
            await made.table.enable()
            await made.table.home()
            began = asyncio.get_running_loop().time()
            await made.table.move("x", 720 * DEG, 60 * DEG, 30 * DEG)
            await settle(made.table, "x")
            took = asyncio.get_running_loop().time() - began
            assert 14.0 - 0.1 <= took <= 14.0 + 2.0  # two ramps of 2 s, 10 s at 60 deg/s

    virtually(main)


@every_table
def test_moves_may_follow_one_another_and_a_jog(kind: str) -> None:
    async def main() -> None:
        async with rig(kind) as made:
            await made.table.enable()
            await made.table.home()
            await made.table.move("x", 30 * DEG, 50 * DEG, 40 * DEG)
            await settle(made.table, "x")
            await made.table.jog("x", -10 * DEG, 20 * DEG)
            await asyncio.sleep(2.0)
            await made.table.move("x", -5 * DEG, 50 * DEG, 40 * DEG)
            await settle(made.table, "x")
            assert (await made.table.read("x")).angle_rad / DEG == pytest.approx(-5.0, abs=2 * ANGLE_DEG[kind])

    virtually(main)


@every_table
def test_a_reading_is_true_within_its_round_trip(kind: str) -> None:
    async def main() -> None:
        async with rig(kind) as made:
            await made.table.enable()
            await made.table.home()
            await made.table.jog("x", 60 * DEG, 50 * DEG)
            for _ in range(200):
                await asyncio.sleep(0.0513)
                state = await made.table.read("x")
                low = made.model.motion["x"].at(state.angle_t_ns * 1e-9 - state.half_width_ns * 1e-9)[0]
                high = made.model.motion["x"].at(state.angle_t_ns * 1e-9 + state.half_width_ns * 1e-9)[0]
                slack = max(0.51 * made.count_rad, 6e-5 * DEG)
                assert low - slack <= state.angle_rad <= high + slack
            assert truth_deg(made, "x") > 500.0

    virtually(main)


@every_table
def test_stop_brings_turning_axes_to_rest_before_it_returns(kind: str) -> None:
    async def main() -> None:
        async with rig(kind) as made:
            await made.table.enable()
            await made.table.home()
            for axis, rate in (("x", 90.0), ("z", -60.0)):
                if axis in made.axes:
                    await made.table.jog(axis, rate * DEG, 50 * DEG)
            await asyncio.sleep(4.0)
            angle, rate = made.model.motion["x"].at(made.model.clock())
            await made.table.stop()
            assert all(abs(made.model.rate_rps(axis)) <= 0.02 * DEG for axis in made.axes)
            await asyncio.sleep(1.0)
            assert made.model.at_rest()
            way = made.model.motion["x"].at(made.model.clock())[0] - angle
            assert way == pytest.approx(rate * rate / (2 * MAX_ACCELERATION), abs=rate * 0.1)
            assert (await made.table.status("x")).fault == ""

    virtually(main)


@every_table
def test_a_long_move_can_be_stopped_and_stays_so(kind: str) -> None:
    async def main() -> None:
        async with rig(kind) as made:
            await made.table.enable()
            await made.table.home()
            await made.table.move("x", 3600 * DEG, 80 * DEG, 40 * DEG)
            await asyncio.sleep(3.0)
            await made.table.stop()
            stood = truth_deg(made, "x")
            await asyncio.sleep(20.0)
            assert truth_deg(made, "x") == pytest.approx(stood, abs=0.1)
            assert made.model.at_rest()

    virtually(main)


@every_table
def test_a_stopped_table_can_be_enabled_and_moved_again(kind: str) -> None:
    async def main() -> None:
        async with rig(kind) as made:
            await made.table.enable()
            await made.table.home()
            await made.table.jog("x", 10 * DEG, 50 * DEG)
            await asyncio.sleep(2.0)
            await made.table.stop()
            await asyncio.sleep(1.0)
            await made.table.disable()
            assert not (await made.table.status("x")).enabled
            await made.table.enable()
            await made.table.move("x", 0.0, 50 * DEG, 40 * DEG)
            await settle(made.table, "x")
            assert (await made.table.read("x")).angle_rad / DEG == pytest.approx(0.0, abs=ANGLE_DEG[kind])

    virtually(main)


@every_table
def test_abort_stops_every_axis_at_once_and_the_table_can_be_used_again(kind: str) -> None:
    async def main() -> None:
        async with rig(kind) as made:
            await made.table.enable()
            await made.table.home()
            await made.table.jog("x", 50 * DEG, 5 * DEG)
            await asyncio.sleep(12.0)
            began = asyncio.get_running_loop().time()
            await made.table.abort()
            took = asyncio.get_running_loop().time() - began
            assert took <= 50 * DEG / MAX_ACCELERATION + 0.3  # as hard as the drives can, not along the ramp
            assert all(abs(made.model.rate_rps(axis)) <= 0.02 * DEG for axis in made.axes)
            await asyncio.sleep(0.1)
            assert made.model.at_rest()
            assert (await made.table.status("x")).fault == ""
            await made.table.enable()
            await made.table.move("x", 0.0, 50 * DEG, 40 * DEG)
            await settle(made.table, "x")
            assert truth_deg(made, "x") == pytest.approx(0.0, abs=ANGLE_DEG[kind])

    virtually(main)


@every_table
def test_a_fault_is_told_keeps_the_table_off_and_can_be_reset(kind: str) -> None:
    async def main() -> None:
        async with rig(kind) as made:
            axis = last(made.axes)
            await made.table.enable()
            await made.table.jog(axis, 90 * DEG, 50 * DEG)
            await asyncio.sleep(4.0)
            made.model.trip(axis, "fault input")
            assert f"axis {axis}" in (await made.table.status(axis)).fault
            await asyncio.sleep(3.0)
            assert made.model.at_rest()
            status = await made.table.status(axis)
            assert not status.enabled
            assert f"axis {axis}" in status.fault
            if axis != "x":
                assert (await made.table.status("x")).fault == ""
            with pytest.raises(DeviceFault, match=f"table: axis {axis}"):
                await made.table.enable()
            await made.table.reset_fault()
            assert (await made.table.status(axis)).fault == ""
            await made.table.enable()
            assert (await made.table.status(axis)).enabled

    virtually(main)


@every_table
def test_a_fault_during_homing_ends_it(kind: str) -> None:
    async def main() -> None:
        async with rig(kind) as made:
            await made.table.enable()
            asyncio.get_running_loop().call_later(0.1, made.model.trip, "x", "fault input")
            with pytest.raises(DeviceFault, match="axis x"):
                await made.table.home()

    virtually(main)


@every_table
def test_silence_of_the_controller_is_a_lost_link_within_half_a_second(kind: str) -> None:
    async def main() -> None:
        async with rig(kind) as made:
            await made.table.enable()
            await made.table.home()
            await made.table.jog("x", 20 * DEG, 20 * DEG)
            await asyncio.sleep(2.0)
            loop = asyncio.get_running_loop()
            await made.silence()
            for ask in (made.table.read, made.table.status):
                began = loop.time()
                with pytest.raises(LinkLost, match="table: "):
                    await ask("x")
                assert loop.time() - began <= 0.5

    virtually(main)


@pytest.mark.parametrize("kind", KINDS[1:])
def test_a_controller_that_never_answers_is_a_lost_link_when_it_is_opened(kind: str) -> None:
    async def main() -> None:
        async with rig(kind, opened=False) as made:
            await made.silence()
            with pytest.raises(LinkLost, match="no answer within 0.4 s after two requests"):
                await made.table.open()
            assert asyncio.get_running_loop().time() <= 0.5

    virtually(main)


@every_table
def test_a_moving_axis_stops_when_its_master_falls_silent(kind: str) -> None:
    async def main() -> None:
        async with rig(kind, watchdog_s=1.0) as made:
            await made.table.enable()
            await made.table.jog("x", 20 * DEG, 50 * DEG)
            await asyncio.sleep(0.9)
            assert made.model.rate_rps("x") / DEG == pytest.approx(20.0, rel=1e-3)
            if kind != "modbus":
                await made.silence()
            await asyncio.sleep(2.5)
            assert made.model.at_rest()
            made.speak()
            with suppress(LinkLost):  # a driver that watches an axis by itself tells of the silence once
                await made.table.status("x")
            assert not (await made.table.status("x")).enabled or kind == "aerosmith"

    virtually(main)


@every_table
def test_a_moving_axis_goes_on_while_its_master_speaks(kind: str) -> None:
    async def main() -> None:
        async with rig(kind, watchdog_s=1.0) as made:
            await made.table.enable()
            await made.table.jog("x", 20 * DEG, 50 * DEG)
            for _ in range(25):
                await asyncio.sleep(0.8)
                await made.table.read("x")
            assert made.model.rate_rps("x") / DEG == pytest.approx(20.0, rel=1e-3)

    virtually(main)


@every_table
def test_a_rate_beyond_what_the_axis_can_is_refused(kind: str) -> None:
    async def main() -> None:
        async with rig(kind) as made:
            await made.table.enable()
            with pytest.raises(DeviceRefused, match="table: .*x"):
                await made.table.jog("x", 3 * MAX_RATE, 20 * DEG)
            await asyncio.sleep(1.0)
            assert made.model.at_rest()
            assert (await made.table.status("x")).enabled

    virtually(main)


@every_table
def test_limits_are_those_of_the_axes(kind: str) -> None:
    async def main() -> None:
        async with rig(kind) as made:
            assert dict(made.table.limits) == dict.fromkeys(made.axes, AxisLimits(LIMITS.rate_rps, MAX_ACCELERATION))

    virtually(main)


@every_table
def test_a_table_without_power_says_so_and_does_not_move(kind: str) -> None:
    async def main() -> None:
        async with rig(kind) as made:
            await made.table.enable()
            await made.table.disable()
            assert not (await made.table.status("x")).enabled
            if kind != "modbus":  # a drive takes set-points for when it is enabled
                with pytest.raises(DeviceRefused):
                    await made.table.jog("x", 20 * DEG, 20 * DEG)
            await asyncio.sleep(1.0)
            assert made.model.at_rest()

    virtually(main)


@every_table
def test_the_controller_says_what_it_is(kind: str) -> None:
    async def main() -> None:
        async with rig(kind) as made:
            identity = await made.table.identify()
            assert isinstance(identity, Identity)
            if kind != "modbus":
                assert identity.model

    virtually(main)


@every_table
def test_closing_twice_is_once_and_leaves_no_task(kind: str) -> None:
    async def main() -> None:
        before = asyncio.all_tasks()
        async with rig(kind) as made:
            await made.table.enable()
            await made.table.jog("x", 20 * DEG, 20 * DEG)
            made.table.close()
            made.table.close()
        await asyncio.sleep(0.1)
        assert {task for task in asyncio.all_tasks() - before if not _of_pymodbus(task)} == set()

    virtually(main)


def _of_pymodbus(task: asyncio.Task[object]) -> bool:
    coroutine = task.get_coro()
    return inspect.iscoroutine(coroutine) and "pymodbus" in coroutine.cr_code.co_filename
