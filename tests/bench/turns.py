"""Units turned by hand against stops, by angles that are known: what is found, and in how many of how many sessions.

python tests/bench/turns.py                 10 sessions of each effect and 40 of none; seeds from 100 on
python tests/bench/turns.py --first 500     the half that was held back
"""

from __future__ import annotations

import argparse
import os
import sys
from collections import Counter
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).parents[1] / "estimator"))

import numpy as np
from hand_turned import Errors, by_known_angles

from estimator.tracing.investigate import investigate

SIZES = np.array([0.004, -0.003, 0.005])
KINDS: dict[str, Errors | None] = {
    "nothing": None,
    "scale_asymmetry": lambda up, t_s, w, warmth: SIZES * np.abs(w),
    "scale_cubic": lambda up, t_s, w, warmth: 0.1 * SIZES * w**3,
    "thermal_scale": lambda up, t_s, w, warmth: 0.1 * SIZES * w * (warmth[:, None] - 25),
    "thermal_bias": lambda up, t_s, w, warmth: SIZES * (warmth[:, None] - 25) / 40,
    "bias_drift": lambda up, t_s, w, warmth: SIZES * t_s[:, None] / 2000,
    "g_sensitivity": lambda up, t_s, w, warmth: np.radians(0.05) * up[:, [1, 2, 0]],
}


def main(first: int, sessions: int, share: float) -> None:
    """Print what is said of each kind, and how often the states are within 95 % intervals."""
    for kind, errors in KINDS.items():
        said: Counter[str] = Counter()
        inside: list[bool] = []
        for seed in range(first, first + sessions * (1 if errors else 4)):
            own = errors and (lambda *a, errors=errors: share * errors(*a))
            options = {"temperature_c": (20.0, 45.0), "accelerometer": True, "each": (2, 4)[seed % 2]}
            recording, unit = by_known_angles(seed, own, **options)
            found = investigate([recording])
            said[", ".join(a.effect for a in found.added) or f"({found.finding}: {found.reason})"] += 1
            for gyro, true in zip(found.gyros, unit.states(), strict=True):
                inside += (np.abs(gyro.states_after - true) < 1.96 * gyro.sd_after).tolist()
        print(f"{kind:16} states within 95 %: {np.mean(inside):.0%}; {dict(said)}", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--first", type=int, default=100)
    parser.add_argument("--sessions", type=int, default=10)
    parser.add_argument("--share", type=float, default=1.0, help="of the size of each effect")
    arguments = parser.parse_args()
    main(arguments.first, arguments.sessions, arguments.share)
