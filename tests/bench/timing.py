"""Runs whose ramps begin and end off any grid, over links that are late: states, NIS, and the offset that is found.

python tests/bench/timing.py                           every case, 10 seeds each, short scripts
python tests/bench/timing.py --cases clean-20 --seeds 100
python tests/bench/timing.py --script paper --cases table+30ms,gyros+30ms --seeds 5
python tests/bench/timing.py --bench galil_xsens --cases clean-40
python tests/bench/timing.py --real --cases clean-20 --seeds 2   twins in another process, in real time (70 s a run)

Virtual time, but for the last. Each line: outcomes, mean NIS, errors of the states over their sigmas (rms over all
seeds, largest), the offset between table and gyros less what was planted, in ms, and over its sigma (rms and largest).
In real time nobody knows by how much terminals are late: the offset is then only told.
"""

from __future__ import annotations

import argparse
import asyncio
import concurrent.futures
import json
import random
import subprocess
import tempfile
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
from support import TwinProcess, command

from station.bench.bench import Bench, default_bench_text, load_bench
from station.commands.improve.script_file import script_text
from station.opening import open_bench
from station.opening.twins import truth_of
from station.run.event_loop.loops import VirtualLoop
from station.run.session import Session
from station.scripts.script import Rest, Rotate, Script, paper_script

BENCHES = Path(__file__).parents[1] / "data" / "benches"
DEG = np.pi / 180


@dataclass(frozen=True, slots=True)
class Case:
    """Ramps (deg/s2), faults of the wires of the table and of the gyros, and the offset that these make (ms).

    An offset is above zero where the gyros' stamps are late; a table whose replies are late has stamps half as late.
    """

    ramp: float = 20.0
    table: str = ""
    gyros: str = ""
    offset_ms: float = 0.0


def _late(ms: float) -> str:
    return f'late = "100 %"\nlate_by = "{ms:g} ms"'


CASES = {
    **{f"clean-{ramp}": Case(float(ramp)) for ramp in (10, 20, 40)},
    **{f"gyros+{ms}ms": Case(gyros=_late(ms), offset_ms=ms) for ms in (1, 10, 30)},
    **{f"table+{ms}ms": Case(table=_late(2 * ms), offset_ms=-ms) for ms in (1, 10, 30)},
    "1 in 20 by 150 ms": Case(table='late = "5 %"\nlate_by = "150 ms"'),
    "every reply by 30 ms": Case(table=_late(30), offset_ms=-15),
    "35 ms a request": Case(table='latency = "17.5 ms"', offset_ms=-17.5),  # both ways on the reply, on Modbus
    "jitter 5 ms": Case(table='jitter = "5 ms"', gyros='jitter = "2 ms"', offset_ms=np.nan),
}


@dataclass(frozen=True, slots=True)
class Ended:
    """How a run ended: errors over sigmas of all states, offset less what was planted and its sigma in ms."""

    case: str
    seed: int
    outcome: str
    reason: str
    nis: float
    errors: tuple[float, ...]
    offset_ms: float
    offset_sd_ms: float


def off_grid_script(ramp_dps2: float, seed: int, turn_s: float = 10.0) -> Script:
    """Return rests and turns of all axes, of lengths that share no grid, with these ramps."""
    dice = random.Random(seed)
    steps: list[Rest | Rotate] = [Rest(5.0 + dice.random())]
    for way in (1, -1):
        for axis in "xyz":
            rate = way * dice.uniform(18, 22) * DEG
            # Half or whole turns, so that the next axis turns about another direction than this one.
            turn = way * max(round(abs(rate) * turn_s / np.pi), 1) * np.pi
            length_s = turn / rate + abs(rate) / (ramp_dps2 * DEG)
            steps.append(Rotate(axis, rate, length_s, ramp_dps2 * DEG, f"{axis} {way}"))
            steps.append(Rest(dice.uniform(0.5, 1.5)))
    return Script("off the grid", (*steps, Rest(3.0 + dice.random())))


def ended(
    name: str, case: Case, seed: int, bench_name: str = "", script: str = "", turn_s: float = 10.0, real: bool = False
) -> Ended:
    """Run a case with a seed; turns last ``turn_s`` but for the paper's script.

    ``real``: against twins in another process, in real time.
    """
    text = (BENCHES / f"{bench_name}.toml").read_text() if bench_name else default_bench_text()
    text = text.replace("sd_", "# sd_") if script != "paper" else text
    text = text.replace("\nseed = 0", "").replace("[twin]\n", f"[twin]\nseed = {seed}\n", 1)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bench.toml"
        path.write_text(text)
        device = next(imu.name for imu in load_bench(path).imus if imu.used)
        faults = {"twin.fault": case.table, f"twin.{device}.fault": case.gyros}
        path.write_text(text + "".join(f"\n[{key}]\n{said}\n" for key, said in faults.items() if said))
        bench = load_bench(path)
        driven = paper_script() if script == "paper" else off_grid_script(case.ramp, seed, turn_s)

        async def main() -> tuple[str, str]:
            async with open_bench(bench) as opened:
                result = await Session(opened, driven, Path(folder) / "run.h5").run()
            return str(result.verdict.outcome), result.verdict.reason

        if real:
            outcome, reason = _between_processes(path, bench, driven, Path(folder))
        else:
            with asyncio.Runner(loop_factory=VirtualLoop) as runner:
                outcome, reason = runner.run(main())
        return Ended(name, seed, outcome, reason, *found_states(Path(folder) / "run.h5", bench, case.offset_ms))


