"""The table driver against drives behind a stock Modbus server, and against peers that do not answer."""

from __future__ import annotations

import asyncio
import itertools
import math
from collections.abc import AsyncIterator, Awaitable, Callable, Collection
from contextlib import asynccontextmanager
from dataclasses import replace
from typing import Any

import pytest
from modbus_twin import modbus_server
from pymodbus.transport import NULLMODEM_HOST
from setups import setup_of

from drivers.errors import DeviceFault, DeviceRefused, LinkLost
from drivers.specs import AxisSetup
from drivers.tables.modbus.line import Address, SerialPort
from drivers.tables.modbus.registers import DriveProfile, load_profile
from drivers.tables.modbus.table import ModbusTable
from drivers.types import AxisLimits, Identity
from sims.physics.table import AxisData, TableModel
from sims.wires.line_controller import TableTwinSetup
from station.run.event_loop.loops import ScaledLoop, VirtualLoop

DEG = math.pi / 180
COUNTS = 65536
COUNT_RAD = 2 * math.pi / COUNTS
RATE_LSB_RPS = 2 * math.pi / (60 * 512 / 1875 * COUNTS)
ACCELERATION_LSB_RPS2 = 2 * math.pi / (65536 / 4e6 * COUNTS)
MAX_RATE, MAX_ACCELERATION = 100 * DEG, 50 * DEG
START_RAD = {"x": 3 * DEG, "y": -2 * DEG, "z": 1.5 * DEG}
UNIT_IDS = {"x": 1, "y": 2, "z": 3}
PROFILE = load_profile("kinco")
_wires = itertools.count(50_000)


