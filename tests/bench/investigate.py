"""Time and memory of station investigate on three runs of four gyros, and loops over the wire with hidden effects.

python tests/bench/investigate.py cost             processor time and memory over cases of several kinds at 100 Hz
python tests/bench/investigate.py time             at 100 Hz and at 1 kHz
python tests/bench/investigate.py loop --seeds 3   thermal_bias, g_sensitivity, scale_asymmetry, latency
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from detection_study.study import Case, recordings_of
from open_worlds import cases as open_worlds
from support import command, station

from estimator.recordings.recording import Recording
from estimator.recordings.writing import write_recording
from station.bench.bench import default_bench_text

HIDDEN = {
    "thermal_bias": 'linear = ["0.005 deg/s/degC", "-0.006 deg/s/degC", "0.004 deg/s/degC", "0.007 deg/s/degC"]',
    "g_sensitivity": 'x = "0.02 deg/s/g"\ny = ["0.01 deg/s/g", "-0.02 deg/s/g", "0.03 deg/s/g", "0.02 deg/s/g"]',
    "scale_asymmetry": 'size = ["2000 ppm", "-1500 ppm", "2500 ppm", "-1000 ppm"]',
    "latency": 'delay = "4 ms"',
}


FOREIGN = ("lagged_temperature", "rate_sign", "centripetal", "crosstalk", "magnetic_heading", "popcorn", "chirp")
"""Effects without a name: one law, two, a law beside a name, a surprise, nothing that was measured."""
NAMED: Sequence[tuple[str, ...]] = ((), ("scale_asymmetry",), ("bias_step",), ("table_axes", "g_sensitivity"))
MEDIAN_BAR_S, WORST_BAR_S, MEMORY_BAR_MB = 4.0, 10.0, 1024.0


@dataclass(frozen=True)
class Cost:
    """What one process of station investigate took: clock, processor, largest memory; and its verdict."""

    wall_s: float
    processor_s: float
    memory_mb: float
    verdict: str


def cost_of(recordings: Sequence[Recording]) -> Cost:
    """Return what it costs to investigate recordings of which the last is the verification run."""
    with tempfile.TemporaryDirectory() as folder:
        names = [Path(folder) / f"{n}.h5" for n in range(len(recordings))]
        for name, recording in zip(names, recordings, strict=True):
            write_recording(name, recording)
        answer = Path(folder) / "answer.json"
        words = command("investigate", *names[:-1], "--verify", names[-1], "--json")
        began = time.perf_counter()
        with answer.open("wb") as out, open(os.devnull, "wb") as nothing:
            actions = [(os.POSIX_SPAWN_DUP2, out.fileno(), 1), (os.POSIX_SPAWN_DUP2, nothing.fileno(), 2)]
            child = os.posix_spawn(words[0], words, os.environ, file_actions=actions)
            _, _, usage = os.wait4(child, 0)
        wall_s = time.perf_counter() - began
        verdict = json.loads(answer.read_text())["verdict"]
    return Cost(wall_s, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024, verdict)


def timed() -> None:
    for rate_hz in (100.0, 1000.0):
        cost = cost_of(recordings_of(Case(("scale_asymmetry",), 1.0, 0, rate_hz=rate_hz)))
        print(f"three runs at {rate_hz:g} Hz: {cost.wall_s:.1f} s, {cost.memory_mb:.0f} MB")


def costs(seeds: int) -> None:
    """Print what each case costs, then median and worst of all."""
    all_costs = []
    for seed in range(seeds):
        for kind in FOREIGN:
            world = open_worlds.made(open_worlds.Case(kind, 1.0, seed))
            all_costs.append(_printed(f"{kind} {seed}", cost_of([*world.fitted, world.verification])))
        for effects in NAMED:
            name = " and ".join(effects) or "nothing"
            all_costs.append(_printed(f"{name} {seed}", cost_of(recordings_of(Case(effects, 1.0, seed)))))
    processor_s = [cost.processor_s for cost in all_costs]
    memory_mb = max(cost.memory_mb for cost in all_costs)
    print(
        f"{len(all_costs)} cases: processor time median {np.median(processor_s):.1f} s (bar {MEDIAN_BAR_S:g}), worst "
        f"{max(processor_s):.1f} s (bar {WORST_BAR_S:g}), memory {memory_mb:.0f} MB (bar {MEMORY_BAR_MB:g})"
    )


def _printed(name: str, cost: Cost) -> Cost:
    print(f"{name:32s} {cost.processor_s:5.1f} s  {cost.memory_mb:4.0f} MB  {cost.verdict}", flush=True)
    return cost


def looped(seeds: int, effects: list[str]) -> None:
    for effect in effects:
        keys = HIDDEN[effect]
        right = 0
        minutes = 0.0
        for seed in range(seeds):
            with tempfile.TemporaryDirectory() as folder:
                (Path(folder) / "hidden.toml").write_text(f'[temperature]\nrise = "8 degC"\n[{effect}]\n{keys}\n')
                bench = Path(folder) / "bench.toml"
                bench.write_text(default_bench_text().replace("[twin]\n", '[twin]\nhidden = "hidden.toml"\n', 1))
                words = ("loop", "--bench", bench, "--seed", str(seed), "-o", Path(folder) / "out", "--json")
                done = json.loads(station(*words, timeout=900).stdout)
            named = [added["effect"] for added in done["added"]]
            right += named == [effect]
            minutes = max(minutes, float(done["minutes_used"]))
            if named != [effect]:
                print(f"  {effect}, seed {seed}: {done['verdict']} {named} {done['rivals']}")
        print(f"{effect}: right in {right} of {seeds}, at most {minutes:.1f} table minutes", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("cost", "time", "loop"))
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--effects", nargs="+", default=list(HIDDEN), choices=list(HIDDEN))
    arguments = parser.parse_args()
    match arguments.what:
        case "cost":
            costs(arguments.seeds)
        case "time":
            timed()
        case "loop":
            looped(arguments.seeds, arguments.effects)
