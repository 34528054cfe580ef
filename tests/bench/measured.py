"""Recordings by others, put before the station: what it names, and by how much held-out errors fall.

python tests/bench/measured.py DATA                      DATA: folder with mpu6050_encoder and broad_optical
python tests/bench/measured.py DATA --only mpu6050       or broad, or planted

Planted: one channel of a trial of BROAD is clipped, another is dead. They must be named, and the scale factor errors of
all that is left must be those of the trial as it is.

Truth: a delay of 12.0 ms between encoder and MPU-6050, and of 4.17 to 4.31 ms between optical attitude and gyro
(BROAD), each by least squares on a grid of delays; the READMEs of the data sets say how. Errors are those of means of
0.1 s against a least-squares bias and factor, by a computation of this file's own: nothing of the estimator is in it.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Sequence
from dataclasses import replace
from itertools import permutations
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from estimator.estimation.calibrate import calibrate
from estimator.importing.importing import import_recording
from estimator.importing.mapping.mapping import read_mapping
from estimator.recordings.recording import Recording
from estimator.recordings.reference import TableReadings
from estimator.tracing.investigate import investigate
from estimator.tracing.investigation import Investigation

HERE = Path(__file__).parent.parent / "data"
MPU_RUNS = ("yaw_slow", "yaw_medium", "yaw_fast", "pitch_slow", "pitch_medium")
MPU_PAIRS = ((("yaw_slow", "yaw_medium"), ("yaw_fast",)), (("pitch_slow",), ("pitch_medium",)))
TIMED = frozenset({"latency", "reference_lag"})


def mpu(folder: Path, name: str) -> Recording:
    """Return a run of the MPU-6050."""
    mapping = read_mapping(HERE / "mpu6050" / f"{name.split('_')[0]}.toml")
    return import_recording(mapping, [folder / "mpu6050_encoder" / f"raw_{name}.mat"]).recording


def broad(path: Path) -> Recording:
    """Return a trial of BROAD."""
    return import_recording(read_mapping(HERE / "broad" / "mapping.toml"), [path]).recording


def delay_of(found: Investigation) -> float:
    """Return the delay that was added, in ms, NaN if none was."""
    for added in found.added:
        if added.effect in TIMED:
            sign = 1.0 if added.effect == "latency" else -1.0
            return sign * 1e3 * next(v.value for n, v in added.parameters.items() if n.endswith("delay"))
    return float("nan")


def line(name: str, fit: Sequence[Recording], judge: Sequence[Recording], truth_ms: float, within_ms: float) -> bool:
    """Investigate, print a line, and return whether the delay, and nothing else, was added."""
    began = time.perf_counter()
    found = investigate(fit, judge)
    others = [a.effect for a in found.added if a.effect not in TIMED]
    delay = delay_of(found)
    good = abs(delay - truth_ms) <= within_ms and not others
    ratio = found.improvement.ratio if found.improvement else float("nan")
    rest = found.unexplained.depends_on if found.unexplained else ""
    print(
        f"{name:44s} {'ok ' if good else 'NOT'} {found.finding:15s} delay {delay:7.2f} ms  others {others}  "
        f"held-out error {np.degrees(found.before.rms_rps):7.3f} -> {np.degrees(found.after.rms_rps):7.3f} deg/s, "
        f"{ratio:5.2f} x  left: {rest or '-'}  {time.perf_counter() - began:.0f} s",
        flush=True,
    )
    return good


def means_of_factor(run: Recording, delay_s: float) -> float:
    """Return the rms (deg/s) of 0.1 s means of encoder slope and gyro beside bias and factor, by least squares."""
    assert isinstance(run.reference, TableReadings)
    data = next(iter(run.sources.values()))
    g = int(np.argmax(np.abs(data.array.p @ np.eye(3)["xyz".index(run.reference.gimbals[0])])))
    t, edges = data.t_ns * 1e-9, np.arange(data.t_ns[0] * 1e-9 + 1, data.t_ns[-1] * 1e-9 - 1, 0.1)
    summed = np.concatenate([[0.0], np.cumsum(np.diff(t) * 0.5 * (data.rate_rps[1:, g] + data.rate_rps[:-1, g]))])
    rate = np.diff(np.interp(edges + delay_s, t, summed)) / 0.1
    turn = np.diff(np.interp(edges, run.reference.t_ns * 1e-9, run.reference.angle_rad[:, 0])) / 0.1
    columns = np.column_stack([np.ones(len(turn)), turn])
    return float(np.degrees(np.std(rate - columns @ np.linalg.lstsq(columns, rate, rcond=None)[0])))


def mpu_lines(data: Path) -> None:
    """Print the MPU-6050's lines."""
    runs = {name: mpu(data, name) for name in MPU_RUNS}
    good = [
        line(f"{' + '.join(f)} on {' '.join(v)}", [runs[n] for n in f], [runs[n] for n in v], 11.8, 1.0)
        for f, v in MPU_PAIRS
    ]
    good += [line(name, [run], [], 11.8, 1.0) for name, run in runs.items()]
    print(f"MPU-6050: the delay and nothing else in {sum(good)} of {len(good)}")
    for name in ("yaw_fast", "pitch_medium", "yaw_slow", "yaw_medium"):
        bare, delayed = means_of_factor(runs[name], 0.0), means_of_factor(runs[name], 0.0118)
        print(f"  own least squares, 0.1 s means of {name}: {bare:.3f} -> {delayed:.3f} deg/s, {bare / delayed:.2f} x")
    for plane in ("yaw", "pitch"):
        states = []
        for name, run in runs.items():
            if name.startswith(plane):
                gyro = next(
                    g for g in calibrate(run, excluded=frozenset()).gyros if g.name == ("z" if plane == "yaw" else "y")
                )
                states.append((1e6 * gyro.states[0], 1e6 * float(np.sqrt(gyro.covariance[0, 0]))))
                print(f"  calibrate {name}: k {states[-1][0]:+.0f} +- {states[-1][1]:.0f} ppm")
        apart = [abs(a[0] - b[0]) for a, b in permutations(states, 2)]
        sigmas = [abs(a[0] - b[0]) / np.hypot(a[1], b[1]) for a, b in permutations(states, 2)]
        print(f"  {plane}: k over speeds apart by at most {max(apart):.0f} ppm, {max(sigmas):.1f} sigmas")


