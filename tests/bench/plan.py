"""The sigmas that `station plan` predicts, against the spread of the estimates of simulated runs.

python tests/bench/plan.py --runs 300
python tests/bench/plan.py --runs 300 --bench my_bench.toml --script my_script.toml
"""

from __future__ import annotations

import argparse
import os
from functools import partial
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from estimator.effects.conditions import Conditions
from estimator.estimation.calibrate import calibrate
from estimator.geometry.model import STATES
from estimator.planning.planning import PlannedDevice, forecast
from station.bench.bench import Bench, load_bench
from station.campaigns.campaigns import run_all
from station.opening.simulate import simulate_bench
from station.scripts.planned import planned_motion
from station.scripts.script import Script, load_script, paper_script


def estimate(seed: int, *, bench: Bench, script: Script) -> np.ndarray:
    """Return the estimated states (gyros, 4) of one simulated run."""
    calibration = calibrate(simulate_bench(bench, script, seed), innovations=False)
    return np.array([gyro.states for gyro in calibration.gyros])


def predicted(bench: Bench, script: Script) -> np.ndarray:
    """Return the predicted sigmas (gyros, 4)."""
    motion = planned_motion(script, bench.table.gimbals)
    conditions = Conditions.on_table(
        motion.t_s,
        motion.angle_rad,
        motion.rate_rps,
        motion.acceleration_rps2,
        motion.gimbals,
        site=bench.site,
    )
    devices = [PlannedDevice(imu.name, imu.array, imu.noise, imu.prior) for imu in bench.imus if imu.used]
    return np.array([gyro.sd for gyro in forecast(conditions, devices).gyros])


def spread_over_predicted(runs: int, bench: Bench, script: Script, *, quiet: bool = False) -> np.ndarray:
    """Return the spread of the estimates over the predicted sigma, by kind of state (4,), all gyros together."""
    found, failures = run_all(
        partial(estimate, bench=bench, script=script), range(runs), label="simulated runs", quiet=quiet
    )
    if failures:
        raise RuntimeError(f"{len(failures)} runs failed, first: {failures[0].reason}")
    states = np.array(found)  # (runs, gyros, 4)
    return np.sqrt(np.mean((states.std(axis=0, ddof=1) / predicted(bench, script)) ** 2, axis=0))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=300)
    parser.add_argument("--bench", type=Path, help="bench file; default: the built-in bench")
    parser.add_argument("--script", type=Path, help="script; default: the 360 s script")
    arguments = parser.parse_args()
    script = load_script(arguments.script) if arguments.script else paper_script()
    bench = load_bench(arguments.bench)
    ratios = spread_over_predicted(arguments.runs, bench, script)
    print(f"spread of the estimates of {arguments.runs} runs of {script.name} over the predicted sigma:")
    for name, ratio in zip(STATES, ratios, strict=True):
        print(f"{name:12s} {ratio:.3f}")


if __name__ == "__main__":
    main()
