"""How often gyros with independent errors pass for sharing them: it must not be more often than is said.

python tests/bench/shared_errors.py              40 seeds: three recordings each, noise and bias instability alone
python tests/bench/shared_errors.py --wander 100     with random walks of the biases beside, in deg/h in a root hour
python tests/bench/shared_errors.py --alike          one walk in all gyros: how often it is found
"""

from __future__ import annotations

import argparse
import os
from dataclasses import replace

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from detection_study.study import Case, recordings_of
from known_effects import fit_known

from estimator.estimation.runs.build import runs_of_all
from estimator.recordings.recording import Recording
from estimator.tracing.judging.shared_errors import sharing

MODELS: tuple[tuple[str, ...], ...] = ((), ("g_sensitivity", "bias_drift", "warm_up", "scale_asymmetry"))
"""Effects beside the states: none, and some of which two are slow. None of them is in the recordings."""
SIGNS = np.array([1.0, -0.7, 1.3, -1.0])


def wandering(recording: Recording, wander_dph_rth: float, seed: tuple[int, int], *, alike: bool) -> Recording:
    """Return a recording with random walks added to the biases, the same one with other sizes if ``alike``."""
    data = recording.sources["array"]
    steps = np.random.default_rng(seed).standard_normal(data.rate_rps.shape)
    if alike:
        steps = steps[:, :1] * SIGNS
    period_s = float(np.median(np.diff(data.t_ns))) * 1e-9
    walk_rps = np.cumsum(steps, axis=0) * np.radians(wander_dph_rth / 3600) * np.sqrt(period_s / 3600)
    return replace(recording, sources={"array": replace(data, rate_rps=data.rate_rps + walk_rps)})


def main() -> None:
    """Print for each model the share of seeds whose chance is below some limits, and that is called certain."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=40, help="default: 40")
    parser.add_argument("--first", type=int, default=0, help="the first seed (default: 0)")
    parser.add_argument("--wander", type=float, default=0.0, help="deg/h in a root hour (default: 0)")
    parser.add_argument("--alike", action="store_true", help="one walk in all gyros")
    arguments = parser.parse_args()
    chances = np.empty((arguments.seeds, len(MODELS)))
    for row, seed in enumerate(range(arguments.first, arguments.first + arguments.seeds)):
        clean = recordings_of(Case((), 1.0, seed))
        made = [
            wandering(one, arguments.wander, (seed, number), alike=arguments.alike) for number, one in enumerate(clean)
        ]
        for column, effects in enumerate(MODELS):
            chances[row, column] = sharing(runs_of_all(made)[0], fit_known(made, effects)).by_chance
    for effects, own in zip(MODELS, chances.T, strict=True):
        below = ", ".join(f"below {limit}: {np.mean(own < limit):.1%}" for limit in (0.05, 0.01, 0.002))
        print(f"{', '.join(effects) or 'states alone'}: {below} of {len(own)} seeds")


if __name__ == "__main__":
    main()
