"""Lexium 32 by its profile alone: high word first, two registers a value, access to be taken, node guarding."""

from __future__ import annotations

import asyncio
import itertools
import math
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import AsyncExitStack, asynccontextmanager

import pytest
from modbus_twin import modbus_server
from pymodbus.client import AsyncModbusTcpClient
from pymodbus.transport import NULLMODEM_HOST
from setups import setup_of

from drivers.errors import DeviceFault, DeviceRefused
from drivers.specs import AxisSetup
from drivers.tables.modbus.registers import DriveProfile, load_profile
from drivers.tables.modbus.table import ModbusTable
from drivers.types import AxisLimits, Identity
from sims.physics.table import AxisData, TableModel
from sims.wires.line_controller import TableTwinSetup
from station.run.event_loop.loops import VirtualLoop

DEG = math.pi / 180
COUNTS = 131072
LIMITS = AxisLimits(100 * DEG, 50 * DEG)
PROFILE = load_profile("lexium32")
_wires = itertools.count(90_000)


def virtually(main: Callable[[], Awaitable[None]]) -> None:
    async def run() -> None:
        await main()

    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        runner.run(run())


@asynccontextmanager
async def drives(profile: DriveProfile = PROFILE) -> AsyncIterator[tuple[ModbusTable, TableModel]]:
    """Serve three drives, each at an address of its own as unit 1, and give the driver, not yet opened."""
    data = {axis: AxisData(LIMITS.rate_rps, LIMITS.acceleration_rps2, COUNTS, 2 * DEG) for axis in "xyz"}
    model = TableModel(data, asyncio.get_running_loop().time)
    async with AsyncExitStack() as stack:
        axes = {}
        for axis in "xyz":
            address = (NULLMODEM_HOST, next(_wires))
            server = modbus_server(TableTwinSetup(model, {axis: 1}, {"profile": PROFILE}, 0.0), address)
            await server.serve_forever(background=True)
            stack.push_async_callback(server.shutdown)
            axes[axis] = AxisSetup(1, COUNTS, LIMITS, address)
        table = ModbusTable(setup_of("modbus", axes, 0.2, profile=profile), axes["x"].link or ("", 0))
        stack.callback(table.close)
        yield table, model


def test_a_table_of_three_drives_with_an_address_each_does_what_a_table_does() -> None:
    async def main() -> None:
        async with drives() as (table, model):
            await table.open()
            await table.enable()
            await table.home()
            assert all(model.motion[axis].at(model.clock()) == (0.0, 0.0) for axis in "xyz")
            await table.jog("y", -20.0004 * DEG, 25 * DEG)
            began = model.clock()
            await asyncio.sleep(0.4)
            assert model.rate_rps("y") == pytest.approx(-25 * DEG * (model.clock() - began), rel=1e-3)
            for _ in range(20):
                await asyncio.sleep(0.05)
                state = await table.read("y")
            lsb_rps = 2 * math.pi / 600000
            assert state.rate_rps == pytest.approx(-20.0004 * DEG, abs=0.5001 * lsb_rps)
            truth = float(model.motion["y"].at(state.angle_t_ns * 1e-9)[0])
            assert state.angle_rad == pytest.approx(truth, abs=0.5001 * 2 * math.pi / COUNTS)
            assert model.rate_rps("x") == model.rate_rps("z") == 0.0
            await table.move("z", 33.3 * DEG, 40 * DEG, 20 * DEG)
            while not (await table.status("z")).target_reached:
                await asyncio.sleep(0.05)
                await table.read("y")
                await table.read("x")
            assert (await table.read("z")).angle_rad == pytest.approx(33.3 * DEG, abs=2 * math.pi / COUNTS)
            await table.stop()
            await asyncio.sleep(0.1)
            assert model.at_rest()
            await table.disable()
            assert (await table.status("y")).text == "ready to switch on"

    virtually(main)


def test_opening_takes_access_and_sets_scales_and_the_guard_and_says_who_it_is() -> None:
    async def main() -> None:
        port = next(_wires) + 1
        async with drives() as (table, _):
            await table.open()
            assert await table.identify() == Identity("Schneider Lexium 32", "", "x 1, y 1, z 1")
            client = AsyncModbusTcpClient(NULLMODEM_HOST, port=port, timeout=0.2, retries=0, reconnect_delay=0)
            await client.connect()
            for address, words in {282: [0, 1], 1602: [0, 10000], 1604: [0, 1], 5644: [0, 2000]}.items():
                assert (await client.read_holding_registers(address, count=2, device_id=1)).registers == words
            client.close()

    virtually(main)


def test_a_drive_that_one_has_not_got_access_to_refuses_by_its_code_and_does_not_move() -> None:
    without = DriveProfile(
        name=PROFILE.name, registers=PROFILE.registers, commands=PROFILE.commands, homing_method=PROFILE.homing_method
    )

    async def main() -> None:
        async with drives(without) as (table, model):
            await table.open()
            with pytest.raises(DeviceRefused, match=r"axis x .*refuses to write 0x1B02 \(controlword\).*exception 4"):
                await table.enable()
            assert model.at_rest()
            assert not (await table.status("x")).enabled

    virtually(main)


def test_a_turning_drive_whose_master_falls_silent_guards_itself_and_says_so() -> None:
    async def main() -> None:
        async with drives() as (table, model):
            await table.open()
            await table.enable()
            await table.jog("x", 20 * DEG, 50 * DEG)
            for _ in range(60):
                await asyncio.sleep(0.05)
                for axis in "xyz":
                    await table.read(axis)
            assert model.rate_rps("x") == pytest.approx(20 * DEG, rel=1e-4)
            await asyncio.sleep(4.0)
            assert model.at_rest()
            status = await table.status("x")
            assert not status.enabled
            assert "axis x is in fault" in status.fault
            assert "error code 0xB102, node guarding" in status.fault
            with pytest.raises(DeviceFault, match="node guarding"):
                await table.enable()
            await table.reset_fault()
            await table.enable()

    virtually(main)


@pytest.mark.parametrize(
    ("reason", "said"),
    [
        ("following error", "error code 0xA320, following error"),
        ("limit switch", "internal limit active).*error code 0xA302, limit switch"),
        ("servo trip", "error code 0x2300, servo trip"),
        ("fault input", "error code 0x2300"),
    ],
)
def test_a_trip_is_told_in_plain_words_with_the_drives_own_code(reason: str, said: str) -> None:
    async def main() -> None:
        async with drives() as (table, model):
            await table.open()
            await table.enable()
            model.trip("y", reason)
            with pytest.raises(DeviceFault, match=said.replace("active)", r"active\)")):
                await table.enable()

    virtually(main)
