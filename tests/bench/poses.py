"""Accelerometers laid in poses by hand: coverage of intervals, and recordings of others against what is known of them.

python tests/bench/poses.py                        200 simulated sessions: coverage of the 95 % intervals
python tests/bench/poses.py --sessions 0 --mpu imu0.log imu1.log --means poses24.mat --phone phone.mat
    --ferraris mapping_poses.toml session.csv --board mimu4444.toml exp_1.bin exp_2.bin exp_3.bin

Exit code 1 if a figure misses its bar.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).parents[1] / "estimator"))

import numpy as np
from handheld import G, Log, Session, Truth, device, general_poses, make
from scipy.io import loadmat

from estimator.geometry.kinematics import GRAVITY_MPS2
from estimator.importing.hands.mapping import read_pose_mapping
from estimator.importing.hands.session import calibrate_by_hand
from estimator.poses.calibration import Gravity, PoseCalibration, gyro_vector
from estimator.poses.intrinsic import NAMES
from estimator.poses.session import PoseSamples, calibrate_poses

EXACT = Gravity(value_mps2=G, sd=0.0, source="simulated")
STANDARD = Gravity(value_mps2=GRAVITY_MPS2, sd=0.0, source="standard")
MG = 9.80665e-3
IMUCAL_MATRICES = (
    [[0.996608, -0.014782, -0.007457], [0.008598, 1.002399, 0.001848], [0.013643, 0.00205, 1.023302]],
    [[1.027903, -0.000467, -0.006591], [-0.000218, 0.982424, -0.002735], [0.009698, 0.007628, 0.998234]],
)
IMUCAL_BIASES = ([0.537117, -0.616203, 0.398867], np.radians([-0.599669, -0.369843, 0.058774]))
LAYOUT_MM = np.array([2.0, 18.9, 19.0, 18.9, 19.0, 26.7, 26.8])
LEAST_SQUARES_MM = np.array([2.3, 18.2, 18.7, 19.2, 18.9, 25.7, 25.8])
LARGEST_CHI_SQUARE = 16.9  # of nine parameters, at 95 %
LEAST_COVERAGE, MOST_COVERAGE = 0.93, 0.97
MPU_MPS2, PHONE_MPS2, MEANS_MPS2 = 0.0022, 0.033, 0.5 * MG


@dataclass
class Bars:
    """Figures that were printed, and whether one missed its bar."""

    missed: int = 0

    def see(self, what: str, met: bool) -> None:
        """Print a figure and whether it meets its bar."""
        self.missed += not met
        print(f"{'met   ' if met else 'MISSED'} {what}", flush=True)


def any_session(seed: int) -> tuple[Truth, Log, bool]:
    """Return the truth and the log of a session drawn at random, and whether the size of its unit is known.

    Noise of 1 to 10 mg a sample, 50 to 400 Hz, 12 to 30 poses, rests of 1.5 s and up to 12 s, on a table or held in a
    hand that trembles; half of them are raw counts of unknown size and zero.
    """
    rng = np.random.default_rng([seed, 2014])
    truth = device(rng)
    session = Session(
        up=general_poses(rng, int(rng.integers(12, 31))),
        rate_hz=float(rng.choice([50.0, 100.0, 200.0, 400.0])),
        noise=float(np.exp(rng.uniform(np.log(MG), np.log(10 * MG)))),
        instability=float(rng.choice([0.0, 0.001, 0.003])),
        tremor=float(rng.choice([0.0, 0.02, 0.1])),
        shortest_s=1.5,
        longest_s=float(rng.uniform(2.0, 12.0)),
    )
    log = make(rng, truth, session)
    if seed % 2:
        return truth, log, True
    size, zero = float(rng.uniform(100, 2000)), rng.uniform(-1000, 40000, 3)
    counts = replace(log, accel=np.round(log.accel * size + zero))
    return Truth(accel=truth.accel * size, bias=truth.bias * size + zero), counts, False


def coverage(bars: Bars, sessions: int) -> None:
    """Print how often the 95 % intervals of each parameter hold the truth, and how many rests were refused."""
    inside, refused, rests = np.zeros(9), 0, 0
    for seed in range(sessions):
        truth, log, known = any_session(seed)
        samples = PoseSamples(name=f"session {seed}", t_s=log.t_s, outputs=log.accel, scale_known=known)
        result = calibrate_poses([samples], EXACT, 1.0)
        values = [(own.value, own.u95) for own in result.parameters]
        inside += [
            value is not None and u95 is not None and abs(value - true) <= u95
            for (value, u95), true in zip(values, truth.nine, strict=True)
        ]
        refused += len(result.refused)
        rests += len(result.rests)
    shares = inside / sessions
    print(f"{sessions} sessions: {refused} of {rests} good rests were refused")
    print("  " + ", ".join(f"{name} {share:.1%}" for name, share in zip(NAMES, shares, strict=True)))
    total = float(shares.mean())
    within = LEAST_COVERAGE <= total <= MOST_COVERAGE
    bars.see(f"coverage of the 95 % intervals of nine parameters: {total:.1%} (93 to 97 %)", within)


def of_samples(name: str, t_s: np.ndarray, outputs: np.ndarray, least_s: float = 1.0) -> PoseCalibration:
    return calibrate_poses([PoseSamples(name=name, t_s=t_s, outputs=outputs)], STANDARD, least_s)


def halves_agree(name: str, t_s: np.ndarray, outputs: np.ndarray, result: PoseCalibration, bars: Bars) -> None:
    """Print by how many sigma the parameters of the rests with odd and with even numbers differ."""
    parts = []
    for left_out in (0, 1):
        kept = np.ones(len(t_s), dtype=bool)
        for rest in result.used[left_out::2]:
            assert rest.start_s is not None
            assert rest.duration_s is not None
            kept &= (t_s < rest.start_s) | (t_s > rest.start_s + rest.duration_s)
        parts.append(of_samples(name, t_s[kept], outputs[kept]))
    first, second = parts
    apart = first.intrinsic.vector - second.intrinsic.vector
    together = first.covariance + second.covariance
    square = float(apart @ np.linalg.solve(together, apart))
    largest = float(np.max(np.abs(apart) / np.sqrt(np.diag(together))))
    text = f"{name}: halves of {len(first.used)} and {len(second.used)} rests differ by a chi-square of {square:.1f}"
    bars.see(f"{text} ({LARGEST_CHI_SQUARE}), the worst parameter by {largest:.2f} sigma", square <= LARGEST_CHI_SQUARE)


def measured(bars: Bars, mpu: Sequence[str], means: str | None, phone: str | None) -> None:
    """Print the figures of recordings of others."""
    for path in mpu:
        outputs = np.loadtxt(path)[:, :3]
        t_s = np.arange(len(outputs)) / 100.0
        result = of_samples(Path(path).name, t_s, outputs)
        text = f"{Path(path).name}: norm over {len(result.used)} rests {result.before_mps2:.4f} m/s2 before, "
        bars.see(f"{text}{result.after_mps2:.4f} after ({MPU_MPS2})", result.after_mps2 <= MPU_MPS2)
        halves_agree(Path(path).name, t_s, outputs, result, bars)
    if means is not None:
        outputs = loadmat(means)["CalibrationOfLowCostTriaxialInertialSensors"].T * GRAVITY_MPS2
        result = calibrate_poses([PoseSamples(name="means", t_s=None, outputs=outputs)], STANDARD, 1.0)
        after = result.after_mps2
        bars.see(
            f"24 means: {result.before_mps2 / MG:.2f} mg before, {after / MG:.2f} mg after (0.5)", after <= MEANS_MPS2
        )
        _, upper = np.linalg.qr(np.linalg.inv(result.intrinsic.matrix))
        scales = np.abs(np.diag(upper))
        off = float(np.abs(scales - [1.0079, 0.9968, 0.9923]).max())
        bars.see(f"24 means: scale factors {np.round(scales, 4)}, {off:.1e} from published (2e-4)", off <= 2e-4)
        low, high = np.array([0.9, -5.7, 13.6]), np.array([0.9, -5.2, 14.1])
        bias_mg = result.intrinsic.offset / MG
        off = float(np.maximum(low - bias_mg, bias_mg - high).max())
        bars.see(f"24 means: biases {np.round(bias_mg, 2)} mg, {max(off, 0.0):.2f} mg from published (0.5)", off <= 0.5)
    if phone is not None:
        outputs = loadmat(phone)["MobileAccData30orientationRawSample01"]
        result = of_samples("phone", np.arange(len(outputs)) / 100.0, outputs, 0.5)
        after = result.after_mps2
        text = f"phone: {result.before_mps2 * 1e3:.0f} mm/s2 before, {after * 1e3:.1f} mm/s2 after (33)"
        bars.see(f"{text}, {len(result.used)} rests, {len(result.refused)} refused", after <= PHONE_MPS2)


def ferraris(bars: Bars, mapping: str, data: str) -> None:
    """Print how far a Ferraris session is from what imucal 2.6 gives for it, in half widths of the 95 % intervals."""
    session = calibrate_by_hand(read_pose_mapping(Path(mapping)), [Path(data)])
    for triad, matrix, bias in zip(session.triads, IMUCAL_MATRICES, IMUCAL_BIASES, strict=True):
        others = gyro_vector(np.array(matrix), np.array(bias))
        shares = {
            own.name: abs(own.value - other) / own.u95
            for own, other in zip(triad.parameters, others, strict=True)
            if own.value is not None and own.u95 is not None
        }
        worst = max(shares, key=shares.__getitem__)
        text = f"Ferraris, {triad.kind}: {len(shares)} states within {shares[worst]:.2f} U of imucal's ({worst})"
        bars.see(f"{text} (12 within 1)", len(shares) == 12 and shares[worst] <= 1)


def boards(bars: Bars, mapping: str, data: Sequence[str]) -> None:
    """Print the distances of accelerometers from the first in several runs, against the layout and each other."""
    runs = [calibrate_by_hand(read_pose_mapping(Path(mapping)), [Path(path)]).board for path in data]
    found = [run for run in runs if run is not None]
    mm = np.array([[1e3 * imu.distance_m for imu in run.imus[1:]] for run in found])
    u95 = np.array([[1e3 * imu.distance_u95_m for imu in run.imus[1:]] for run in found])
    mean = mm.mean(axis=0)
    for path, own, half, run in zip(data, mm, u95, found, strict=True):
        print(f"{Path(path).name}: {np.round(own, 2)} +- {np.round(half, 2)} mm, {run.saturated} saturated samples")
    share = float((np.abs(mm - mean) / u95).max())
    bars.see(f"board: runs are within {share:.2f} of their 95 % half widths of the mean (1)", share <= 1)
    print(f"  mean {np.round(mean, 2)} mm")
    print(f"  off the nominal layout by {np.round(mean - LAYOUT_MM, 2)} mm, which is good to 1 mm")
    off = np.abs(mean - LEAST_SQUARES_MM)
    text = f"board: off plain least squares by {np.round(mean - LEAST_SQUARES_MM, 2)} mm (0.5)"
    bars.see(text, bool((off <= 0.5).all()))


def main() -> int:
    """Print all figures that are asked for; return 1 if one misses its bar."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sessions", type=int, default=200)
    parser.add_argument("--mpu", nargs="*", default=[], help="imu0.log, imu1.log")
    parser.add_argument("--means", help="poses24.mat")
    parser.add_argument("--phone", help="phone_lis3dh_30_poses.mat")
    parser.add_argument("--ferraris", nargs=2, metavar=("MAPPING", "SESSION"), help="a session with its mapping")
    parser.add_argument("--board", nargs="+", metavar=("MAPPING", "RUN"), help="runs of one board with its mapping")
    asked = parser.parse_args()
    bars = Bars()
    measured(bars, asked.mpu, asked.means, asked.phone)
    if asked.ferraris:
        ferraris(bars, *asked.ferraris)
    if asked.board:
        boards(bars, asked.board[0], asked.board[1:])
    if asked.sessions:
        coverage(bars, asked.sessions)
    return int(bars.missed > 0)


if __name__ == "__main__":
    sys.exit(main())
