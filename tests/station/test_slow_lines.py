"""What a slow line carries in a run it also carries at its end: the table is stopped and seen at rest."""

from __future__ import annotations

import asyncio
import math
from pathlib import Path

import pytest
from faults import BENCHES

from station.bench.bench import load_bench
from station.opening import open_bench, with_links
from station.run.event_loop.loops import VirtualLoop
from station.run.outcome import Outcome
from station.run.session import Session
from station.scripts.script import Rest, Rotate, Script

DEG = math.pi / 180


TO_ITS_END, IN_MOTION = False, True


@pytest.mark.parametrize(
    ("one_way_ms", "stopped"),
    [
        pytest.param(190, TO_ITS_END, id="190-to its end"),
        pytest.param(75, IN_MOTION, id="75-stopped in motion"),
        pytest.param(75, TO_ITS_END, id="75-to its end", marks=pytest.mark.full),
        pytest.param(150, TO_ITS_END, id="150-to its end", marks=pytest.mark.full),
        pytest.param(150, IN_MOTION, id="150-stopped in motion", marks=pytest.mark.full),
        pytest.param(190, IN_MOTION, id="190-stopped in motion", marks=pytest.mark.full),
    ],
)
def test_a_line_that_runs_a_script_also_stops_it(tmp_path: Path, one_way_ms: int, stopped: bool) -> None:
    path = tmp_path / "bench.toml"
    fault = f'\n[twin.fault]\nlatency = "{one_way_ms} ms"\n'
    path.write_text((BENCHES / "two_triads.toml").read_text() + fault)
    bench = with_links(load_bench(path), {}, ["first"])
    turn = Rotate(bench.table.gimbals[-1], 20 * DEG, 12.0, 20 * DEG, "turn")

    async def main() -> str:
        async with open_bench(bench) as opened:
            session = Session(opened, Script("slow", (Rest(1.0), turn, Rest(2.0))), tmp_path / "r.h5")

            async def stop() -> None:
                while session.snapshot().label != "turn":
                    await asyncio.sleep(0.1)
                await asyncio.sleep(4.0)
                session.stop()

            stopping = asyncio.ensure_future(stop()) if stopped else None
            verdict = (await session.run()).verdict
            if stopping is not None:
                await stopping
            assert opened.at_rest()
            ends_as = (Outcome.ABORTED,) if stopped else (Outcome.PASS, Outcome.FAIL)
            assert verdict.outcome in ends_as, verdict.reason
            return verdict.reason

    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        reason = runner.run(main())
    if stopped:
        assert reason == "stopped by the operator in step 'turn'"
