"""A whole IMU on the shipped script: coverage of the intervals of all states and of the lever arm, and speed.

python tests/bench/full_imu.py coverage --runs 200       gyros and accelerometers with other true errors in each run
python tests/bench/full_imu.py effects --runs 60         one hidden effect of accelerometers in each run: is it named?
python tests/bench/full_imu.py clean --runs 40           none: is anything named?
python tests/bench/full_imu.py speed                     360 s at 4 kHz with six channels, against three
"""

from __future__ import annotations

import argparse
import os
import time
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from estimator.estimation.calibrate import calibrate
from estimator.recordings.recording import Recording
from estimator.tracing.accelerometers.trace_forces import trace_forces
from station.bench.bench import Bench, load_bench, read_bench
from station.opening.simulate import simulate_bench
from station.scripts.script import load_script

BENCH = Path(__file__).parents[1] / "data" / "benches" / "full_imu.toml"
WITHIN = 1.959964
STATES = ("k", "b", "sigma_j", "sigma_k")
DEVICE = "mti"
# Standard deviations of the true errors from run to run: those of the data sheet, a tenth for what a triad promises.
GYRO = {"k": (1000.0, "ppm"), "b": (30.0, "deg/h"), "sigma_j": (1.0, "mrad"), "sigma_k": (1.0, "mrad")}
FORCE = {"k": (2000.0, "ppm"), "b": (10.0, "mg"), "sigma_j": (2.0, "mrad"), "sigma_k": (2.0, "mrad")}
PLACES = {"lever_arm": (50.0, "mm"), "size": (2.0, "mm")}


def drawn_bench(seed: int) -> Bench:
    """Return the bench with other true errors of its device, and another true gravity."""
    random = np.random.default_rng([seed, 29])
    text = BENCH.read_text(encoding="utf-8")
    before, _, _ = text.partition("[twin.mti]")
    lines = ["[twin.mti]", *_drawn(random, GYRO), 'bias_instability = "0.3 deg/h"', ""]
    lines += ["[twin.mti.accelerometers]", *_drawn(random, FORCE | PLACES)]
    gravity = 9.80619777 * (1 + 5e-5 * random.standard_normal())
    delay_ms = 1.0 + random.standard_normal()
    lines += ['vrw = "60 ug/rtHz"', 'bias_instability = "15 ug"', f'delay = "{delay_ms:.6f} ms"']
    lines.append(f'gravity = "{gravity:.9f} m/s2"')
    return read_bench("\n".join([before, *lines, ""]), f"seed {seed}")


def _drawn(random: np.random.Generator, sizes: dict[str, tuple[float, str]]) -> list[str]:
    """Return a line of a bench file for each key, with three values drawn at random."""
    lines = []
    for key, (size, unit) in sizes.items():
        values = ", ".join(f'"{size * value:.6f} {unit}"' for value in random.standard_normal(3))
        lines.append(f"{key} = [{values}]")
    return lines


def errors_of(bench: Bench, seed: int) -> dict[str, np.ndarray]:
    """Return the errors over their stated sigmas of one run: of the states of gyros and accelerometers, of places."""
    from station.opening.twins import force_truth_of, truth_of

    recording = simulate_bench(bench, load_script(Path("full-imu")), seed)
    found = calibrate(recording, excluded=bench.excluded, innovations=False)
    (imu,) = bench.imus
    felt = force_truth_of(bench.twin.truths.again(), imu, bench.site)
    truth = truth_of(bench.twin.truths.again(), imu)
    assert felt is not None
    gyro_truth = np.column_stack([truth.k, truth.b_rps, truth.sigma_j_rad, truth.sigma_k_rad])
    force = felt[0]
    force_truth = np.column_stack([force.k, force.b_mps2, force.sigma_j_rad, force.sigma_k_rad])
    (forces,) = found.forces
    assert forces.offset is not None
    accelerometers = forces.accelerometers
    return {
        "gyros": np.array([(g.states - t) / g.sd for g, t in zip(found.gyros, gyro_truth, strict=True)]),
        "accelerometers": np.array([(a.states - t) / a.sd for a, t in zip(accelerometers, force_truth, strict=True)]),
        "places": np.array(
            [(a.place_m - t) / a.place_sd_m for a, t in zip(accelerometers, force.places_m, strict=True)]
        ),
        "delay": np.array([[(forces.offset.offset_s - force.delay_s) / forces.offset.sd_s]]),
    }


