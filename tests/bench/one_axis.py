"""A whole IMU on a table of one axis, three mountings joined: coverage of the intervals of all 24 states.

python tests/bench/one_axis.py                            20 devices on a table whose axis lies
python tests/bench/one_axis.py --axis z                   on one whose axis stands
python tests/bench/one_axis.py --switched-off             biases change from run to run
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "estimator"))

from three_mountings import three_runs

from estimator.estimation.mountings.join import join_mountings

WITHIN = 1.959964
STATES = ("k", "b", "sigma_j", "sigma_k")


def main() -> None:
    """Print the coverage of 95 % intervals and the rms error in sigmas of each state."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--first", type=int, default=100, help="seed of the first device")
    parser.add_argument("--axis", choices=("x", "z"), default="x")
    parser.add_argument("--switched-off", action="store_true")
    arguments = parser.parse_args()
    errors = {"gyros": [], "accelerometers": []}
    sigmas = {"gyros": [], "accelerometers": []}
    doubted = 0
    for seed in range(arguments.first, arguments.first + arguments.runs):
        truth = three_runs(seed, arguments.axis, switched_off=arguments.switched_off)
        excluded = [bench.excluded for bench in truth.benches]
        found = join_mountings(truth.recordings, excluded=excluded, innovations=False).calibration
        (forces,) = found.forces
        for what, sensors, true in (
            ("gyros", found.gyros, truth.gyros),
            ("accelerometers", forces.accelerometers, truth.accelerometers),
        ):
            errors[what].append([(one.states - own) / one.sd for one, own in zip(sensors, true, strict=True)])
            sigmas[what].append([one.sd for one in sensors])
        doubted += bool(found.doubts)
        for doubt in found.doubts:
            print(f"seed {seed}: {doubt}", flush=True)
        print(
            f"seed {seed}: largest error {max(np.abs(own[-1]).max() for own in errors.values()):.2f} sigma", flush=True
        )
    for what, own in errors.items():
        all_errors = np.array(own)
        within = np.mean(np.abs(all_errors) < WITHIN, axis=(0, 1))
        rms = np.sqrt(np.mean(all_errors**2, axis=(0, 1)))
        sd = np.median(np.array(sigmas[what]), axis=(0, 1))
        cells = zip(STATES, within, rms, sd, strict=True)
        print(f"{what}: " + ", ".join(f"{n} {100 * w:.1f} % (rms {r:.3f}, sd {s:.3g})" for n, w, r, s in cells))
    print(f"{doubted} of {arguments.runs} doubted")


if __name__ == "__main__":
    main()
