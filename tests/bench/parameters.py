"""How often 95 % intervals hold the true parameters of effects, under bias instability and rate random walk.

python tests/bench/parameters.py                                    (every effect, 30 seeds, 10 deg/h)
python tests/bench/parameters.py --effects g_sensitivity --seeds 100 --instability 10 --walk 10
python tests/bench/parameters.py --by model                         (of station calibrate --model, the 360 s script)
python tests/bench/parameters.py --by investigate --seeds 10        (nobody names the effects; those found count)

The motion of each run is made once, without noise; a seed adds the noise of the gyros to it. The truth is what the
estimate without noise says. Two recordings are fitted (the 360 s script and exploration), as in the study of detection.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache, partial

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from detection_study.study import STATES, hidden_of
from known_effects import fit_known
from numpy.typing import NDArray
from scipy.signal import lfilter
from support import SITE

from estimator.estimation.calibrate import calibrate
from estimator.geometry.array import tetrahedron
from estimator.recordings.recording import Recording
from estimator.tracing.augmented import Augmented
from estimator.tracing.investigate import investigate
from estimator.tracing.type_model import error_model_of
from station.opening import DeviceTruth, simulate
from station.scripts.loop_scripts import exploration_script
from station.scripts.script import paper_script

Floats = NDArray[np.float64]

EFFECTS = (
    "g_sensitivity",
    "thermal_bias",
    "thermal_scale",
    "bias_drift",
    "scale_asymmetry",
    "scale_cubic",
    "acceleration_sensitivity",
    "table_harmonic",
    "warm_up",
    "latency",
)
RATE_HZ = 100.0
ARW_DPS = 0.005
TIMES_S = np.array([1.0, 10.0, 100.0, 1000.0])
SHARE = 0.664 / 0.775  # IEEE Std 952: a floor of 0.664 B, and that of a decade-spaced sum of processes of equal size


@dataclass(frozen=True, slots=True)
class Case:
    """Errors over sigmas of the states (n, 4) and of the parameters of the effect (n, p)."""

    states: Floats
    parameters: Floats


@lru_cache(maxsize=4)
def quiet(effect: str, seed: int) -> tuple[Recording, ...]:
    """Return the recordings of an effect without noise."""
    device = DeviceTruth(tetrahedron(), STATES, float(np.radians(1e-7)), 0.0, rate_hz=RATE_HZ, kind="tetrahedron")
    hidden = hidden_of([effect], 1.0, seed)
    scripts = (paper_script(), exploration_script())
    return tuple(simulate(script, {"array": device}, 0, site=SITE, hidden=hidden) for script in scripts)


def noise(count: int, gyros: int, seed: Sequence[int], instability_dph: float, walk_dph_rth: float) -> Floats:
    """Return noise (count, gyros) in rad/s: white, Gauss-Markov processes of decades of times, random walk."""
    random = np.random.default_rng(seed)
    out = np.radians(ARW_DPS) * np.sqrt(RATE_HZ) * random.standard_normal((count, gyros))
    for keep in np.exp(-1 / (RATE_HZ * TIMES_S)).tolist():
        push = np.sqrt(1 - keep**2) * random.standard_normal((count, gyros))
        push[0] /= np.sqrt(1 - keep**2)
        out += SHARE * np.radians(instability_dph / 3600) * lfilter([1.0], [1.0, -keep], push, axis=0)
    steps = random.standard_normal((count, gyros)) / np.sqrt(RATE_HZ)
    return np.asarray(out + np.radians(walk_dph_rth / 3600 / 60) * np.cumsum(steps, axis=0))


def noisy(recording: Recording, seed: Sequence[int], instability_dph: float, walk_dph_rth: float) -> Recording:
    """Return a recording with noise added to its outputs."""
    data = recording.sources["array"]
    added = noise(*data.rate_rps.shape, seed, instability_dph, walk_dph_rth)
    return replace(recording, sources={"array": replace(data, rate_rps=data.rate_rps + added)})


@lru_cache(maxsize=4)
def truth_of(effect: str, seed: int) -> Augmented:
    """Return the model that the recordings without noise have."""
    return fit_known(quiet(effect, seed), [effect])


def sizes_in(model: Augmented, number: int = 0) -> tuple[Floats, Floats]:
    """Return the parameters of an effect of a model and their standard deviations, in SI, each (n, p)."""
    part = model.parts[number]
    candidate, where = part.candidate, model.slice_of(part.candidate.name)
    scale = np.resize(candidate.effect.largest, part.width)
    sd = np.sqrt(np.diagonal(model.covariance, axis1=1, axis2=2))[:, where] * scale
    mean = model.mean[:, where] * scale
    if candidate.by_size:  # its size is that which was looked for, not that of its column
        mean = np.full_like(mean, abs(candidate.theta or 0.0))
    return (mean[:1], sd[:1]) if part.term.shared else (mean, sd)


def one(seed: int, effect: str, by: str, of: int, instability_dph: float, walk_dph_rth: float) -> Case | None:
    """Return the errors of one seed, None if the effect was not found; ``of`` seeds share an effect's sizes."""
    true = truth_of(effect, seed // of)
    wanted = sizes_in(true)[0]
    runs = [noisy(r, (seed, n), instability_dph, walk_dph_rth) for n, r in enumerate(quiet(effect, seed // of))]
    if by == "model":
        gyros = calibrate(runs[0], model=error_model_of(true)).gyros
        values = np.array([[(v.value, v.sd) for v in gyro.effects] for gyro in gyros])[: len(wanted)]
        states = np.array([(gyro.states - own) / gyro.sd for gyro, own in zip(gyros, STATES, strict=True)])
        return Case(states, (values[..., 0] - wanted) / values[..., 1])
    found = fit_known(runs, [effect]) if by == "known" else investigate(runs).model
    assert found is not None
    number = next((n for n, part in enumerate(found.parts) if part.candidate.called == effect), None)
    if number is None:
        return None
    mean, sd = sizes_in(found, number)
    return Case(
        (found.mean[:, :4] - true.mean[:, :4]) / np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2))[:, :4],
        (mean - wanted) / sd if mean.shape == wanted.shape else np.empty((0, 1)),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--effects", nargs="+", default=list(EFFECTS))
    parser.add_argument("--by", choices=("known", "model", "investigate"), default="known")
    parser.add_argument("--seeds", type=int, default=30)
    parser.add_argument("--of", type=int, default=10, help="so many seeds share an effect's sizes")
    parser.add_argument("--instability", type=float, default=10.0, help="bias instability in deg/h")
    parser.add_argument("--walk", type=float, default=0.0, help="rate random walk in deg/h/rth")
    parser.add_argument("--workers", type=int, default=2)
    arguments = parser.parse_args()
    print("effect                     coverage, %: parameters    k    b   sj   sk   rms error, sigmas: parameters")
    with ProcessPoolExecutor(arguments.workers) as pool:
        for effect in arguments.effects:
            work = partial(
                one,
                effect=effect,
                by=arguments.by,
                of=arguments.of,
                instability_dph=arguments.instability,
                walk_dph_rth=arguments.walk,
            )
            found = [c for c in pool.map(work, range(arguments.seeds), chunksize=arguments.of) if c is not None]
            if not found:
                print(f"{effect:38s}       none found", flush=True)
                continue
            states = np.concatenate([c.states for c in found])
            parameters = np.concatenate([c.parameters.ravel() for c in found])
            held = " ".join(f"{h:4.0f}" for h in 100 * np.mean(np.abs(states) < 1.96, axis=0))
            print(
                f"{effect:38s} {100 * np.mean(np.abs(parameters) < 1.96):10.1f} {held} "
                f"{np.sqrt(np.mean(parameters**2)):16.2f}   of {len(parameters)}",
                flush=True,
            )


if __name__ == "__main__":
    main()