def clipped(rate_rps: np.ndarray, gyro: int) -> np.ndarray:
    """Return rates (n, 3) of which one ends at 0.6 of its largest, before the device corrects its axes."""
    others = [0.004 * rate_rps[:, other] for other in range(3) if other != gyro]
    limit_rps = 0.6 * float(np.nanquantile(np.abs(rate_rps[:, gyro]), 0.999))
    found = rate_rps.copy()
    found[:, gyro] = np.clip(rate_rps[:, gyro], -limit_rps, limit_rps)
    beyond = np.abs(rate_rps[:, gyro]) > limit_rps
    found[beyond, gyro] += (others[0] - others[1])[beyond]
    return found


def dead(rate_rps: np.ndarray, gyro: int) -> np.ndarray:
    """Return rates (n, 3) of which one is noise of 0.1 deg/s about a value."""
    found = rate_rps.copy()
    found[:, gyro] = np.radians(0.4 + 0.1 * np.random.default_rng(1).standard_normal(len(found)))
    return found


def planted_lines(data: Path) -> None:
    """Print what is made of each trial of BROAD with a clipped and with a dead channel."""
    good, count = 0, 0
    for path in sorted((data / "broad_optical").glob("*.mat")):
        trial = broad(path)
        (source, imu), *_ = trial.sources.items()
        clean = {gyro.name: gyro for gyro in calibrate(trial, excluded=frozenset()).gyros}
        for number, (fault, words) in enumerate(((clipped, "saturates at"), (dead, "dead"))):
            gyro = (number + int(path.stem[:2])) % 3
            name = imu.array.names[gyro]
            spoilt = replace(trial, sources={source: replace(imu, rate_rps=fault(imu.rate_rps, gyro))})
            found = calibrate(spoilt, excluded=frozenset())
            named = any(name in note and words in note for note in found.notes)
            off = {
                own.name: abs(own.states[0] - clean[own.name].states[0]) / np.hypot(own.sd[0], clean[own.name].sd[0])
                for own in found.gyros
            }
            left = set(off) == set(clean) - ({name} if fault is dead else set())
            right = named and left and max(off.values()) < 2
            good, count = good + right, count + 1
            told = ", ".join(f"{own} {sigmas:.1f}" for own, sigmas in off.items())
            print(
                f"BROAD {path.stem[:2]}, {name} {fault.__name__:8s} {'ok ' if right else 'NOT'} "
                f"{'named' if named else 'not named'}, k off the trial's by sigmas: {told}",
                flush=True,
            )
    print(f"planted: named, and k right on the rest, in {good} of {count}")


def broad_lines(data: Path) -> None:
    """Print the lines of BROAD, each trial alone and each ordered pair."""
    trials = {path.stem[:2]: broad(path) for path in sorted((data / "broad_optical").glob("*.mat"))}
    good = [line(f"BROAD {name}", [trial], [], 4.2, 0.3) for name, trial in trials.items()]
    pairs = [line(f"BROAD {a} on {b}", [trials[a]], [trials[b]], 4.2, 0.3) for a, b in permutations(trials, 2)]
    print(f"BROAD: the delay and nothing else in {sum(good)} of {len(good)} alone, {sum(pairs)} of {len(pairs)} pairs")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--only", choices=("mpu6050", "broad", "planted"))
    arguments = parser.parse_args()
    kinds = {"mpu6050": mpu_lines, "broad": broad_lines, "planted": planted_lines}
    for kind, lines in kinds.items():
        if arguments.only in (None, kind):
            lines(arguments.data)