def coverage(runs: int, first: int) -> None:
    """Print for each state how many of the true values are within the 95 % intervals, and the rms error in sigmas."""
    found: dict[str, list[np.ndarray]] = {}
    for seed in range(first, first + runs):
        for what, errors in errors_of(drawn_bench(seed), seed).items():
            found.setdefault(what, []).append(errors)
    for what, parts in found.items():
        errors = np.array(parts)
        within = np.mean(np.abs(errors) < WITHIN, axis=(0, 1))
        rms = np.sqrt(np.mean(errors**2, axis=(0, 1)))
        names = {"places": "xyz", "delay": ("delay",)}.get(what, STATES)
        cells = [f"{n} {100 * w:.1f} % (rms {r:.3f})" for n, w, r in zip(names, within, rms, strict=True)]
        print(f"{what:15} {runs} runs: " + ", ".join(cells), flush=True)


# What a twin may hide, at the size that data sheets of MEMS accelerometers state: by the key of the twin the name that
# an investigation gives it, and the size of one standard deviation.
PLANTED = {
    "asymmetry": ("asymmetry", 1000.0, "ppm"),
    "second_order": ("second_order", 150.0, "ppm/g"),
    "third_order": ("third_order", 250.0, "ppm/g2"),
    "cross": ("cross_j", 150.0, "ppm/g"),
    "vibration": ("vibration_rectification", 100.0, "ug/(rad/s)2"),
    "b_slope": ("bias_over_temperature", 200.0, "ug/degC"),
    "k_slope": ("scale_over_temperature", 100.0, "ppm/degC"),
}


def effects(runs: int, first: int, planted: bool) -> None:
    """Print how many effects are named with the certainty that is stated, and how many of these names are right."""
    named = right = added = 0
    keys = list(PLANTED)
    for seed in range(first, first + runs):
        key = keys[seed % len(keys)]
        name, size, unit = PLANTED[key]
        random = np.random.default_rng([seed, 31])
        values = size * random.choice([-1.0, 1.0], 3) * random.uniform(0.5, 1.5, 3)
        line = f"{key} = [" + ", ".join(f'"{value:.6f} {unit}"' for value in values) + "]\n" if planted else ""
        bench = read_bench(drawn_bench(seed).text + line, f"seed {seed}")
        run, check = (simulate_bench(bench, load_script(Path("full-imu")), seed + number) for number in (0, 5000))
        (found,) = trace_forces([run], [check])
        told = [effect.effect.name for effect in found.effects]
        named += bool(told)
        added += len(told)
        right += told == [name]
        print(
            f"{seed}: {name if planted else 'none'}: {', '.join(told) or 'nothing'} {dict(found.suspects)}", flush=True
        )
    print(
        f"named in {named} of {runs} runs, {added} names; right in {right}" if planted else f"{added} names in {runs}"
    )


def speed() -> None:
    """Print the processor time of ``calibrate`` with and without the accelerometers of a fast device."""
    bench = load_bench(BENCH)
    fast = replace(bench, imus=tuple(replace(imu, rate_hz=4000.0) for imu in bench.imus))
    recording = simulate_bench(fast, load_script(Path("full-imu")), 1)
    whole = _cut(recording, 360.0)
    gyros = replace(
        whole,
        sources={n: replace(d, accel_mps2=None, accel_axes=None, accel_sheet=None) for n, d in whole.sources.items()},
    )
    times: dict[str, list[float]] = {"three gyros": [], "whole IMU": []}
    for _ in range(3):
        for what, one in (("three gyros", gyros), ("whole IMU", whole)):
            begun = time.process_time()
            calibrate(one, excluded=frozenset())
            times[what].append(time.process_time() - begun)
    for what, taken in times.items():
        print(f"{what}: {min(taken):.2f} s of processor time")
    print(f"ratio {min(times['whole IMU']) / min(times['three gyros']):.2f} (bar 2)")


def _cut(recording: Recording, length_s: float) -> Recording:
    """Return the first part of a simulated recording."""
    sources = {}
    for name, data in recording.sources.items():
        n = int(np.searchsorted(data.t_ns, length_s * 1e9))
        columns = {key: getattr(data, key)[:n] for key in ("t_ns", "rate_rps", "temperature_c", "accel_mps2")}
        sources[name] = replace(data, **columns)
    return replace(recording, sources=sources)


def main() -> None:
    """Run the part that is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=("coverage", "effects", "clean", "speed"))
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--first", type=int, default=0, help="seed of the first run")
    arguments = parser.parse_args()
    if arguments.part == "coverage":
        coverage(arguments.runs, arguments.first)
    elif arguments.part in ("effects", "clean"):
        effects(arguments.runs, arguments.first, planted=arguments.part == "effects")
    else:
        speed()


if __name__ == "__main__":
    load_bench(BENCH)  # a mistake in it is told before anything is made
    main()
