"""How often 95 % intervals hold the true states when one effect of the catalogue is there and nobody has said so.

python tests/bench/unseen.py --seeds 8                       (every effect, size 1, the 360 s script)
python tests/bench/unseen.py --seeds 8 --effects scale_asymmetry,thermal_bias --size 0.3
"""

from __future__ import annotations

import argparse
import os
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from detection_study.study import KNOWN, hidden_of
from support import SITE, TABLE_1

from estimator.calibration.budget import UNSEEN
from estimator.estimation.calibrate import calibrate
from estimator.geometry.array import tetrahedron
from station.opening import DeviceTruth, simulate
from station.scripts.script import paper_script

EFFECTS = ("nothing", *KNOWN, "scale_quadratic", "bias_step", "bandwidth")


@dataclass(frozen=True, slots=True)
class Case:
    """Errors (n, 4) over sigmas, sigmas and what undeclared effects have in them (n, 4); whether they were allowed."""

    score: np.ndarray
    sd: np.ndarray
    unseen: np.ndarray


def one(case: tuple[str, int], size: float, declared: bool) -> Case:
    """Estimate one recording with one hidden effect."""
    effect, seed = case
    rate = (float(np.radians(0.005)), float(np.radians(2 / 3600)))
    device = DeviceTruth(tetrahedron(), np.tile(TABLE_1, (4, 1)), *rate, kind="tetrahedron")
    site = None if effect == "earth_rate" else SITE
    recording = simulate(paper_script(), {"array": device}, seed, site=SITE, hidden=hidden_of([effect], size, seed))
    recording = (
        recording
        if site is not None
        else type(recording)(recording.sources, recording.reference, None, recording.attributes)
    )
    gyros = calibrate(recording, excluded=None if declared else frozenset()).gyros
    unseen = [sum((line.u**2 for line in g.budget if line.name == UNSEEN), np.zeros(4)) ** 0.5 for g in gyros]
    return Case(
        np.array([(g.states - TABLE_1) / g.sd for g in gyros]), np.array([g.sd for g in gyros]), np.array(unseen)
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--size", type=float, default=1.0, help="of the effects, over that of METHOD 3")
    parser.add_argument("--effects", default=",".join(EFFECTS))
    parser.add_argument("--declared", action="store_true", help='as on a bench that says effects = "none"')
    arguments = parser.parse_args()
    print(
        "effect                     coverage, %: all   k    b  sj  sk   largest   sigma of k, ppm (unseen)   b, deg/h"
    )
    units = np.array([1e6, np.degrees(3600), 1e6, 1e6])
    with ProcessPoolExecutor() as pool:
        for effect in arguments.effects.split(","):
            cases = [(effect, seed) for seed in range(arguments.seeds)]
            found = list(pool.map(partial(one, size=arguments.size, declared=arguments.declared), cases))
            score = np.array([case.score for case in found])
            held = 100 * np.mean(np.abs(score) < 1.96, axis=(0, 1))
            sd = np.sqrt(np.mean([case.sd**2 for case in found], axis=(0, 1))) * units
            unseen = np.sqrt(np.mean([case.unseen**2 for case in found], axis=(0, 1))) * units
            states = " ".join(f"{h:3.0f}" for h in held)
            print(
                f"{effect:32s} {held.mean():9.1f} {states} {np.abs(score).max():9.1f} {sd[0]:16.0f} ({unseen[0]:.0f})"
                f" {sd[1]:14.1f} ({unseen[1]:.1f})",
                flush=True,
            )


if __name__ == "__main__":
    main()
