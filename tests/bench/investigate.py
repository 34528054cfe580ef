"""Time and memory of station investigate on three runs of four gyros, and loops over the wire with hidden effects.

python tests/bench/investigate.py time             at 100 Hz and at 1 kHz
python tests/bench/investigate.py loop --seeds 3   thermal_bias, g_sensitivity, scale_asymmetry, latency
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

from detection_study.study import Case, recordings_of
from support import command, station

from estimator.recordings.writing import write_recording
from station.bench.bench import default_bench_text

HIDDEN = {
    "thermal_bias": 'linear = ["0.005 deg/s/degC", "-0.006 deg/s/degC", "0.004 deg/s/degC", "0.007 deg/s/degC"]',
    "g_sensitivity": 'x = "0.02 deg/s/g"\ny = ["0.01 deg/s/g", "-0.02 deg/s/g", "0.03 deg/s/g", "0.02 deg/s/g"]',
    "scale_asymmetry": 'size = ["2000 ppm", "-1500 ppm", "2500 ppm", "-1000 ppm"]',
    "latency": 'delay = "4 ms"',
}


def timed() -> None:
    for rate_hz in (100.0, 1000.0):
        with tempfile.TemporaryDirectory() as folder:
            names = [Path(folder) / f"{n}.h5" for n in range(3)]
            for name, recording in zip(
                names, recordings_of(Case(("scale_asymmetry",), 1.0, 0, rate_hz=rate_hz)), strict=True
            ):
                write_recording(name, recording)
            began = time.perf_counter()
            words = command("investigate", *names[:2], "--verify", names[2], "--json")
            with open(os.devnull, "w") as nothing:
                actions = [(os.POSIX_SPAWN_DUP2, nothing.fileno(), 1), (os.POSIX_SPAWN_DUP2, nothing.fileno(), 2)]
                child = os.posix_spawn(words[0], words, os.environ, file_actions=actions)
                _, _, usage = os.wait4(child, 0)
            print(f"three runs at {rate_hz:g} Hz: {time.perf_counter() - began:.1f} s, {usage.ru_maxrss / 1024:.0f} MB")


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
    parser.add_argument("what", choices=("time", "loop"))
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--effects", nargs="+", default=list(HIDDEN), choices=list(HIDDEN))
    arguments = parser.parse_args()
    timed() if arguments.what == "time" else looped(arguments.seeds, arguments.effects)
