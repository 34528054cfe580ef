"""A table and gyros written against libmodbus alone: a whole run to its verdict, and wires that misbehave."""

from __future__ import annotations

import asyncio
import json
import math
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from functools import partial
from pathlib import Path

import pytest
from misbehaving_wire import COMMON, MODBUS, Proxy
from serial_wire import wire
from setups import setup_of
from strangers import RateTable, compiled, rate_table
from support import station
from test_misbehaving_wires import PHASES, TIMEOUT_S, UNIT_IDS, run_cases

from drivers.specs import AxisSetup
from drivers.tables.modbus.line import Address, SerialPort
from drivers.tables.modbus.registers import load_profile
from drivers.tables.modbus.table import ModbusTable
from drivers.types import AxisLimits

DEG = math.pi / 180
COUNTS = 65536
LIMITS = AxisLimits(100 * DEG, 50 * DEG)
K_PPM, B_DPS = (4000, -3000, 2000), (0.08, -0.05, 0.03)
BENCH = """\
name = "libmodbus, and gyros in lines"
[site]
latitude = "45 deg"
[table]
protocol = "modbus"
profile = "kinco"
link = "tcp://127.0.0.1:{port}"
[table.x]
unit_id = 1
counts_per_turn = 65536
max_rate = "100 deg/s"
max_acceleration = "50 deg/s2"
[table.y]
unit_id = 2
counts_per_turn = 65536
max_rate = "100 deg/s"
max_acceleration = "50 deg/s2"
[table.z]
unit_id = 3
counts_per_turn = 65536
max_rate = "100 deg/s"
max_acceleration = "50 deg/s2"
[[imu]]
name = "gyros"
protocol = "described"
description = "csv"
array = "triad"
rate = "100 Hz"
link = "serial://{gyros}"
[imu.datasheet]
arw = "0.005 deg/s/rtHz"
[limits]
scale_factor_error = "10000 ppm"
bias = "0.5 deg/s"
misalignment = "0.5 deg"
sd_scale_factor_error = "1000 ppm"
nis_low = 0.8
nis_high = 1.2
lost = "1 %"
[undeclared]
effects = "none"
"""
SCRIPT = """\
step = [
    { kind = "rest", duration = "5 s" },
    { kind = "rotate", axis = "x", rate = "60 deg/s", duration = "7.2 s", acceleration = "50 deg/s2" },
    { kind = "rotate", axis = "y", rate = "-60 deg/s", duration = "7.2 s", acceleration = "50 deg/s2" },
    { kind = "rotate", axis = "z", rate = "60 deg/s", duration = "7.2 s", acceleration = "50 deg/s2" },
    { kind = "rest", duration = "5 s" },
]
"""


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> str:
    options = ("-I/usr/include/modbus", "-lmodbus", "-lm")
    return compiled(tmp_path_factory.mktemp("table"), "rate_table", "modbus.h", "libmodbus-dev", *options)


def test_a_run_to_its_verdict(program: str, tmp_path: Path) -> None:
    """The estimates are the errors that the gyros really have."""
    (tmp_path / "script.toml").write_text(SCRIPT)
    with rate_table(program, tmp_path) as table:
        (tmp_path / "bench.toml").write_text(BENCH.format(port=table.port, gyros=table.gyros))
        words = ["run", "--bench", "bench.toml", "--script", "script.toml", "--json", "-o", "run.h5"]
        said = json.loads(station(*words, cwd=tmp_path).stdout)
        if "this computer fell behind" in said["reason"]:  # real time, on a host that does other things as well
            said = json.loads(station(*words[:-1], "again.h5", cwd=tmp_path).stdout)
        assert table.at_rest()
    assert said["outcome"] == "PASS", said["reason"]
    assert said["lost"] == 0
    for gyro, k_ppm, b_dps in zip(said["gyros"], K_PPM, B_DPS, strict=True):
        for name, true in {"k": k_ppm * 1e-6, "b_rps": b_dps * DEG, "sigma_j_rad": 0.0, "sigma_k_rad": 0.0}.items():
            assert abs(gyro[name] - true) < 5 * gyro["sd"][name], (name, gyro)


