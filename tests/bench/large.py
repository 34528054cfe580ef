"""Long and large: memory over the hours of a run in virtual time, and of what is done with its recording.

python tests/bench/large.py run --hours 24            a run, its memory by the hour, its verdict
python tests/bench/large.py samples --millions 100    a recording of so many samples: read, calibrated, listed
python tests/bench/large.py recordings --count 10000  so many recordings in one folder: listed, calibrated

Memory is the resident set of the process (psutil), in MB; a run prints a line for each hour of its clock.
"""

from __future__ import annotations

import argparse
import asyncio
import tempfile
import time
from pathlib import Path
from typing import Any

import psutil

from station.bench.bench import default_bench_text, load_bench
from station.opening import open_bench
from station.run.event_loop.loops import VirtualLoop
from station.run.session import Result, RunOptions, Session
from station.scripts.script import Rotate, Script, paper_script


def rss_mb() -> float:
    """Return the resident set of this process."""
    return psutil.Process().memory_info().rss / 1e6


def long_script(hours: float) -> Script:
    """Return the paper's script over and over, the turns of every other one back, so that every axis ends at home."""
    steps: list[Any] = []
    paper = paper_script()
    for number in range(max(round(hours * 3600 / paper.duration_s), 1)):
        for step in paper.steps:
            if isinstance(step, Rotate):
                step = Rotate(step.axis, step.rate_rps * (-1) ** number, *step.__getstate__()[2:])  # type: ignore[index]
            steps.append(step)
    return Script(f"long-{hours:g}h", tuple(steps))


def run(hours: float, path: Path, every_s: float = 3600.0) -> Result:
    """Run on the built-in twins in virtual time; print time, memory and samples every so often."""
    folder = path.parent
    (folder / "bench.toml").write_text(default_bench_text())
    bench = load_bench(folder / "bench.toml")
    began, next_s = time.monotonic(), [every_s]

    def look(snapshot: Any) -> None:
        now_s = asyncio.get_running_loop().time()
        if now_s >= next_s[0]:
            next_s[0] += every_s
            found = snapshot()
            print(
                f"{now_s / 3600:6.2f} h  {rss_mb():7.1f} MB  {found.samples} samples, {found.lost} lost, "
                f"NIS {found.nis_mean:.4f}, {time.monotonic() - began:.0f} s taken",
                flush=True,
            )

    async def go() -> Result:
        async with open_bench(bench) as opened:
            return await Session(opened, long_script(hours), path, RunOptions(), on_progress=look).run()

    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        return runner.run(go())


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("run", "samples", "recordings"))
    parser.add_argument("--hours", type=float, default=24.0)
    parser.add_argument("--every", type=float, default=3600.0)
    parser.add_argument("--keep", type=Path)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        path = (arguments.keep or Path(name)) / f"run-{time.time():.0f}.h5"
        result = run(arguments.hours, path, arguments.every)
        print(result.verdict, result.agreement, f"{rss_mb():.1f} MB after the estimate")
