"""Hundreds of seeds, straight from the physics: coverage, NIS, error against the Cramer-Rao bound.

python tests/bench/campaign.py --seeds 200
python tests/bench/campaign.py --arrays --seeds 300
python tests/bench/campaign.py --seeds 300 --instability 10 --walk 10
python tests/bench/campaign.py --wire 20        (whole runs through the protocols, seeds 0 to 19)
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from support import TABLE_1, direct_recording, station

from estimator.estimation.calibrate import calibrate
from estimator.estimation.gram import gram_of, solve
from estimator.geometry.array import SensorArray, cone, dodecahedron, sensor_array, tetrahedron, triad
from estimator.geometry.model import decode


@dataclass(frozen=True, slots=True)
class Seed:
    """Errors and sigmas (n, 4), bounds (n, 4), mean NIS of one seed."""

    error: np.ndarray
    sd: np.ndarray
    bound: np.ndarray
    nis: float


def array_named(name: str) -> tuple[SensorArray, str | None]:
    """Return an array, and the mounting that the twins know by themselves if they know one."""
    if name == "cone of 8":
        return cone(8, np.radians(54.7356)), None
    if name.startswith("random"):
        axes = np.random.default_rng(int(name.split()[-1])).standard_normal((5, 3))
        return sensor_array(axes / np.linalg.norm(axes, axis=1, keepdims=True)), None
    return {"triad": triad, "tetrahedron": tetrahedron, "dodecahedron": dodecahedron}[name](), name


ARRAYS = ("triad", "tetrahedron", "dodecahedron", "cone of 8", "random 1", "random 2")


def one(seed: int, name: str = "tetrahedron", instability_dph: float = 0.0, walk_dph_rth: float = 0.0) -> Seed:
    """Estimate one recording; the bound is the sigma under the true noise, white noise only."""
    array, kind = array_named(name)
    recording = direct_recording(
        seed,
        array=array,
        kind=kind,
        states=np.tile(TABLE_1, (len(array), 1)),
        instability_dph=instability_dph,
        walk_dph_rth=walk_dph_rth,
    )
    calibration = calibrate(recording)
    data = recording.sources["array"]
    true_noise = np.full(len(data.array), np.radians(0.005) * 10)  # ARW times the root of 100 Hz
    known = solve(gram_of(recording, "array", data), data.array, data.prior, true_noise)
    bound = [np.sqrt(np.diag(decode(x, p)[1])) for x, p in zip(known.x, known.covariance, strict=True)]
    return Seed(
        np.array([g.states - TABLE_1 for g in calibration.gyros]),
        np.array([g.sd for g in calibration.gyros]),
        np.array(bound),
        calibration.nis_mean,
    )


def campaign(
    seeds: int, name: str = "tetrahedron", instability_dph: float = 0.0, walk_dph_rth: float = 0.0
) -> dict[str, float]:
    """Run seeds on all cores; return the figures."""
    work = partial(one, name=name, instability_dph=instability_dph, walk_dph_rth=walk_dph_rth)
    with ProcessPoolExecutor() as pool:
        results = list(pool.map(work, range(seeds), chunksize=5))
    error = np.array([r.error for r in results])
    sd = np.array([r.sd for r in results])
    bound = np.array([r.bound for r in results])
    nis = np.array([r.nis for r in results])
    rms = np.sqrt(np.mean((error / bound) ** 2, axis=(0, 1)))
    relative = np.mean(np.abs(error), axis=(0, 1)) / np.abs(TABLE_1) * 100
    names = ("k", "b", "sigma_j", "sigma_k")
    return {
        "seeds": seeds,
        "coverage95_percent": float(100 * np.mean(np.abs(error) < 1.96 * sd)),
        "worst_error_sigma": float(np.abs(error / sd).max()),
        "nis_mean": float(nis.mean()),
        "nis_lowest": float(nis.min()),
        "nis_highest": float(nis.max()),
        **{f"rms_over_bound_{n}": float(r) for n, r in zip(names, rms, strict=True)},
        "rms_over_bound_all": float(np.sqrt(np.mean((error / bound) ** 2))),
        **{f"relative_error_{n}_percent": float(r) for n, r in zip(names, relative, strict=True)},
    }


def wire(seed: int, folder: str) -> dict[str, object]:
    """Run the whole path once; return verdict and worst error in its own sigmas."""
    done = station("run", "--seed", str(seed), "--json", "-o", Path(folder) / f"{seed}.h5", timeout=300)
    result = json.loads(done.stdout)
    keys = ("k", "b_rps", "sigma_j_rad", "sigma_k_rad")
    worst = max(abs((g[k] - t) / g["sd"][k]) for g in result["gyros"] for k, t in zip(keys, TABLE_1, strict=True))
    return {"seed": seed, "outcome": result["outcome"], "nis_mean": result["nis_mean"], "worst_error_sigma": worst}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=200)
    parser.add_argument("--wire", type=int, default=0, help="whole runs instead")
    parser.add_argument("--instability", type=float, default=0.0, help="bias instability in deg/h")
    parser.add_argument("--walk", type=float, default=0.0, help="rate random walk in deg/h/rth")
    parser.add_argument("--arrays", action="store_true", help="all arrays, a line each")
    arguments = parser.parse_args()
    if arguments.wire:
        with tempfile.TemporaryDirectory() as folder, ProcessPoolExecutor() as pool:
            rows = []
            for row in pool.map(partial(wire, folder=folder), range(arguments.wire)):
                rows.append(row)
                print(json.dumps(row), flush=True)
            print(json.dumps({"worst_error_sigma": max(float(str(r["worst_error_sigma"])) for r in rows)}))
        return
    for array in ARRAYS if arguments.arrays else ("tetrahedron",):
        figures = campaign(arguments.seeds, array, arguments.instability, arguments.walk)
        if arguments.arrays:
            print(
                f"{array:14s} coverage {figures['coverage95_percent']:.1f} %, rms error over bound "
                f"{figures['rms_over_bound_all']:.3f}, mean NIS {figures['nis_mean']:.3f}",
                flush=True,
            )
            continue
        for name, value in figures.items():
            print(f"{name:32s} {value:.4f}")


if __name__ == "__main__":
    main()