def _between_processes(path: Path, bench: Bench, script: Script, folder: Path) -> tuple[str, str]:
    written, devices = folder / "script.toml", ["table", *(imu.name for imu in bench.imus if imu.used)]
    written.write_text(script_text(script, "tests/bench/timing.py"))
    with TwinProcess("--bench", path) as twin:
        links = [word for name in devices if name in twin.links for word in twin.options(name)]
        options = ["--json", "--scale", "1", "--bench", path, "--script", written, "-o", folder / "run.h5", *links]
        done = subprocess.run(command("run", *options), capture_output=True, text=True, check=False)
    said = json.loads(done.stdout)
    return said["outcome"], said["reason"]


def found_states(path: Path, bench: Bench, planted_ms: float) -> tuple[float, tuple[float, ...], float, float]:
    """Return mean NIS, errors of all states over their sigmas, the offset less what was planted and its sigma (ms)."""
    truths = bench.twin.truths.again()
    found = [truth_of(truths, imu) for imu in bench.imus if imu.used]
    true = np.vstack([np.column_stack([t.k, t.b_rps, t.sigma_j_rad, t.sigma_k_rad]) for t in found])
    names = [name for imu in bench.imus if imu.used for name in imu.array.names]
    true = true[sorted(range(len(names)), key=lambda i: names.index(names[i]))]  # gyros of one name stand together
    with h5py.File(path) as file:
        if "calibration" not in file:
            return np.nan, (), np.nan, np.nan
        own = file["calibration"]
        errors = (own["states"][()] - true) / own["sd"][()]
        source = next(iter(file["imu"].values())).attrs
        offset, sd = (1e3 * source.get(f"time_offset_{which}s", np.nan) for which in ("", "sd_"))
        return float(own.attrs["nis_mean"]), tuple(errors.ravel().tolist()), float(offset - planted_ms), float(sd)


def summary(runs: list[Ended]) -> str:
    """Return the line of a case."""
    outcomes = " ".join(f"{count} {outcome}" for outcome, count in Counter(run.outcome for run in runs).items())
    said = f"{runs[0].case:22s} {outcomes:16s}"
    if not (done := [run for run in runs if run.errors]):
        return said
    errors = np.array([error for run in done for error in run.errors])
    nis = np.array([run.nis for run in done])
    said += f" NIS {nis.mean():5.2f} ({nis.min():.2f} to {nis.max():.2f})"
    said += f"  errors rms {_rms(errors):5.2f} worst {np.abs(errors).max():5.1f}"
    if not (told := [run for run in done if np.isfinite(run.offset_ms)]):
        return said
    off, sd = np.array([(run.offset_ms, run.offset_sd_ms) for run in told]).T
    said += f"  offset {off.mean():+7.3f} ms, rms {_rms(off / sd):5.2f} worst {np.abs(off / sd).max():5.1f} sigma"
    return f"{said} of {sd.mean():.3f} ms"


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.nanmean(values**2))) if np.isfinite(values).any() else np.nan


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", default=",".join(CASES), help="names, with commas")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--bench", default="", help="of tests/data/benches; the built-in one if left out")
    parser.add_argument("--script", default="", choices=["", "paper"])
    parser.add_argument("--real", action="store_true", help="twins in another process, in real time")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--verbose", action="store_true")
    arguments = parser.parse_args()
    with concurrent.futures.ProcessPoolExecutor(arguments.jobs) as pool:
        for name in arguments.cases.split(","):
            work = [
                pool.submit(ended, name, CASES[name], seed, arguments.bench, arguments.script, real=arguments.real)
                for seed in range(arguments.seeds)
            ]
            runs = []
            for done in concurrent.futures.as_completed(work):
                runs.append(done.result())
                print(f"{name}: {len(runs)} of {len(work)}", end="\r", flush=True)
                if arguments.verbose:
                    print(f"{runs[-1].outcome} {runs[-1].reason} NIS {runs[-1].nis:.3f}")
            print(summary(runs), flush=True)
