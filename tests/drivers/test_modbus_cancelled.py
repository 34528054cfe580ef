"""What is asked after a request that was cancelled is heard: a stop comes in the middle of a reading."""

from __future__ import annotations

import asyncio
import random
import time

from setups import setup_of
from support import TwinProcess

from drivers.specs import AxisSetup
from drivers.tables.modbus.registers import load_profile
from drivers.tables.modbus.table import ModbusTable
from drivers.types import AxisLimits

TIMEOUT_S = 0.5


def test_a_request_after_a_cancelled_one_is_answered_at_once() -> None:
    async def slowest_s(link: str) -> float:
        chance = random.Random(1)
        host, port = link.removeprefix("tcp://").split(":")
        axes = {axis: AxisSetup(unit, 65536, AxisLimits(1.0, 1.0)) for axis, unit in zip("xyz", (1, 2, 3), strict=True)}
        table = ModbusTable(setup_of("modbus", axes, TIMEOUT_S, profile=load_profile("kinco")), (host, int(port)))
        await table.open()
        took_s = []
        for _ in range(200):
            reading = asyncio.create_task(table.read("x"))
            await asyncio.sleep(chance.uniform(0, 0.003))
            reading.cancel()
            await asyncio.gather(reading, return_exceptions=True)
            began_s = time.monotonic()
            await table.status("z")
            took_s.append(time.monotonic() - began_s)
        table.close()
        return max(took_s)

    with TwinProcess() as twin:
        assert asyncio.run(slowest_s(twin.links["table"])) < 0.8 * TIMEOUT_S  # a lost request costs a whole one