@pytest.mark.parametrize("cycle_s", [0.0, 0.002, 0.010])
def test_it_is_homed_again_and_again_while_it_stays_enabled(program: str, tmp_path: Path, cycle_s: float) -> None:
    async def main() -> None:
        with rate_table(program, tmp_path, cycle_s=cycle_s) as table:
            drives = {axis: AxisSetup(unit_id, COUNTS, LIMITS) for axis, unit_id in UNIT_IDS.items()}
            driver = ModbusTable(
                setup_of("modbus", drives, TIMEOUT_S, profile=load_profile("kinco")), ("127.0.0.1", table.port)
            )
            await driver.open()
            await driver.enable()
            for _ in range(3):
                await driver.home()
                assert table.at_rest()
                for angle_rad in table.truth()[:3]:
                    assert math.remainder(angle_rad, math.tau) == pytest.approx(0.0, abs=1e-4)
                await driver.move("y", -9 * DEG, 60 * DEG, 50 * DEG)
                async with asyncio.timeout(5):
                    while not (await driver.status("y")).target_reached:
                        await asyncio.sleep(0.02)
                assert (await driver.read("y")).angle_rad == pytest.approx(-9 * DEG, abs=1e-3)
            await driver.stop()
            driver.close()

    asyncio.run(main())


def test_wires_that_misbehave_leave_it_at_rest(program: str, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Of 33 kinds each strikes in another phase than its neighbours, between our driver and the table."""
    cases = [("modbus", kind, PHASES[place % len(PHASES)]) for place, kind in enumerate(COMMON + MODBUS)]
    found = run_cases(cases, caplog, partial(behind_proxy, program, tmp_path))
    assert [str(one) for one in found if one.wrong] == []


@asynccontextmanager
async def behind_proxy(
    program: str, folder: Path, protocol: str, proxy: Proxy
) -> AsyncIterator[tuple[ModbusTable, RateTable]]:
    """Put our driver, not yet opened, and the table at the two ends of a proxy."""
    # In a thread: the loop must not stand still for the other cases while programs start and end.
    running = rate_table(program, folder)
    table = await asyncio.to_thread(running.__enter__)
    try:
        proxy.port = table.port
        await proxy.listen()
        drives = {axis: AxisSetup(unit_id, COUNTS, LIMITS) for axis, unit_id in UNIT_IDS.items()}
        driver = ModbusTable(setup_of("modbus", drives, TIMEOUT_S, profile=load_profile("kinco")), proxy.where)
        try:
            yield driver, table
        finally:
            driver.close()
            await proxy.close()
    finally:
        await asyncio.to_thread(running.__exit__, None, None, None)


def test_one_drive_on_a_serial_line(program: str, tmp_path: Path) -> None:
    """It is homed, moved, jogged and stopped over RTU; what it says is what it does."""

    async def main() -> None:
        with wire() as (near, far), rate_table(program, tmp_path, far, "115200", "1") as table:
            address: Address = SerialPort(near, 115200)
            drives = {"x": AxisSetup(1, COUNTS, LIMITS)}
            driver = ModbusTable(setup_of("modbus", drives, 0.5, profile=load_profile("kinco")), address)
            await driver.open()
            await driver.enable()
            await driver.home()
            assert table.truth()[0] == pytest.approx(0.0, abs=1e-4)
            await driver.move("x", 10 * DEG, 30 * DEG, 50 * DEG)
            async with asyncio.timeout(5):
                while not (await driver.status("x")).target_reached:
                    await asyncio.sleep(0.02)
            assert table.truth()[0] == pytest.approx(10 * DEG, abs=1e-4)
            await driver.jog("x", -12.5 * DEG, 50 * DEG)
            await asyncio.sleep(0.5)
            assert (await driver.read("x")).rate_rps == pytest.approx(table.truth()[3], rel=1e-3)
            await driver.stop()
            assert table.at_rest()
            await driver.disable()
            driver.close()
            await asyncio.sleep(0)

    asyncio.run(main())
