"""Runs without a fault that reverse axes without a rest between: outcome, NIS and errors of the states.

python tests/bench/reversals.py                               every table and acceleration, 2 seeds each
python tests/bench/reversals.py --tables galil,acutrol --accelerations 50 --seeds 5 --verbose
python tests/bench/reversals.py --held                        other rates, accelerations and lengths of turns
python tests/bench/reversals.py --ctable PATH                 a table that is not ours, in real time (a minute a run)

Twins, in virtual time, but for the last. Bar: PASS, NIS between 0.9 and 1.1, no state off by more than 5 sigma. The
limits of sigma of the bench files are left out: they are for the paper's script. Exit code 1 if the bar is missed.

The table that is not ours is a program that speaks Modbus TCP as Kinco drives do, with a STIM300 on another port:
`PATH --port N --stimtcp M --answer` (see strange_table.py).
"""

from __future__ import annotations

import argparse
import asyncio
import concurrent.futures
import contextlib
import json
import os
import re
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import h5py
import numpy as np
from strange_table import BENCH as STRANGE_BENCH
from support import command
from timing import BENCHES, DEG, found_states

from station.bench.bench import default_bench_text, load_bench
from station.commands.improve.script_file import script_text
from station.opening import open_bench
from station.run.event_loop.loops import VirtualLoop
from station.run.session import Session
from station.scripts.script import Rest, Rotate, Script

NIS_LOW, NIS_HIGH, WORST_SIGMA = 0.9, 1.1, 5.0
_AEROSMITH_TABLE = """\
[table]
protocol = "aerosmith"
gimbals = ["z"]

[table.z]
max_rate = "100 deg/s"
max_acceleration = "50 deg/s2"

"""


@dataclass(frozen=True, slots=True)
class Motion:
    """A script: rate in deg/s, acceleration in deg/s2, length of a turn in s, turns of each axis.

    A turn lasts longer if its rate would otherwise be steady for less than 3 s.
    """

    rate_dps: float
    acceleration_dps2: float
    turn_s: float = 8.0
    turns: int = 4


@dataclass(frozen=True, slots=True)
class Case:
    """A table with a motion; ``poll_hz`` replaces how often the bench file has it read."""

    table: str
    motion: Motion
    seed: int = 0
    poll_hz: float = 0.0

    @property
    def name(self) -> str:
        """What a line begins with."""
        poll = f", read at {self.poll_hz:g} Hz" if self.poll_hz else ""
        return f"{self.table} {self.motion.rate_dps:g} deg/s, {self.motion.acceleration_dps2:g} deg/s2{poll}"


@dataclass(frozen=True, slots=True)
class Ended:
    """How a run ended: mean NIS of the calibration, and errors of all states over their sigmas."""

    case: Case
    outcome: str
    reason: str
    nis: float = float("nan")
    errors: tuple[float, ...] = ()

    @property
    def good(self) -> bool:
        """Whether it meets the bar."""
        worst = max(map(abs, self.errors), default=0.0)
        return self.outcome == "PASS" and NIS_LOW <= self.nis <= NIS_HIGH and worst <= WORST_SIGMA


ACCELERATIONS_DPS2 = (10.0, 20.0, 30.0, 40.0, 50.0)
TABLES = ("modbus", "rtu", "galil", "acutrol", "aerosmith")
HELD = tuple(
    Motion(rate, acceleration, turn_s, turns)
    for rate, acceleration, turn_s, turns in [
        (37.0, 14.0, 11.3, 3),
        (23.0, 45.0, 5.7, 6),
        (50.0, 33.0, 9.1, 4),
        (11.0, 25.0, 7.7, 5),
        (61.0, 49.0, 4.3, 8),
    ]
)
HELD_SECOND = tuple(
    Motion(rate, acceleration, turn_s, turns)
    for rate, acceleration, turn_s, turns in [
        (29.0, 37.0, 6.9, 5),
        (43.0, 19.0, 9.7, 4),
        (17.0, 50.0, 5.1, 7),
        (71.0, 41.0, 5.3, 6),
        (7.0, 12.0, 6.1, 6),
    ]
)
"""Written when the first set had shown that what is a mean was not told apart from ramps on a Galil."""


def reversing(motion: Motion, axes: str) -> Script:
    """Return a script that turns each axis forth and back without a rest between, and rests after each axis."""
    steps: list[Rest | Rotate] = [Rest(8.0)]
    for axis in axes:
        for turn in range(motion.turns):
            rate_rps = (-1) ** turn * motion.rate_dps * DEG
            length_s = max(motion.turn_s, 2 * motion.rate_dps / motion.acceleration_dps2 + 3.0)
            steps.append(Rotate(axis, rate_rps, length_s, motion.acceleration_dps2 * DEG, f"{axis} {turn + 1}"))
        steps.append(Rest(3.0))
    return Script("reversals", (*steps, Rest(5.0)))


def bench_text(table: str, seed: int) -> str:
    """Return the bench file of a table with its twin."""
    if table == "modbus":
        text = default_bench_text()
    elif table == "aerosmith":
        text = (BENCHES / "acutrol_vectornav.toml").read_text()
        start, stop = text.index("[table]"), text.index("[[imu]]")
        text = text[:start] + _AEROSMITH_TABLE + text[stop:]
        text = re.sub(r"^start = .*$", 'start = ["3 deg"]', text, flags=re.MULTILINE)
        # One axis shows nothing of the scale factors of the gyros beside it: their limit says nothing of reversals.
        text = re.sub(r"^scale_factor_error = .*\n", "", text, flags=re.MULTILINE)
    else:
        names = {"rtu": "rtu_stim300", "galil": "galil_xsens", "acutrol": "acutrol_vectornav"}
        text = (BENCHES / f"{names[table]}.toml").read_text()
    text = text.replace("sd_", "# sd_").replace("\nseed = 0", "")
    return text.replace("[twin]\n", f"[twin]\nseed = {seed}\n", 1)


