"""A twin of drives on Modbus that is unplugged: connections end, new ones are refused until it is plugged in again."""

from __future__ import annotations

import asyncio
import json
import os
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

from drivers.errors import LinkLost
from drivers.links.reopen import BackOff, reopen
from drivers.protocols import Turntable
from station.bench.bench import Bench, load_bench
from station.opening import open_bench, serve_twins, with_links
from station.run.event_loop.loops import VirtualLoop

BENCH = Path(__file__).parents[1] / "data" / "benches" / "rtu_stim300.toml"
OUT_S, BACK_S = 0.8, 2.0


def unplugged(folder: Path, wire: str) -> Bench:
    """Return a bench whose table is unplugged for a while, served on a wire."""
    text = BENCH.read_text().replace('table = "serial"', f'table = "{wire}"')
    path = folder / "bench.toml"
    path.write_text(text + f'\n[twin.fault]\nunplug = "{OUT_S} s"\nreplug = "{BACK_S} s"\n')
    return load_bench(path)


@asynccontextmanager
async def served(bench: Bench) -> AsyncIterator[str]:
    """Serve the twins of a bench; yield the link of the table."""
    link: asyncio.Future[str] = asyncio.get_running_loop().create_future()

    def announce(line: str) -> None:
        said = json.loads(line)
        if said.get("device") == "table":
            link.set_result(said["link"])

    serving = asyncio.create_task(serve_twins(bench, time_scale=1.0, host="127.0.0.1", port=0, announce=announce))
    try:
        yield await link
    finally:
        serving.cancel()
        await asyncio.gather(serving, return_exceptions=True)


async def lose_and_reopen(table: Turntable) -> None:
    """See that the link is lost, cannot be opened while the plug is out, and can thereafter."""
    loop = asyncio.get_running_loop()
    began_s = loop.time()
    await table.open()
    with pytest.raises(LinkLost):
        await read_for_ever(table)
    assert loop.time() - began_s < OUT_S + 0.5
    with pytest.raises(LinkLost, match="the connection to .* is gone"):
        await table.read("z")
    table.close()
    with pytest.raises(LinkLost, match="nothing answers at|cannot open serial port"):
        await table.open()
    assert await reopen(table, BackOff(0.2, 0.2, 10.0)) >= 2
    assert BACK_S - 0.1 < loop.time() - began_s < BACK_S + 1.5
    assert (await table.read("z")).rate_rps == 0.0
    table.close()


async def read_for_ever(table: Turntable) -> None:
    while True:
        await table.read("z")
        await asyncio.sleep(0.01)


def test_in_memory(tmp_path: Path) -> None:
    bench = unplugged(tmp_path, "tcp")

    async def main() -> None:
        async with open_bench(bench) as opened:
            await lose_and_reopen(opened.table)

    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        runner.run(main())


@pytest.mark.parametrize("wire", ["tcp", "serial"])
@pytest.mark.skipif(os.name != "posix", reason="pseudo-terminals are POSIX only")
def test_on_a_real_wire(tmp_path: Path, wire: str) -> None:
    bench = unplugged(tmp_path, wire)

    async def main() -> None:
        async with served(bench) as link, open_bench(with_links(bench, {"table": link}, [])) as opened:
            await lose_and_reopen(opened.table)

    asyncio.run(main())


def test_a_bench_that_is_closed_while_unplugged_leaves_nothing_behind(tmp_path: Path) -> None:
    bench = unplugged(tmp_path, "tcp")

    async def main() -> None:
        async with open_bench(bench) as opened:
            await opened.table.open()
            await asyncio.sleep((OUT_S + BACK_S) / 2)
            opened.table.close()
        async with open_bench(bench) as opened:
            await opened.table.open()
            await asyncio.sleep(2 * BACK_S)
            opened.table.close()

    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        runner.run(main())