@pytest.fixture(params=["tcp", "rtu"])
def transport(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def null_modem(transport: str) -> Address:
    number = next(_wires)
    return (NULLMODEM_HOST, number) if transport == "tcp" else SerialPort(f"socket://{NULLMODEM_HOST}:{number}")


def driver(
    address: Address, axes: dict[str, int] = UNIT_IDS, timeout_s: float = 0.2, max_rate_rps: float = MAX_RATE
) -> ModbusTable:
    limits = AxisLimits(max_rate_rps, MAX_ACCELERATION)
    drives = {axis: AxisSetup(unit_id, COUNTS, limits) for axis, unit_id in axes.items()}
    return ModbusTable(setup_of("modbus", drives, timeout_s, profile=PROFILE), address)


@asynccontextmanager
async def twin(
    transport: str,
    watchdog_s: float = 0.0,
    profile: DriveProfile = PROFILE,
    mute: Collection[int] = (),
    max_rate_rps: float = MAX_RATE,
) -> AsyncIterator[tuple[ModbusTable, TableModel]]:
    """Serve three drives over a null modem and give the driver, opened, and the table beneath.

    What the unit ids in ``mute`` answer gets lost. The driver knows of ``max_rate_rps``.
    """
    data = {axis: AxisData(MAX_RATE, MAX_ACCELERATION, COUNTS, start) for axis, start in START_RAD.items()}
    model = TableModel(data, asyncio.get_running_loop().time)
    address = null_modem(transport)
    server = modbus_server(TableTwinSetup(model, UNIT_IDS, {"profile": profile}, watchdog_s), address)

    def connected(is_up: bool) -> None:
        for handler in server.active_connections.values() if is_up else ():
            modem: Any = handler.transport
            modem.set_manipulator(lambda reply: [] if reply[6 if transport == "tcp" else 0] in mute else [reply])

    server.trace_connect = connected
    await server.serve_forever(background=True)
    table = driver(address, max_rate_rps=max_rate_rps)
    try:
        await table.open()
        yield table, model
    finally:
        table.close()
        await server.shutdown()


def virtually(main: Callable[[], Awaitable[None]]) -> None:
    async def run() -> None:
        await main()

    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        runner.run(run())


async def settle(table: ModbusTable, axis: str, limit_s: float = 60.0) -> None:
    async with asyncio.timeout(limit_s):
        while not (await table.status(axis)).target_reached:
            await asyncio.sleep(0.05)


def test_enabled_drives_hold_position(transport: str) -> None:
    async def main() -> None:
        async with twin(transport) as (table, model):
            before = await table.status("x")
            assert (before.enabled, before.fault, before.text) == (False, "", "switch on disabled")
            await table.enable()
            for axis in "xyz":
                status = await table.status(axis)
                assert (status.enabled, status.fault, status.text) == (True, "", "operation enabled")
            assert model.at_rest()
            await table.enable()  # once more does no harm

    virtually(main)


def test_homing_brings_every_axis_to_its_index_and_zeroes_its_encoder(transport: str) -> None:
    async def main() -> None:
        async with twin(transport) as (table, model):
            await table.enable()
            assert model.motion["x"].at(model.clock())[0] == START_RAD["x"]
            await table.home()
            for axis in "xyz":
                assert model.motion[axis].at(model.clock()) == (0.0, 0.0)
                state = await table.read(axis)
                assert (state.angle_rad, state.rate_rps) == (0.0, 0.0)
                assert (await table.status(axis)).enabled

    virtually(main)


def test_homing_keeps_to_the_largest_rate_of_an_axis(transport: str) -> None:
    async def main() -> None:
        async with twin(transport, max_rate_rps=2 * DEG) as (table, model):
            fastest_rps = 0.0

            async def watch() -> None:
                nonlocal fastest_rps
                while True:
                    fastest_rps = max(fastest_rps, abs(model.rate_rps("x")))
                    await asyncio.sleep(0.01)

            await table.enable()
            watching = asyncio.create_task(watch())
            await table.home()
            watching.cancel()
            assert fastest_rps == pytest.approx(2 * DEG, rel=1e-3)

    virtually(main)


@pytest.mark.parametrize("rate_dps", [20.0, -20.0, 0.5, 100.0, -0.001])
def test_a_jog_reads_back_its_rate_to_the_last_digit(transport: str, rate_dps: float) -> None:
    async def main() -> None:
        async with twin(transport) as (table, model):
            await table.enable()
            await table.home()
            await table.jog("y", rate_dps * DEG, 20 * DEG)
            await asyncio.sleep(10.0)
            state = await table.read("y")
            assert state.rate_rps == pytest.approx(rate_dps * DEG, abs=0.5001 * RATE_LSB_RPS)
            assert state.rate_rps == pytest.approx(model.rate_rps("y"), abs=0.5001 * RATE_LSB_RPS)
            assert model.rate_rps("x") == model.rate_rps("z") == 0.0
            truth = float(model.motion["y"].at(state.angle_t_ns * 1e-9)[0])
            assert state.angle_rad == pytest.approx(truth, abs=0.5001 * COUNT_RAD)

    virtually(main)


def test_a_ramp_is_as_steep_as_told(transport: str) -> None:
    async def main() -> None:
        async with twin(transport) as (table, model):
            await table.enable()
            await table.jog("z", 20 * DEG, 8 * DEG)
            began = asyncio.get_running_loop().time()
            await asyncio.sleep(1.0)
            elapsed = asyncio.get_running_loop().time() - began
            assert model.rate_rps("z") == pytest.approx(8 * DEG * elapsed, abs=0.5001 * ACCELERATION_LSB_RPS2 * elapsed)
            await asyncio.sleep(5.0)
            assert model.rate_rps("z") == pytest.approx(20 * DEG, abs=RATE_LSB_RPS)

    virtually(main)


@pytest.mark.parametrize("angle_deg", [90.0, -123.456, 1440.0, 0.01])
def test_a_move_arrives_at_its_angle(transport: str, angle_deg: float) -> None:
    async def main() -> None:
        async with twin(transport) as (table, model):
            await table.enable()
            await table.home()
            await table.move("x", angle_deg * DEG, 80 * DEG, 40 * DEG)
            assert not (await table.status("x")).target_reached
            await settle(table, "x")
            state = await table.read("x")
            assert state.rate_rps == 0.0
            assert state.angle_rad == pytest.approx(angle_deg * DEG, abs=0.5001 * COUNT_RAD)
            assert model.motion["x"].at(model.clock())[0] == pytest.approx(angle_deg * DEG, abs=0.5001 * COUNT_RAD)

    virtually(main)


def test_moves_may_follow_one_another_and_a_jog(transport: str) -> None:
    async def main() -> None:
        async with twin(transport) as (table, _):
            await table.enable()
            await table.home()
            await table.move("x", 30 * DEG, 50 * DEG, 40 * DEG)
            await settle(table, "x")
            await table.jog("x", -10 * DEG, 20 * DEG)
            await asyncio.sleep(2.0)
            await table.move("x", -5 * DEG, 50 * DEG, 40 * DEG)
            await settle(table, "x")
            assert (await table.read("x")).angle_rad == pytest.approx(-5 * DEG, abs=COUNT_RAD)

    virtually(main)


def test_stop_brings_turning_axes_to_rest_before_it_returns(transport: str) -> None:
    async def main() -> None:
        async with twin(transport) as (table, model):
            await table.enable()
            await table.home()
            for axis, rate in (("x", 90.0), ("z", -60.0)):
                await table.jog(axis, rate * DEG, 50 * DEG)
            await asyncio.sleep(4.0)
            angle, rate = model.motion["x"].at(model.clock())
            await table.stop()
            assert all(abs(model.rate_rps(axis)) <= 0.02 * DEG for axis in "xyz")
            await asyncio.sleep(1.0)
            assert model.at_rest()
            braked = rate * rate / (2 * MAX_ACCELERATION)
            assert model.motion["x"].at(model.clock())[0] - angle == pytest.approx(braked, abs=rate * 0.1)
            status = await table.status("x")
            assert (status.text, status.fault) == ("quick stop active", "")

    virtually(main)


def test_a_stopped_table_can_be_enabled_and_moved_again(transport: str) -> None:
    async def main() -> None:
        async with twin(transport) as (table, _):
            await table.enable()
            await table.home()
            await table.jog("x", 10 * DEG, 50 * DEG)
            await asyncio.sleep(2.0)
            await table.stop()
            await asyncio.sleep(1.0)
            await table.disable()
            assert (await table.status("x")).text == "ready to switch on"
            await table.enable()
            await table.move("x", 0.0, 50 * DEG, 40 * DEG)
            await settle(table, "x")
            assert (await table.read("x")).angle_rad == 0.0

    virtually(main)


def test_a_drive_that_holds_after_its_quick_stop_is_told_of_and_can_be_used_again(transport: str) -> None:
    async def main() -> None:
        async with twin(transport) as (table, model):
            await table.enable()
            await table.jog("y", 20 * DEG, 50 * DEG)
            await asyncio.sleep(1.0)
            assert "seen at rest" in await table.stop()
            status = await table.status("y")
            assert (status.enabled, status.fault) == (False, "")
            assert "axis y was left in quick stop active, energised and holding" in status.caution
            table.close()
            await table.open()  # the next run
            await table.reset_fault()
            await table.enable()
            assert (await table.status("y")).enabled

    virtually(main)


def test_a_tripped_axis_says_fault_and_its_table_is_not_enabled_until_it_is_reset(transport: str) -> None:
    async def main() -> None:
        async with twin(transport) as (table, model):
            await table.enable()
            await table.jog("y", 90 * DEG, 50 * DEG)
            await asyncio.sleep(4.0)
            model.trip("y", "fault input")
            assert "axis y is in fault reaction" in (await table.status("y")).fault
            await asyncio.sleep(3.0)
            assert model.at_rest()
            status = await table.status("y")
            assert not status.enabled
            assert "axis y is in fault" in status.fault
            assert (await table.status("x")).fault == ""
            with pytest.raises(DeviceFault, match="table: axis y is in fault"):
                await table.enable()
            await table.reset_fault()
            assert (await table.status("y")).fault == ""
            await table.enable()
            assert (await table.status("y")).enabled

    virtually(main)


@pytest.mark.parametrize(
    ("reason", "said"),
    [
        ("following error", "error code 0x0200, following error"),
        ("servo trip", "error code 0x0080, servo trip: over-current"),
        ("limit switch", r"internal limit active\): error code 0x0001"),
    ],
)
def test_a_trip_is_told_in_plain_words_with_the_drives_own_code(transport: str, reason: str, said: str) -> None:
    async def main() -> None:
        async with twin(transport) as (table, model):
            await table.enable()
            model.trip("y", reason)
            with pytest.raises(DeviceFault, match=said):
                await table.enable()
            await table.reset_fault()
            assert (await table.status("y")).text == "switch on disabled"

    virtually(main)


def test_a_drive_without_an_error_register_still_tells_its_fault(transport: str) -> None:
    async def main() -> None:
        registers = {name: register for name, register in PROFILE.registers.items() if name != "error_code"}
        old_firmware = replace(PROFILE, registers=registers)
        async with twin(transport, profile=old_firmware) as (table, model):
            model.trip("y", "fault input")
            assert (await table.status("y")).fault == "axis y is in fault (statusword 0x1418)"

    virtually(main)


def test_abort_stops_all_axes_at_once_whatever_they_do(transport: str) -> None:
    async def main() -> None:
        async with twin(transport) as (table, model):
            await table.enable()
            await table.jog("x", 90 * DEG, 50 * DEG)
            await table.jog("z", -60 * DEG, 50 * DEG)
            await asyncio.sleep(3.0)
            began = model.clock()
            await table.abort()
            await asyncio.sleep(0.1)
            assert model.at_rest()
            assert model.clock() - began < 90 / 50 + 0.3
            await table.enable()  # and it can go on

    virtually(main)


@pytest.mark.parametrize("way_out", ["stop", "abort"])
def test_the_way_out_reaches_every_axis_also_one_whose_replies_get_lost(transport: str, way_out: str) -> None:
    async def main() -> None:
        mute: set[int] = set()
        async with twin(transport, mute=mute) as (table, model):
            await table.enable()
            for axis in "xyz":
                await table.jog(axis, 30 * DEG, 50 * DEG)
            await asyncio.sleep(2.0)
            mute.add(UNIT_IDS["x"])
            with pytest.raises(LinkLost, match=r"axis x \(unit id 1\) does not answer"):
                await getattr(table, way_out)()
            await asyncio.sleep(1.0)
            assert model.at_rest()

    virtually(main)


def test_identify_names_the_make(transport: str) -> None:
    async def main() -> None:
        async with twin(transport) as (table, _):
            assert await table.identify() == Identity("Kinco FD/CD/JD")

    virtually(main)


def test_a_fault_during_homing_ends_it(transport: str) -> None:
    async def main() -> None:
        async with twin(transport) as (table, model):
            await table.enable()
            asyncio.get_running_loop().call_later(0.1, model.trip, "x", "fault input")
            with pytest.raises(DeviceFault, match="axis x is in fault"):
                await table.home()

    virtually(main)


def test_a_moving_axis_stops_when_its_master_falls_silent(transport: str) -> None:
    async def main() -> None:
        async with twin(transport, watchdog_s=1.0) as (table, model):
            await table.enable()
            await table.jog("x", 20 * DEG, 50 * DEG)
            await asyncio.sleep(0.9)
            assert model.rate_rps("x") == pytest.approx(20 * DEG, rel=1e-3)
            await asyncio.sleep(1.0)
            assert model.at_rest()
            assert not (await table.status("x")).enabled

    virtually(main)


def test_a_moving_axis_goes_on_while_its_master_speaks(transport: str) -> None:
    async def main() -> None:
        async with twin(transport, watchdog_s=1.0) as (table, model):
            await table.enable()
            await table.jog("x", 20 * DEG, 50 * DEG)
            for _ in range(25):
                await asyncio.sleep(0.8)
                await table.read("x")
            assert model.rate_rps("x") == pytest.approx(20 * DEG, rel=1e-3)

    virtually(main)


def test_without_a_watchdog_silence_stops_nothing(transport: str) -> None:
    async def main() -> None:
        async with twin(transport) as (table, model):
            await table.enable()
            await table.jog("x", 20 * DEG, 50 * DEG)
            await asyncio.sleep(100.0)
            assert model.rate_rps("x") == pytest.approx(20 * DEG, rel=1e-3)

    virtually(main)


def test_a_refused_value_names_register_and_code(transport: str) -> None:
    async def main() -> None:
        async with twin(transport) as (table, model):
            await table.enable()
            with pytest.raises(DeviceRefused, match=r"axis x .*0x6F00 \(target_rate\).*exception 3, illegal value"):
                await table.jog("x", 3 * MAX_RATE, 20 * DEG)
            assert model.at_rest()
            assert (await table.status("x")).enabled

    virtually(main)


def test_a_value_that_no_register_can_hold_is_refused_by_name(transport: str) -> None:
    async def main() -> None:
        async with twin(transport) as (table, _):
            await table.enable()
            with pytest.raises(DeviceRefused, match="axis x: target_position"):
                await table.move("x", 1e9, 10 * DEG, 20 * DEG)

    virtually(main)


def test_nobody_listening_is_a_lost_link() -> None:
    async def main() -> None:
        with pytest.raises(LinkLost, match="table: nothing answers at"):
            await driver((NULLMODEM_HOST, next(_wires))).open()

    virtually(main)


def test_a_server_that_goes_away_is_a_lost_link(transport: str) -> None:
    async def main() -> None:
        data = {"x": AxisData(MAX_RATE, MAX_ACCELERATION, COUNTS)}
        model = TableModel(data, asyncio.get_running_loop().time)
        address = null_modem(transport)
        server = modbus_server(TableTwinSetup(model, {"x": 1}, {"profile": PROFILE}, 0.0), address)
        await server.serve_forever(background=True)
        table = driver(address, {"x": 1})
        await table.open()
        await server.shutdown()
        with pytest.raises(LinkLost, match="table: "):
            await table.read("x")
        table.close()

    virtually(main)


def test_a_device_that_never_answers_is_a_lost_link() -> None:
    heard = []

    async def main() -> None:
        left = asyncio.Event()

        async def say_nothing(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            while data := await reader.read(1024):
                heard.append(data)
            writer.close()
            await writer.wait_closed()
            left.set()

        server = await asyncio.start_server(say_nothing, "127.0.0.1", 0)
        port = server.sockets[0].getsockname()[1]
        table = driver(("127.0.0.1", port), {"x": 7}, timeout_s=0.05)
        with pytest.raises(LinkLost, match=r"axis x \(unit id 7\) does not answer within 0.1 s"):
            await table.open()
        table.close()
        await left.wait()
        server.close()
        await server.wait_closed()

    with asyncio.Runner(loop_factory=ScaledLoop) as runner:
        runner.run(main())
    assert len(heard) == 2  # asked twice


def test_a_closed_port_is_a_lost_link() -> None:
    async def main() -> None:
        server = await asyncio.start_server(lambda _r, w: w.close(), "127.0.0.1", 0)
        port = server.sockets[0].getsockname()[1]
        server.close()
        await server.wait_closed()
        with pytest.raises(LinkLost, match=f"nothing answers at 127.0.0.1:{port}"):
            await driver(("127.0.0.1", port), timeout_s=0.5).open()

    with asyncio.Runner(loop_factory=ScaledLoop) as runner:
        runner.run(main())


def test_limits_are_those_of_the_axes() -> None:
    assert dict(driver(("127.0.0.1", 1)).limits) == dict.fromkeys("xyz", AxisLimits(MAX_RATE, MAX_ACCELERATION))
