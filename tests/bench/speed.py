"""Time and memory: the batch estimate against a plain filterpy loop, and whole runs in virtual time.

python tests/bench/speed.py batch        360 s of 2 kHz, three gyros, both timed in one run
python tests/bench/speed.py product      360 s of 4 kHz, four gyros, beside one matrix product of the same columns
python tests/bench/speed.py agree        the two estimates at 100 Hz under the data-sheet prior
python tests/bench/speed.py runs         the main job, and the live filter on 2 kHz STIM300 datagrams
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from support import command, direct_recording

from estimator.estimation.gram import Gram, solve
from estimator.geometry.array import SensorArray, tetrahedron, triad
from estimator.geometry.model import Prior, regressor_maps
from estimator.observations.rows import observations
from station.bench.bench import default_bench_text


def rows_of(array: SensorArray, kind: str, rate_hz: float) -> tuple[np.ndarray, np.ndarray]:
    """Return body rates and outputs of a 360 s recording."""
    states = np.tile([0.005, 0.0017, 0.0017, -0.0017], (len(array), 1))
    recording = direct_recording(0, kind=kind, array=array, states=states, rate_hz=rate_hz)
    parts = list(observations(recording, recording.sources["array"]))
    return np.vstack([p.w_rps for p in parts]), np.vstack([p.y_rps for p in parts])


def plain_filter(w: np.ndarray, y: np.ndarray, array: SensorArray, noise: np.ndarray) -> np.ndarray:
    """Return the states x (m, 4) of a filterpy loop that updates once a sample."""
    from filterpy.kalman import KalmanFilter

    m = len(array)
    maps = regressor_maps(array)
    kalman = KalmanFilter(dim_x=4 * m, dim_z=m)
    kalman.x = np.zeros((4 * m, 1))
    kalman.P = np.diag(np.tile(Prior().variances(), m))
    kalman.R = np.diag(noise**2)
    z = (y - w @ array.p.T)[:, :, None]
    h = np.zeros((m, 4 * m))
    regressors = np.einsum("mij,nj->nmi", maps, np.column_stack([np.ones(len(w)), w]))
    for n in range(len(w)):
        for i in range(m):
            h[i, 4 * i : 4 * i + 4] = regressors[n, i]
        kalman.update(z[n], H=h)
    return np.asarray(kalman.x).reshape(m, 4)


def batch() -> None:
    array = triad()
    w, y = rows_of(array, "triad", 2000.0)
    noise = np.full(3, np.radians(0.005) * np.sqrt(2000))
    times = []
    for _ in range(5):
        began = time.perf_counter()
        solution = solve(Gram.of(w, y), array, Prior(), noise)
        times.append(time.perf_counter() - began)
    began = time.perf_counter()
    x = plain_filter(w, y, array, noise)
    loop = time.perf_counter() - began
    sd = np.sqrt(np.diagonal(solution.covariance, axis1=1, axis2=2))
    print(f"rows {len(w)}; batch {np.median(times) * 1e3:.1f} ms; filterpy loop {loop:.1f} s")
    print(f"batch is {loop / np.median(times):.0f} x faster; differ by {np.abs((x - solution.x) / sd).max():.1e} sigma")


def product() -> None:
    array = tetrahedron()
    w, y = rows_of(array, "tetrahedron", 4000.0)
    columns = np.column_stack([np.ones(len(w)), w, y])
    estimates, products = [], []
    for _ in range(15):  # in turn, so that both see the same machine
        began = time.perf_counter()
        solve(Gram.of(w, y), array, Prior())
        between = time.perf_counter()
        _ = columns.T @ columns
        estimates.append(between - began)
        products.append(time.perf_counter() - between)
    ours, theirs = np.median(estimates) * 1e3, np.median(products) * 1e3
    print(f"rows {len(w)}; batch estimate {ours:.1f} ms, X.T @ X {theirs:.1f} ms: {ours / theirs:.2f} x (bar 2 x)")


def agree() -> None:
    array = tetrahedron()
    w, y = rows_of(array, "tetrahedron", 100.0)
    noise = np.full(4, np.radians(0.05))
    solution = solve(Gram.of(w, y), array, Prior(), noise)
    sd = np.sqrt(np.diagonal(solution.covariance, axis1=1, axis2=2))
    difference = np.abs((plain_filter(w, y, array, noise) - solution.x) / sd).max()
    print(f"plain filterpy loop and batch at 100 Hz differ by {difference:.1e} sigma")


def runs() -> None:
    with tempfile.TemporaryDirectory() as folder:
        fast = Path(folder) / "bench.toml"
        fast.write_text(default_bench_text().replace('rate = "500 Hz"', 'rate = "2000 Hz"'))
        for name, options in (
            ("main job, 4 gyros on CAN", []),
            ("STIM300 at 2 kHz", ["--bench", str(fast), "--device", "stim300"]),
        ):
            began = time.perf_counter()
            read_end, write_end = os.pipe()
            child = os.posix_spawn(
                command()[0],
                [*command("run", "--json", "-o", Path(folder) / f"{name[:4]}.h5"), *options],
                os.environ,
                file_actions=[(os.POSIX_SPAWN_DUP2, write_end, 1)],
            )
            os.close(write_end)
            with os.fdopen(read_end) as said:
                result = json.loads(said.read())
            _, _, usage = os.wait4(child, 0)
            print(
                f"{name}: {result['outcome']} in {time.perf_counter() - began:.1f} s wall, peak memory "
                f"{usage.ru_maxrss / 1024:.0f} MB, mean NIS {result['nis_mean']:.3f}"
            )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("batch", "product", "agree", "runs"))
    {"batch": batch, "product": product, "agree": agree, "runs": runs}[parser.parse_args().what]()
