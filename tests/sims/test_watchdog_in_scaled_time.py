"""A twin's watchdog waits for a host: it is as patient as the host's clock says, however fast the loop's runs."""

from __future__ import annotations

import asyncio
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from station.bench.bench import Bench, load_bench
from station.opening import open_bench, serve_twins
from station.run.event_loop.loops import ScaledLoop, VirtualLoop

BENCHES = Path(__file__).parents[1] / "data" / "benches"
WATCHDOG_S = 0.2
RATE_RPS, ACCELERATION_RPS2 = np.radians(20.0), np.radians(40.0)
BRAKED_S = 1.0


def bench_of(protocol: str) -> Bench:
    """Return a bench with such a table; an ACUTROL's driver is never silent while an axis turns."""
    bench = load_bench(BENCHES / "galil_xsens.toml" if protocol == "galil" else None)
    assert bench.table.protocol == protocol
    return replace(bench, twin=replace(bench.twin, watchdog_s=WATCHDOG_S))


@pytest.mark.parametrize("time_scale", [1.0, 10.0])
@pytest.mark.parametrize("protocol", ["modbus", "galil"])
def test_a_twin_in_memory_stops_when_a_host_is_silent_for_longer_than_that_by_its_own_clock(
    protocol: str, time_scale: float
) -> None:
    bench = bench_of(protocol)

    async def main() -> None:
        async with open_bench(bench, time_scale=time_scale) as opened:
            table = opened.table
            await table.open()
            await table.enable()
            await table.jog("z", RATE_RPS, ACCELERATION_RPS2)
            await asyncio.sleep(0.9 * WATCHDOG_S * time_scale)
            assert not opened.at_rest()
            await table.read("z")  # from now on nothing is said
            await asyncio.sleep(0.9 * WATCHDOG_S * time_scale)
            assert not opened.at_rest()
            await asyncio.sleep(0.2 * WATCHDOG_S * time_scale + BRAKED_S)
            assert opened.at_rest()
            table.close()

    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        runner.run(main())


@pytest.mark.parametrize("protocol", ["modbus", "galil"])
def test_twins_on_real_ports_say_how_long_that_is_by_the_loops_clock(protocol: str) -> None:
    said: list[dict[str, object]] = []

    async def main() -> None:
        ready = asyncio.Event()

        def announce(line: str) -> None:
            said.append(json.loads(line))
            if said[-1].get("ready"):
                ready.set()

        bench = bench_of(protocol)
        twins = asyncio.create_task(serve_twins(bench, time_scale=10.0, host="127.0.0.1", port=0, announce=announce))
        await ready.wait()
        twins.cancel()
        await asyncio.gather(twins, return_exceptions=True)

    with asyncio.Runner(loop_factory=lambda: ScaledLoop(10.0)) as runner:
        runner.run(main())
    assert said[0]["device"] == "table"
    assert said[0]["watchdog_s"] == 10 * WATCHDOG_S


@pytest.mark.parametrize("protocol", ["modbus", "galil"])
def test_a_table_has_no_watchdog_unless_the_bench_says_so(protocol: str) -> None:
    bench = load_bench(BENCHES / "galil_xsens.toml" if protocol == "galil" else None)

    async def main() -> None:
        async with open_bench(bench) as opened:
            await opened.table.open()
            await opened.table.enable()
            await opened.table.jog("z", RATE_RPS, ACCELERATION_RPS2)
            await asyncio.sleep(60.0)
            assert not opened.at_rest()
            opened.table.close()
            await asyncio.sleep(60.0)
            assert not opened.at_rest()

    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        runner.run(main())
