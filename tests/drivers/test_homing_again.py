"""Homing on drives that stay enabled: what they report of the homing before is not taken for the new one."""

from __future__ import annotations

import asyncio
import itertools
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager

import pytest
from modbus_twin import modbus_server
from pymodbus.transport import NULLMODEM_HOST
from setups import setup_of
from turntable_rigs import COUNTS, DEG, LIMITS, model_of, settle, virtually

from drivers.errors import DeviceRefused
from drivers.specs import AxisSetup
from drivers.tables.modbus.line import Address, SerialPort
from drivers.tables.modbus.registers import load_profile
from drivers.tables.modbus.table import ModbusTable
from sims.physics.table import TableModel
from sims.wires.line_controller import TableTwinSetup

PROFILE, UNIT_IDS = load_profile("kinco"), {"x": 1, "y": 2, "z": 3}
CONTROLWORD, START, ENABLE = 0x3100, 0x1F, 0x0F
_wires = itertools.count(40_000)


@asynccontextmanager
async def drives(
    transport: str, cycle_s: float, trace: Callable[[bool, bytes], bytes] | None = None
) -> AsyncIterator[tuple[ModbusTable, TableModel]]:
    """Serve three drives that sample their controlword every ``cycle_s``; ``trace`` may change what is on the wire."""
    model = model_of("xyz", COUNTS["modbus"])
    number = next(_wires)
    address: Address = (
        (NULLMODEM_HOST, number) if transport == "tcp" else SerialPort(f"socket://{NULLMODEM_HOST}:{number}")
    )
    server = modbus_server(TableTwinSetup(model, UNIT_IDS, {"profile": PROFILE}, 0.0, cycle_s=cycle_s), address)
    if trace is not None:
        server.trace_packet = trace
    await server.serve_forever(background=True)
    axes = {axis: AxisSetup(unit_id, COUNTS["modbus"], LIMITS) for axis, unit_id in UNIT_IDS.items()}
    table = ModbusTable(setup_of("modbus", axes, 0.2, profile=PROFILE), address)
    try:
        await table.open()
        await table.enable()
        yield table, model
    finally:
        table.close()
        await server.shutdown()


@pytest.mark.parametrize("transport", ["tcp", "rtu"])
@pytest.mark.parametrize("cycle_s", [0.0, 0.0002, 0.002, 0.010])
def test_homing_on_a_table_that_stays_enabled_ends_at_home_every_time(transport: str, cycle_s: float) -> None:
    async def main() -> None:
        async with drives(transport, cycle_s) as (table, model):
            for _ in range(3):
                await table.home()
                for axis, angle in (("x", 40 * DEG), ("y", 0.0), ("z", -390 * DEG)):  # y stays at home
                    assert model.motion[axis].settled(model.clock())
                    assert model.encoder_turns(axis) == pytest.approx(0.0, abs=2 / COUNTS["modbus"])
                    await table.move(axis, angle, 60 * DEG, 50 * DEG)
                    await settle(table, axis)
                    assert (await table.read(axis)).angle_rad == pytest.approx(angle, abs=0.02 * DEG)

    virtually(main)


@pytest.mark.parametrize("cycle_s", [0.0, 0.002, 0.010])
def test_moves_that_follow_each_other_at_once_are_all_taken(cycle_s: float) -> None:
    async def main() -> None:
        async with drives("tcp", cycle_s) as (table, _):
            await table.home()
            for target in (5 * DEG, -5 * DEG, 2 * DEG):
                await table.move("x", target, 60 * DEG, 50 * DEG)
                await settle(table, "x")
                assert (await table.read("x")).angle_rad == pytest.approx(target, abs=0.02 * DEG)

    virtually(main)


def test_a_drive_that_never_takes_the_start_is_refused_in_words() -> None:
    deaf = False
    changed: set[bytes] = set()  # transaction numbers

    def trace(sending: bool, data: bytes) -> bytes:
        """Have drives echo the start of a homing and see it without the start bit."""
        start = not sending and data[7:12] == bytes((6, CONTROLWORD >> 8, CONTROLWORD & 0xFF, 0, START))
        if start:
            changed.add(data[:2])
        if deaf and (start or (sending and data[:2] in changed)):
            return data[:11] + bytes((START if sending else ENABLE,))
        return data

    async def main() -> None:
        nonlocal deaf
        async with drives("tcp", 0.002, trace) as (table, _):
            await table.home()
            await table.move("y", 40 * DEG, 60 * DEG, 50 * DEG)
            await settle(table, "y")
            deaf = True
            began_s = asyncio.get_running_loop().time()
            with pytest.raises(DeviceRefused, match=r"axis y did not start homing within 2 s"):
                await table.home()
            assert asyncio.get_running_loop().time() - began_s < 3.0

    virtually(main)
