"""Long and large: memory over the hours of a run in virtual time, and of what is done with its recording.

python tests/bench/large.py run --hours 24            a run, its memory by the hour, its verdict
python tests/bench/large.py samples --millions 100    a recording of so many samples: read, calibrated, listed
python tests/bench/large.py recordings --count 10000  so many recordings in one folder: listed, calibrated

Memory is the resident set of the process (psutil), in MB; a run prints a line for each hour of its clock.
"""

from __future__ import annotations

import argparse
import asyncio
import resource
import shutil
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from estimator.errors import EstimatorError
from estimator.estimation.calibrate import calibrate
from estimator.geometry.array import triad
from estimator.geometry.model import Prior
from estimator.recordings.reading import read_recording
from estimator.recordings.safe_open import probe
from estimator.recordings.writing import RecordingWriter
from station.bench.bench import default_bench_text, load_bench, read_limits
from station.campaigns.campaigns import run_all
from station.commands.calibrate import estimate
from station.opening import open_bench
from station.run.event_loop.loops import VirtualLoop
from station.run.session import Result, RunOptions, Session
from station.screen.archive.archive import Archive
from station.screen.archive.entries import Entry
from station.scripts.script import Rotate, Script, paper_script


def rss_mb() -> float:
    """Return the resident set of this process."""
    return psutil.Process().memory_info().rss / 1e6


def long_script(hours: float) -> Script:
    """Return the paper's script over and over, the turns of every other one back, so that every axis ends at home."""
    steps: list[Any] = []
    paper = paper_script()
    for number in range(max(round(hours * 3600 / paper.least_s), 1)):
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


def write_samples(path: Path, millions: float, rate_hz: float = 1000.0) -> None:
    """Write a recording of so many samples of three gyros on a table that turns back and forth, a minute at a time."""
    noise, minute_ns, truth = np.random.default_rng(0), 60 * 10**9, np.array([0.005, -0.003, 0.002])
    writer = RecordingWriter(path, {"station": "large"})
    writer.add_table(("z", "y", "x"))
    writer.add_source("imu", triad(), Prior(), {"lost": 0, "rate_hz": rate_hz, "device": "imu"})
    for minute in range(max(round(millions * 1e6 / 3 / rate_hz / 60), 1)):
        for group, step_ns in (("table", 50_000_000), ("imu/imu", round(1e9 / rate_hz))):
            t_ns = minute * minute_ns + np.arange(0, minute_ns, step_ns)
            swing = 2 * np.pi * (t_ns * 1e-9 / 10 % 1)
            rate, angle = np.zeros((len(t_ns), 3)), np.zeros((len(t_ns), 3))
            axis = minute % 3
            rate[:, axis], angle[:, axis] = 0.3 * np.sin(swing), -0.3 * (np.cos(swing) - 1) * 10 / (2 * np.pi)
            if group == "table":
                writer.append_rows(group, {"t_ns": t_ns, "angle_rad": angle, "rate_rps": rate})
            else:
                told = rate[:, ::-1] * (1 + truth) + 1e-3 * noise.normal(size=rate.shape)
                writer.append_rows(group, {"t_ns": t_ns, "rate_rps": told})
        writer.flush()
    writer.close()


def listed(folder: Path) -> list[Entry]:
    """Return the recordings of a folder as the history of the screen lists them."""

    async def go() -> list[Entry]:
        archive = Archive()
        found = [entry async for entry in archive.entries(folder)]
        await archive.close()
        return found

    return asyncio.run(go())


def measured(what: str, work: Callable[[], Any]) -> Any:
    """Do something; print how long it took and the largest resident set so far, also of the children."""
    began = time.monotonic()
    try:
        found = work()
    except EstimatorError as error:
        found = f"refused: {error}"
    peaks = [resource.getrusage(who).ru_maxrss / 1e3 for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    print(f"{what}: {time.monotonic() - began:.1f} s, at most {peaks[0]:.0f} MB, a child {peaks[1]:.0f} MB", flush=True)
    return found


def samples(millions: float, folder: Path) -> None:
    """Write, read through, list and calibrate a recording of so many samples."""
    path = folder / "samples.h5"
    measured("written", lambda: write_samples(path, millions))
    print(f"{path.stat().st_size / 1e6:.0f} MB on the disk")
    measured("listed", lambda: listed(folder))
    measured("seen through", lambda: probe(path))
    print(measured("calibrated", lambda: str(calibrate(read_recording(path)))[:200]))


def recordings(count: int, folder: Path) -> None:
    """List so many copies of one short recording, and calibrate some of them in one campaign."""
    first = folder / "0.h5"
    write_samples(first, 0.18, 100.0)
    for number in range(1, count):
        shutil.copyfile(first, folder / f"{number}.h5")
    print(len(measured(f"{count} listed", lambda: listed(folder))), "entries")
    few = [str(folder / f"{number}.h5") for number in range(min(count, 200))]
    work = partial(estimate, limits=(read_limits(default_bench_text()), None), write=False)
    for size in (len(few) // 2, len(few)):
        measured(f"{size} calibrated", lambda size=size: run_all(work, few[:size], label="calibrating", quiet=True))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("run", "samples", "recordings"))
    parser.add_argument("--hours", type=float, default=24.0)
    parser.add_argument("--every", type=float, default=3600.0, help="seconds between lines")
    parser.add_argument("--millions", type=float, default=100.0)
    parser.add_argument("--count", type=int, default=10_000)
    parser.add_argument("--keep", type=Path, help="an empty folder, in place of one that goes")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = arguments.keep or Path(name)
        if arguments.what == "samples":
            samples(arguments.millions, folder)
        elif arguments.what == "recordings":
            recordings(arguments.count, folder)
        else:
            result = run(arguments.hours, folder / "run.h5", arguments.every)
            print(result.verdict, f"{result.agreement:.1e} sigmas between live and batch, {rss_mb():.1f} MB at the end")
