"""Three runs of the shipped script for one axis, with a whole IMU that is mounted otherwise in each, and the truth."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from estimator.recordings.recording import Recording
from sims.physics.geometry import MOUNTS_DEG, mounted
from station.bench.bench import Bench, read_bench
from station.opening.simulate import simulate_bench
from station.opening.twins import force_truth_of, truth_of
from station.scripts.script import load_script

BENCH = Path(__file__).parents[1] / "data" / "benches" / "one_axis_imu.toml"
DEVICE = "mti"
ALONG = {
    "x": ('["x", "y", "z"]', '["z", "x", "y"]', '["y", "z", "x"]'),
    "z": ('["z", "x", "y"]', '["y", "z", "x"]', '["x", "y", "z"]'),
}
"""By the axis of the table the mountings with x, y and z of the device along it."""
MOUNTING_DEG = 0.2
_GYRO = {"k": (1000.0, "ppm"), "b": (30.0, "deg/h"), "sigma_j": (1.0, "mrad"), "sigma_k": (1.0, "mrad")}
_FORCE = {"k": (2000.0, "ppm"), "b": (10.0, "mg"), "sigma_j": (2.0, "mrad"), "sigma_k": (2.0, "mrad")}
_PLACES = {"lever_arm": (50.0, "mm"), "size": (2.0, "mm")}


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class ThreeRuns:
    """The benches and recordings of three mountings; the true states (3, 4) of gyros and accelerometers in the frame of
    the gyros.
    """

    benches: list[Bench]
    recordings: list[Recording]
    gyros: np.ndarray
    accelerometers: np.ndarray


def three_runs(seed: int, axis: str = "x", *, switched_off: bool = False, rate: str = "100 Hz") -> ThreeRuns:
    """Return runs of a device with other true errors and mounting errors for each seed.

    With ``switched_off`` its biases change from run to run, by 10 deg/h and 0.5 mg.
    """
    random = np.random.default_rng([seed, 37])
    text = BENCH.read_text(encoding="utf-8").replace('rate = "100 Hz"', f'rate = "{rate}"')
    text = text.replace('gimbals = ["x"]', f'gimbals = ["{axis}"]').replace("[table.x]", f"[table.{axis}]")
    before, _, _ = text.partition("[twin.mti]")
    gyro, force = _drawn(random, _GYRO), _drawn(random, _FORCE)
    gravity = 9.80619777 * (1 + 5e-5 * random.standard_normal())
    script = load_script(Path("full-imu-one-axis"), axis=axis)
    benches = []
    for mounting in ALONG[axis]:
        changed = 1.0 if switched_off else 0.0
        own_gyro = gyro | {"b": gyro["b"] + changed * 10.0 * random.standard_normal(3)}
        own_force = force | {"b": force["b"] + changed * 0.5 * random.standard_normal(3)}
        turned = MOUNTING_DEG * random.standard_normal(3)
        lines = ["[twin.mti]", *_lines(own_gyro, _GYRO), 'bias_instability = "0.3 deg/h"', "[twin.mti.mounting_error]"]
        lines += [f'{about} = "{value:.6f} deg"' for about, value in zip("xyz", turned, strict=True)]
        lines += ["[twin.mti.accelerometers]", *_lines(own_force, _FORCE), *_lines(_drawn(random, _PLACES), _PLACES)]
        lines += [
            'vrw = "60 ug/rtHz"',
            'bias_instability = "15 ug"',
            'delay = "1.5 ms"',
            f'gravity = "{gravity:.9f} m/s2"',
        ]
        benches.append(read_bench("\n".join([before.replace('["x", "y", "z"]', mounting), *lines, ""]), "bench"))
    recordings = [simulate_bench(bench, script, 3 * seed + number) for number, bench in enumerate(benches)]
    gyro_states, force_states = _true(benches[0], gyro, force)
    return ThreeRuns(benches=benches, recordings=recordings, gyros=gyro_states, accelerometers=force_states)


def _drawn(random: np.random.Generator, sizes: dict[str, tuple[float, str]]) -> dict[str, np.ndarray]:
    return {key: size * random.standard_normal(3) for key, (size, _) in sizes.items()}


def _lines(values: dict[str, np.ndarray], units: dict[str, tuple[float, str]]) -> list[str]:
    """Return a line of a bench file for each key."""
    return [f"{key} = [" + ", ".join(f'"{v:.6f} {units[key][1]}"' for v in own) + "]" for key, own in values.items()]


def _true(bench: Bench, gyro: dict[str, np.ndarray], force: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return the true states (3, 4) of gyros and accelerometers, turned so that the gyros have the least misalignments.

    Biases are those that do not change from run to run.
    """
    (imu,) = bench.imus
    truth = truth_of(bench.twin.truths.again(), imu)
    felt = force_truth_of(bench.twin.truths.again(), imu, bench.site)
    assert felt is not None
    axes = mounted(MOUNTS_DEG["triad"])

    def rows(of: object) -> np.ndarray:
        k, j_rad, k_rad = (np.asarray(getattr(of, key))[:, None] for key in ("k", "sigma_j_rad", "sigma_k_rad"))
        return (1 - k) * (axes.p - k_rad * axes.j + j_rad * axes.k)

    def states(turned: np.ndarray, bias: np.ndarray) -> np.ndarray:
        along = np.sum(turned * axes.p, axis=1)
        across = np.sum(turned * axes.k, axis=1), -np.sum(turned * axes.j, axis=1)
        return np.column_stack([1 - along, bias, across[0] / along, across[1] / along])

    def misaligned(turn: np.ndarray) -> np.ndarray:
        turned = Rotation.from_rotvec(turn).apply(rows(truth))
        return np.concatenate([np.sum(turned * axes.j, axis=1), np.sum(turned * axes.k, axis=1)])

    frame = Rotation.from_rotvec(least_squares(misaligned, np.zeros(3), xtol=1e-15, ftol=1e-15, gtol=1e-15).x)
    gyro_bias = np.radians(gyro["b"]) / 3600
    force_bias = force["b"] * 9.80665e-3
    return states(frame.apply(rows(truth)), gyro_bias), states(frame.apply(rows(felt[0])), force_bias)
