"""Sessions of 38 rests in random poses: what is found in noise, and in gyros that feel gravity.

python tests/bench/rests.py                  100 sessions of noise: nothing may be added, no tone above all
python tests/bench/rests.py --gravity        20 sessions with a g-sensitivity: named, and as good as least squares
"""

from __future__ import annotations

import argparse
import os
from collections import Counter

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from estimator.geometry.array import sensor_array
from estimator.recordings.recording import ImuData, Recording
from estimator.recordings.reference import RateReadings
from estimator.tracing.investigate import investigate

RATE_HZ, REST_S, MOVE_S, RESTS = 50.0, 12.0, 4.0, 38
G_MPS2 = 9.80665


def session(seed: int, per_g_dps: float) -> tuple[Recording, np.ndarray, np.ndarray]:
    """Return a session, the directions up (38, 3), and the mean outputs of the rests (38, 3) in rad/s."""
    random = np.random.default_rng([seed, 38])
    period = int((REST_S + MOVE_S) * RATE_HZ)
    n = RESTS * period
    t_ns = np.round(np.arange(n) * 1e9 / RATE_HZ).astype(np.int64)
    resting = (np.arange(n) % period) < REST_S * RATE_HZ
    ups = random.standard_normal((RESTS, 3))
    ups /= np.linalg.norm(ups, axis=1, keepdims=True)
    up = np.repeat(ups, period, axis=0)
    matrix = np.radians(per_g_dps) * random.standard_normal((3, 3))
    noise = np.radians(0.05) * random.standard_normal((n, 3))
    bias = np.radians(0.3) * random.standard_normal(3)
    moving = np.radians(40.0) * np.sin(np.arange(n)[:, None] / RATE_HZ * [3.0, 4.0, 5.0])
    rate = bias + up @ matrix + noise + np.where(resting[:, None], 0.0, moving)
    accel = G_MPS2 * up + 0.02 * random.standard_normal((n, 3))
    reference = RateReadings(t_ns, np.where(resting[:, None], np.zeros((n, 3)), np.nan))
    data = ImuData(sensor_array(np.eye(3), names=("x", "y", "z")), t_ns, rate, accel_mps2=accel)
    means = np.array([rate[k * period : k * period + int(REST_S * RATE_HZ)].mean(axis=0) for k in range(RESTS)])
    return Recording({"imu": data}, reference), ups, means


def main(sessions: int, gravity: bool) -> None:
    """Print what is added in all sessions."""
    names: Counter[str] = Counter()
    ratios = []
    for seed in range(sessions):
        fit, *_ = session(2 * seed, 0.0) if not gravity else (None,)
        if fit is not None:
            found = investigate([fit])
            names.update([a.effect for a in found.added] or [f"({found.finding})"])
            continue
        recording, ups, means = session(seed, 0.05)
        found = investigate([recording])
        names.update([a.effect for a in found.added] or [f"({found.finding})"])
        if found.model is not None and found.model.parts:
            x = np.linalg.lstsq(np.column_stack([np.ones(RESTS), ups]), means, rcond=None)[0][1:].T
            mine = np.array([[found.added[0].parameters[f"{g} along body {a}"].value for a in "xyz"] for g in "xyz"])
            ratios.append(float(np.abs(mine - x).max() / np.abs(x).max()))
    print(f"{sessions} sessions of {RESTS} rests: {dict(names)}")
    if ratios:
        print(f"  g-sensitivities differ from least squares by at most {max(ratios):.1%} of the largest")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sessions", type=int)
    parser.add_argument("--gravity", action="store_true")
    arguments = parser.parse_args()
    main(arguments.sessions or (20 if arguments.gravity else 100), arguments.gravity)
