"""Readings that stop to tell the truth while an axis turns: the table stands within 1.5 s; and no false alarm."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable
from functools import cache
from pathlib import Path

import h5py
import pytest
from faults import BENCHES

from station.bench.bench import Bench, load_bench
from station.opening import open_bench
from station.run.event_loop.loops import VirtualLoop
from station.run.outcome import Outcome
from station.run.session import Result, RunOptions, Session
from station.run.uncommanded import AT_REST_S
from station.scripts.script import Move, Rest, Rotate, Script, check

DEG = math.pi / 180
PROTOCOLS = ("acutrol_vectornav", "galil_j1939", "rtu_stim300", "two_triads")
SHORT_OF_PROTOCOLS = [*PROTOCOLS[:-1], pytest.param(PROTOCOLS[-1], marks=pytest.mark.full)]
"""The last has the driver of the one before."""
KINDS = ("frozen", "frozen angle", "zeros", "zero angle", "zero rate")


def run(folder: Path, bench: Bench, script: Script) -> tuple[Result, float]:
    """Run a script; return its result, and when on the loop's clock the table had last turned."""

    async def main() -> tuple[Result, float]:
        loop, turned_s = asyncio.get_running_loop(), 0.0
        async with open_bench(bench) as opened:

            async def watch() -> None:
                nonlocal turned_s
                while True:
                    if not opened.at_rest():
                        turned_s = loop.time()
                    await asyncio.sleep(0.005)

            watcher = loop.create_task(watch())
            result = await Session(opened, script, folder / "r.h5", RunOptions()).run()
            watcher.cancel()
            assert opened.at_rest()
            return result, turned_s

    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        return runner.run(main())


def bench_with(folder: Path, name: str, fault: str = "") -> Bench:
    path = folder / "bench.toml"
    path.write_text(f"{(BENCHES / name).with_suffix('.toml').read_text()}\n{fault}\n")
    return load_bench(path)


@pytest.fixture(scope="module")
def begun_s(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], float]:
    """Return when on the loop's clock a first step of rest begins on a bench without faults."""

    @cache
    def begun(name: str) -> float:
        folder = tmp_path_factory.mktemp(name)
        result, _ = run(folder, bench_with(folder, name), Script("begin", (Rest(1.0),)))
        with h5py.File(result.recording) as file:
            texts = list(file["events/text"][()])
            return float(file["events/t_ns"][texts.index(b"script begins")]) * 1e-9

    return begun


@pytest.mark.parametrize(
    "after_s",
    [
        pytest.param(0.0, id="at the start", marks=pytest.mark.full),
        pytest.param(0.25, id="ramp", marks=pytest.mark.full),
        pytest.param(1.5, id="steady"),
    ],
)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", SHORT_OF_PROTOCOLS)
def test_the_table_stands_soon_after_its_readings_do_not_change_any_more(
    tmp_path: Path, begun_s: Callable[[str], float], name: str, kind: str, after_s: float
) -> None:
    axis = bench_with(tmp_path, name).table.gimbals[-1]
    turn = Rotate(axis, 20 * DEG, 19.0, 20 * DEG, "turn")
    script = Script("freeze", (Rest(1.0), turn, Rest(1.0)))
    frozen_s = begun_s(name) + 1.0 + after_s
    fault = f'[twin.fault]\naxis = "{axis}"\nat = "{frozen_s} s"\nkind = "{kind}"'
    result, turned_s = run(tmp_path, bench_with(tmp_path, name, fault), script)
    assert result.verdict.outcome is Outcome.FAULT, result.verdict.reason
    assert turned_s - frozen_s < AT_REST_S, result.verdict.reason
    assert "keeps turning" not in result.verdict.reason
    assert f"axis {axis} report" in result.verdict.reason


@pytest.mark.parametrize("name", SHORT_OF_PROTOCOLS)
def test_what_is_slow_small_steep_or_late_is_no_fault(tmp_path: Path, name: str) -> None:
    fault = "[twin.fault]\nlatency = '20 ms'\njitter = '2 ms'" if name != "acutrol_vectornav" else ""
    bench = bench_with(tmp_path, name, fault)
    axis = bench.table.gimbals[-1]
    limits = bench.table.axes[axis].limits
    steepest, count = limits.acceleration_rps2, limits.resolution_rad
    steps: list[Move | Rotate] = [
        Rotate(axis, 0.1 * DEG, 6.0, 20 * DEG, "0.1 deg/s"),
        Rotate(axis, -0.1 * DEG, 6.0, 0.1 * DEG, "0.1 deg/s, gentle"),
        Rotate(axis, max(0.002 * DEG, 1.5 * count), 8.0, 20 * DEG, "about a count a second"),
        Move(axis, 0.05 * DEG, 10 * DEG, 20 * DEG, "a small move"),
        Move(axis, 3 * DEG, 60 * DEG, steepest, "shorter than its ramps"),
        Rotate(axis, -60 * DEG, 4.0, steepest, "steep"),
        Rotate(axis, 60 * DEG, 4.0, steepest, "and back"),
        Rotate(axis, 5 * DEG, 9.0, 2 * DEG, "gentle"),
    ]
    if name == "acutrol_vectornav":
        steps = [step for step in steps if "count" not in step.label]
    script = check(Script("fine", (Rest(0.5), *steps, Rest(0.5))), {a: it.limits for a, it in bench.table.axes.items()})
    result, _ = run(tmp_path, bench, script)
    assert result.verdict.outcome in (Outcome.PASS, Outcome.FAIL), result.verdict.reason