def with_polling(text: str, poll_hz: float) -> str:
    """Return a bench file whose table is read so often, as it says itself at 0."""
    if not poll_hz:
        return text
    text = re.sub(r"^poll_rate = .*\n", "", text, flags=re.MULTILINE)
    return text.replace("[table]\n", f'[table]\npoll_rate = "{poll_hz:g} Hz"\n', 1)


def ended(case: Case, axes: str = "xyz") -> Ended:
    """Run a case against its twins, in virtual time; a one-axis table turns z alone."""
    with tempfile.TemporaryDirectory() as folder:
        path, recording = Path(folder) / "bench.toml", Path(folder) / "run.h5"
        path.write_text(with_polling(bench_text(case.table, case.seed), case.poll_hz))
        bench = load_bench(path)
        script = reversing(case.motion, "z" if case.table == "aerosmith" else axes)

        async def main() -> tuple[str, str]:
            async with open_bench(bench) as opened:
                result = await Session(opened, script, recording).run()
            return str(result.verdict.outcome), result.verdict.reason

        with asyncio.Runner(loop_factory=VirtualLoop) as runner:
            outcome, reason = runner.run(main())
        nis, errors, _, _ = found_states(recording, bench, 0.0)
        return Ended(case, outcome, reason, nis, errors)


@contextlib.contextmanager
def strange_table(program: Path) -> Iterator[tuple[int, int]]:
    """Run the table that is not ours; yield its ports of Modbus and of the STIM300."""
    ports = []
    for _ in range(2):
        with socket.create_server(("127.0.0.1", 0)) as free:
            ports.append(free.getsockname()[1])
    options = ["--port", ports[0], "--stimtcp", ports[1], "--answer"]
    with subprocess.Popen(
        [program, *map(str, options)], stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    ) as process:
        time.sleep(1.0)
        try:
            yield ports[0], ports[1]
        finally:
            process.terminate()


def ended_on(program: Path, case: Case) -> Ended:
    """Run a case on the table that is not ours, by the command, in real time; its truth is not told."""
    with tempfile.TemporaryDirectory() as folder, strange_table(program) as (table, imu):
        bench, script, recording = (Path(folder) / name for name in ("bench.toml", "script.toml", "run.h5"))
        text = STRANGE_BENCH.format(table=f"tcp://127.0.0.1:{table}", imu=imu)
        bench.write_text(with_polling(text, case.poll_hz))
        script.write_text(script_text(reversing(case.motion, "x"), "tests/bench/reversals.py"))
        options: list[str | Path] = ["--json", "--bench", bench, "--script", script, "-o", recording]
        done = subprocess.run(command("run", *options), capture_output=True, text=True, check=False)
        said = json.loads(done.stdout) if done.stdout else {"outcome": done.stderr[-200:], "reason": ""}
        if not recording.exists():
            return Ended(case, said["outcome"], said["reason"])
        with h5py.File(recording) as file:
            nis = float(file["calibration"].attrs["nis_mean"]) if "calibration" in file else np.nan
        # Without limits of the states a run that is consistent is a PASS.
        return Ended(case, said["outcome"], said["reason"], nis)


def line_of(run: Ended) -> str:
    """Return the line of a run."""
    worst = max(map(abs, run.errors), default=float("nan"))
    mark = "" if run.good else "  ! " + run.reason[:150]
    return f"{run.case.name:45s} {run.outcome:5s} NIS {run.nis:6.3f}  worst state {worst:5.1f} sigma{mark}"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tables", default=",".join(TABLES))
    parser.add_argument("--accelerations", default=",".join(f"{one:g}" for one in ACCELERATIONS_DPS2), help="deg/s2")
    parser.add_argument("--rate", type=float, default=50.0, help="deg/s")
    parser.add_argument("--poll", type=float, default=0.0, help="Hz, in place of what the bench file says")
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--held", action="store_true", help="the motions that are kept for the end")
    parser.add_argument("--ctable", type=Path, help="the program of a table that is not ours")
    parser.add_argument("--jobs", type=int, default=1)
    arguments = parser.parse_args()
    motions = (
        HELD + HELD_SECOND
        if arguments.held
        else [Motion(arguments.rate, float(one)) for one in arguments.accelerations.split(",")]
    )
    print(f"load {os.getloadavg()[0]:.1f}")
    runs = []
    if arguments.ctable:
        for motion in motions:
            runs.append(ended_on(arguments.ctable, Case("ctable", motion, poll_hz=arguments.poll)))
            print(line_of(runs[-1]), flush=True)
    else:
        cases = [
            replace(Case(table, motion), seed=seed, poll_hz=arguments.poll)
            for table in arguments.tables.split(",")
            for motion in motions
            for seed in range(arguments.seeds)
        ]
        with concurrent.futures.ProcessPoolExecutor(arguments.jobs) as pool:
            for run in pool.map(ended, cases):
                runs.append(run)
                print(line_of(run), flush=True)
    good = sum(run.good for run in runs)
    print(f"{good} of {len(runs)} meet the bar")
    sys.exit(0 if good == len(runs) else 1)
