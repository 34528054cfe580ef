"""Units turned by hand against stops, by angles that are known: what is found, and in how many of how many sessions.

python tests/bench/turns.py                 10 sessions of each effect and 40 of none; seeds from 100 on
python tests/bench/turns.py --first 500     the half that was held back
python tests/bench/turns.py --gravity       20 sessions each of 30 and of 10 poses, gravity as the witness
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
from hand_turned import NAMES, RATE_HZ, Errors, by_known_angles, from_pose_to_pose

from estimator.geometry.array import sensor_array
from estimator.geometry.model import Prior, decode
from estimator.observations.poses import directions_up, estimate
from estimator.recordings.recording import ImuData
from estimator.recordings.reference import Poses
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


def by_gravity(first: int, sessions: int) -> None:
    """Print how often states are within their 95 % intervals, and how wide these are."""
    for poses in (30, 10):
        inside, sds = [], []
        for seed in range(first, first + sessions):
            laid = from_pose_to_pose(seed, poses=poses)
            t_ns = np.round(laid.t_s * 1e9).astype(np.int64)
            data = ImuData(sensor_array(np.eye(3), names=NAMES), t_ns, laid.rate_rps, accel_mps2=laid.accel_mps2)
            limits = np.add(laid.limits_s, (0.3, -0.3))
            rows = np.round(limits * RATE_HZ).astype(int)
            up, sd, shifts = directions_up(
                np.array([laid.accel_mps2[a : b + 1].mean(axis=0) for a, b in rows]), from_rests=True
            )
            found = estimate(data, Poses(t_ns[rows[:, 0]], t_ns[rows[:, 1]], up, np.full(poses, sd), shifts), Prior())
            for i, true in enumerate(laid.unit.states()):
                states, covariance = decode(found.x[i], found.covariance[4 * i : 4 * i + 4, 4 * i : 4 * i + 4])
                sds.append(np.sqrt(np.diag(covariance)))
                inside.append(np.abs(states - true) < 1.96 * sds[-1])
        k, b, tilt, other = np.mean(sds, axis=0)
        print(
            f"{poses} poses: within 95 % {np.mean(inside):.0%}; k {1e6 * k:.0f} ppm, "
            f"b {np.degrees(b) * 3600:.1f} deg/h, tilts {np.degrees(tilt):.4f} and {np.degrees(other):.4f} deg"
        )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--first", type=int, default=100)
    parser.add_argument("--sessions", type=int, default=10)
    parser.add_argument("--share", type=float, default=1.0, help="of the size of each effect")
    parser.add_argument("--gravity", action="store_true")
    arguments = parser.parse_args()
    if arguments.gravity:
        by_gravity(arguments.first, 2 * arguments.sessions)
        sys.exit()
    main(arguments.first, arguments.sessions, arguments.share)
