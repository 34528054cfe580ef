"""An axis that turns though nobody told it to: a fault within a second, with every axis stopped."""

from __future__ import annotations

import asyncio
import math
import re
from pathlib import Path

import h5py
import pytest
from faults import BENCHES

from station.bench.bench import Bench, load_bench
from station.opening import open_bench
from station.run.event_loop.loops import VirtualLoop
from station.run.outcome import Outcome
from station.run.session import Result, RunOptions, Session
from station.scripts.script import Rest, Script, load_script

SCRIPT = """
[[step]]
kind = "rest"
duration = "4 s"
[[step]]
kind = "rotate"
axis = "{driven}"
rate = "20 deg/s"
duration = "{turn} s"
acceleration = "20 deg/s2"
[[step]]
kind = "rest"
duration = "4 s"
"""


def run(folder: Path, bench: Bench, turn: int, time_scale: float = 1.0) -> Result:
    (folder / "script.toml").write_text(SCRIPT.format(driven=bench.table.gimbals[-1], turn=turn))

    async def main() -> Result:
        script, options = load_script(folder / "script.toml"), RunOptions(time_scale=time_scale)
        async with open_bench(bench, time_scale=time_scale) as opened:
            result = await Session(opened, script, folder / "r.h5", options).run()
            await asyncio.sleep(0.01)
            assert opened.at_rest()
            return result

    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        return runner.run(main())


def bench_with(folder: Path, name: str, fault: str) -> Bench:
    path = folder / "bench.toml"
    path.write_text(f"{(BENCHES / name).with_suffix('.toml').read_text()}\n[twin.fault]\n{fault}\n")
    return load_bench(path)


@pytest.mark.parametrize("at_s", [3.0, 8.0], ids=["at rest", "while another turns"])
@pytest.mark.parametrize(
    ("name", "within_s"),
    # A Galil tells the mean rate of the last 0.25 s: it stands so much sooner than it is seen to.
    [("acutrol_vectornav", 1.0), ("galil_j1939", 1.25), ("rtu_stim300", 1.0), ("two_triads", 1.0)],
)
def test_an_axis_that_turns_by_itself_is_a_fault_within_a_second(
    tmp_path: Path, name: str, within_s: float, at_s: float
) -> None:
    axis = load_bench((BENCHES / name).with_suffix(".toml")).table.gimbals[0]
    result = run(tmp_path, bench_with(tmp_path, name, f'axis = "{axis}"\nat = "{at_s} s"\nkind = "runaway"'), 8)
    assert result.verdict.outcome is Outcome.FAULT
    assert re.match(
        rf"table: axis {axis} turns at \d+\.\d deg/s; it was told to (stand|turn at up to 20.0 deg/s)",
        result.verdict.reason,
    ), result.verdict.reason
    with h5py.File(result.recording) as file:
        assert file["events/text"][-1] == b"table at rest"
        assert at_s < file["events/t_ns"][-1] * 1e-9 < at_s + within_s


@pytest.mark.parametrize("name", ["acutrol_vectornav", "galil_j1939", "rtu_stim300"])
def test_an_axis_at_home_that_turns_on_while_another_homes_is_a_fault_within_a_second(
    tmp_path: Path, name: str
) -> None:
    bench = bench_with(tmp_path, name, 'axis = "x"\nat = "7 s"\nkind = "runaway"')

    async def main() -> tuple[Result, float]:
        async with open_bench(bench) as opened:
            table, loop = opened.table, asyncio.get_running_loop()
            await table.open()
            await table.enable()
            await table.jog("z", math.radians(60.0), math.radians(50.0))
            await asyncio.sleep(2.0)
            await table.stop()
            await table.disable()
            table.close()
            result = await Session(opened, Script("rest", (Rest(1.0),)), tmp_path / "r.h5").run()
            await asyncio.sleep(0.01)
            assert opened.at_rest()
            return result, loop.time()

    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        result, ended_s = runner.run(main())
    assert re.match(r"table: axis x turns at \d+\.\d deg/s; it was told to stand", result.verdict.reason)
    assert 7.0 < ended_s < 8.25


@pytest.mark.parametrize("name", ["galil_xsens", "rtu_stim300", "two_triads"])
def test_limits_that_wait_for_a_host_leave_devices_their_time_when_all_is_slow(tmp_path: Path, name: str) -> None:
    bench = load_bench((BENCHES / name).with_suffix(".toml"))
    assert run(tmp_path, bench, 4, time_scale=0.01).verdict.outcome is Outcome.FAIL  # of its sigmas: it is short
