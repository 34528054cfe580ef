"""A whole IMU on the shipped script: coverage of the intervals of all states and of the lever arm, and speed.

python tests/bench/full_imu.py coverage --runs 200       gyros and accelerometers with other true errors in each run,
                                                         errors and stated sigmas over the Cramér-Rao bound
python tests/bench/full_imu.py coverage --between-counts --noise-spread 3
                                                         the same with poses anywhere within a count of the encoders,
                                                         and noise of the twins that differs from the data sheet
python tests/bench/full_imu.py effects --runs 60         one hidden effect of accelerometers in each run: is it named?
python tests/bench/full_imu.py clean --runs 40           none: is anything named?
python tests/bench/full_imu.py live --runs 3             live filters against estimates from all samples, in sigmas
python tests/bench/full_imu.py speed                     360 s at 4 kHz with six channels, against three
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from cramer_rao import COUNT_RAD, TOGETHER, Bound, Motion, Sensors, Whitening, force_bounds, gyro_bound

from estimator.estimation.calibrate import calibrate
from estimator.estimation.live.forces import LiveForces, white_forces
from estimator.estimation.live.sample_columns import white_solution
from estimator.estimation.live.source import LiveSource
from estimator.recordings.motion.body_rates import BodyRates
from estimator.recordings.recording import Recording
from estimator.tracing.accelerometers.trace_forces import trace_forces
from station.bench.bench import Bench, load_bench, read_bench
from station.opening.simulate import simulate_bench
from station.opening.twins import force_truth_of, mounting_of, truth_of
from station.scripts.script import Script, load_script
from station.scripts.steps.pose import Aim, Pose

BENCH = Path(__file__).parents[1] / "data" / "benches" / "full_imu.toml"
WITHIN = 1.959964
STATES = ("k", "b", "sigma_j", "sigma_k")
DEVICE, RATE_HZ = "mti", 100.0
# Standard deviations of the true errors from run to run: those of the data sheet, a tenth for what a triad promises.
GYRO = {"k": (1000.0, "ppm"), "b": (30.0, "deg/h"), "sigma_j": (1.0, "mrad"), "sigma_k": (1.0, "mrad")}
FORCE = {"k": (2000.0, "ppm"), "b": (10.0, "mg"), "sigma_j": (2.0, "mrad"), "sigma_k": (2.0, "mrad")}
PLACES = {"lever_arm": (50.0, "mm"), "size": (2.0, "mm")}


def drawn_bench(seed: int, noise_spread: float = 1.0) -> Bench:
    """Return the bench with other true errors of its device, and another true gravity.

    The bias instabilities are those of the data sheet times factors of which one standard deviation is
    ``noise_spread``.
    """
    random = np.random.default_rng([seed, 29])
    text = BENCH.read_text(encoding="utf-8")
    before, _, _ = text.partition("[twin.mti]")
    factors = noise_spread ** np.random.default_rng([seed, 41]).standard_normal(2)
    lines = ["[twin.mti]", *_drawn(random, GYRO), f'bias_instability = "{0.3 * factors[0]:.6f} deg/h"', ""]
    lines += ["[twin.mti.accelerometers]", *_drawn(random, FORCE | PLACES)]
    gravity = 9.80619777 * (1 + 5e-5 * random.standard_normal())
    delay_ms = 1.0 + random.standard_normal()
    lines += ['vrw = "60 ug/rtHz"', f'bias_instability = "{15 * factors[1]:.6f} ug"', f'delay = "{delay_ms:.6f} ms"']
    lines.append(f'gravity = "{gravity:.9f} m/s2"')
    return read_bench("\n".join([before, *lines, ""]), f"seed {seed}")


def _drawn(random: np.random.Generator, sizes: dict[str, tuple[float, str]]) -> list[str]:
    """Return a line of a bench file for each key, with three values drawn at random."""
    lines = []
    for key, (size, unit) in sizes.items():
        values = ", ".join(f'"{size * value:.6f} {unit}"' for value in random.standard_normal(3))
        lines.append(f"{key} = [{values}]")
    return lines


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Figures:
    """What one run found of values (sensors, values) of a kind: their errors, stated sigmas, and Cramér-Rao bound.

    ``counted`` is the bound with angles of standing axes that are only known to a count of the encoders.
    """

    error: np.ndarray
    sd: np.ndarray
    bound: np.ndarray
    counted: np.ndarray


def figures_of(bench: Bench, seed: int, script: Script) -> dict[str, Figures]:
    """Return the figures of one run: of the states of gyros and accelerometers, of places, of the delay."""
    recording = simulate_bench(bench, script, seed)
    found = calibrate(recording, excluded=bench.excluded, innovations=False)
    (imu,) = bench.imus
    felt = force_truth_of(bench.twin.truths.again(), imu, bench.site)
    truth = truth_of(bench.twin.truths.again(), imu)
    assert felt is not None
    force, gravity_mps2 = felt
    gyro_truth = np.column_stack([truth.k, truth.b_rps, truth.sigma_j_rad, truth.sigma_k_rad])
    force_truth = np.column_stack([force.k, force.b_mps2, force.sigma_j_rad, force.sigma_k_rad])
    (forces,) = found.forces
    assert forces.offset is not None
    of_gyros, exact, counted = bounds_of(bench, script, gyro_truth, force_truth)
    ours = forces.accelerometers
    return {
        "gyros": Figures(
            error=np.array([one.states for one in found.gyros]) - gyro_truth,
            sd=np.array([one.sd for one in found.gyros]),
            bound=of_gyros.states,
            counted=of_gyros.states,
        ),
        "accelerometers": Figures(
            error=np.array([one.states for one in ours]) - force_truth,
            sd=np.array([one.sd for one in ours]),
            bound=exact.states,
            counted=counted.states,
        ),
        "places": Figures(
            error=np.array([one.place_m for one in ours]) - force.places_m,
            sd=np.array([one.place_sd_m for one in ours]),
            bound=exact.places_m,
            counted=counted.places_m,
        ),
        "delay": Figures(
            error=np.array([[forces.offset.offset_s - force.delay_s]]),
            sd=np.array([[forces.offset.sd_s]]),
            bound=np.array([[exact.delay_s]]),
            counted=np.array([[counted.delay_s]]),
        ),
    }


def bounds_of(
    bench: Bench, script: Script, gyro_states: np.ndarray, force_states: np.ndarray
) -> tuple[Bound, Bound, Bound]:
    """Return the Cramér-Rao bounds of gyros, of accelerometers, and of these with angles known to a count."""
    (imu,) = bench.imus
    truth = truth_of(bench.twin.truths.again(), imu)
    felt = force_truth_of(bench.twin.truths.again(), imu, bench.site)
    assert bench.site is not None
    assert felt is not None
    force, gravity_mps2 = felt
    motion = Motion(
        script,
        rate_hz=imu.rate_hz,
        gimbals=bench.table.gimbals,
        latitude_rad=bench.site.latitude_rad,
        heading_rad=bench.site.heading_rad,
    )
    mounting = mounting_of(bench.twin.truths.again(), imu)
    gyros = Sensors(p=mounting.p, j=mounting.j, k=mounting.k, states=gyro_states)
    accelerometers = replace(gyros, states=force_states, places_m=force.places_m, delay_s=force.delay_s)
    groups = len(motion.t_s) // TOGETHER
    of_gyros, of_forces = (
        Whitening(white=white, instability=instability, rate_hz=imu.rate_hz, groups=groups)
        for white, instability in (
            (truth.arw_rps_rthz, truth.bias_instability_rps),
            (force.vrw_mps2_rthz, force.bias_instability_mps2),
        )
    )
    return gyro_bound(motion, gyros, of_gyros), *force_bounds(
        motion, accelerometers, of_forces, gravity_mps2=gravity_mps2
    )


def between_counts(script: Script, seed: int) -> Script:
    """Return the script with each angle of its poses moved by up to half a count of the encoders, either way."""
    random = np.random.default_rng([seed, 37])

    def moved(aim: Aim) -> Aim:
        return replace(aim, angle_rad=aim.angle_rad + COUNT_RAD * random.uniform(-0.5, 0.5))

    steps = (replace(s, aims=tuple(map(moved, s.aims))) if isinstance(s, Pose) else s for s in script.steps)
    return replace(script, steps=tuple(steps))


def coverage(arguments: argparse.Namespace) -> None:
    """Print for each value how many of the true ones are within the 95 % intervals, and errors and sigmas in bounds."""
    found: dict[str, list[Figures]] = {}
    shipped = load_script(Path("full-imu"))
    for number, seed in enumerate(range(arguments.first, arguments.first + arguments.runs)):
        script = between_counts(shipped, seed) if arguments.between_counts else shipped
        for what, figures in figures_of(drawn_bench(seed, arguments.noise_spread), seed, script).items():
            found.setdefault(what, []).append(figures)
        if (number + 1) % 10 == 0:
            print(f"{number + 1} runs of {arguments.runs}", file=sys.stderr, flush=True)
    print(
        f"{arguments.runs} runs from seed {arguments.first}; rms of sensors and runs; / CRB: over the Cramér-Rao bound"
    )
    print(
        f"{'':24}{'within':>8}{'error/sigma':>13}{'error/CRB':>11}{'sigma/CRB':>11}"
        f"{'error/CRB counted':>19}{'sigma/CRB counted':>19}"
    )
    for what, parts in found.items():
        names = {"places": "xyz", "delay": ("delay",)}.get(what, STATES)
        whole = {key: np.array([getattr(one, key) for one in parts]) for key in ("error", "sd", "bound", "counted")}
        for column, name in enumerate(names):
            line(f"{what} {name}", {key: values[:, :, column] for key, values in whole.items()})
            for sensor in range(parts[0].error.shape[0]) if arguments.each else ():
                line(f"    of {'xyz'[sensor]}", {key: values[:, sensor, column] for key, values in whole.items()})
    if arguments.keep is not None:
        kept = {
            f"{what} {key}": [getattr(p, key) for p in ps] for what, ps in found.items() for key in Figures.__slots__
        }
        np.savez(arguments.keep, **kept)


def line(name: str, values: Mapping[str, np.ndarray]) -> None:
    """Print a line of the table of ``coverage``."""
    error, sd, bound, counted = (values[key] for key in ("error", "sd", "bound", "counted"))
    within = 100 * np.mean(np.abs(error) < WITHIN * sd)
    ratios = [np.sqrt(np.mean(r**2)) for r in (error / sd, error / bound, sd / bound, error / counted, sd / counted)]
    print(
        f"{name:24}{within:7.1f} {ratios[0]:13.3f}{ratios[1]:11.3f}{ratios[2]:11.3f}{ratios[3]:19.3f}{ratios[4]:19.3f}",
        flush=True,
    )


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


def live(runs: int, first: int) -> None:
    """Print by how much the live filters, fed a second at a time, differ from the estimates from all samples at once.

    The largest difference of a value in sigmas, and of a sigma in itself, of gyros and of accelerometers.
    """
    worst = 0.0
    for seed in range(first, first + runs):
        recording = simulate_bench(drawn_bench(seed), load_script(Path("full-imu")), seed)
        for what, (x, sd, batch, batch_sd) in zip(("gyros", "accelerometers"), replayed(recording), strict=True):
            apart, grown = float(np.abs((x - batch) / batch_sd).max()), float(np.abs(sd / batch_sd - 1).max())
            worst = max(worst, apart)
            print(
                f"seed {seed}: {what}: {x.size} values within {apart:.1e} sigma, sigmas within {grown:.1e}", flush=True
            )
    print(f"at most {worst:.1e} sigma (bar 1e-6)")


def replayed(recording: Recording) -> list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
    """Return values and sigmas of the live filter, then those of all samples at once: of gyros, of accelerometers."""
    table, data = recording.table, recording.sources[DEVICE]
    assert table is not None
    assert data.noise is not None
    noise_rps = data.noise.arw * np.sqrt(RATE_HZ)
    gyros = LiveSource(array=data.array, rate_hz=RATE_HZ, noise_rps=noise_rps, prior=data.prior)
    forces = LiveForces.of(recording, DEVICE)
    rates = BodyRates(table.gimbals, recording.site)
    for since_ns in range(int(table.t_ns[0]), int(table.t_ns[-1]) + 1, 1_000_000_000):
        read, taken = ((t >= since_ns) & (t < since_ns + 1_000_000_000) for t in (table.t_ns, data.t_ns))
        half_ns = None if table.half_width_ns is None else table.half_width_ns[read]
        rates.add(table.t_ns[read], table.angle_rad[read], table.rate_rps[read], half_ns, table.rate_window_ns)
        columns = {key: getattr(data, key)[taken] for key in ("t_ns", "rate_rps", "temperature_c", "accel_mps2")}
        block = SimpleNamespace(**columns)
        gyros.add(block)
        forces.add(block)
        gyros.advance(rates)
        forces.advance(rates)
    rates.finish()
    gyros.advance(rates, flush=True)
    forces.advance(rates, flush=True)
    about = gyros.prior, gyros.noise_rps, gyros.offset_sd_s, gyros.history.taken_off
    of_gyros, of_forces = white_solution(recording, data, None, *about), white_forces(recording, DEVICE, forces)
    x, covariance = gyros.filter.state()
    force_x, force_covariance = forces.state()
    diagonals = [np.sqrt(np.diagonal(c, axis1=-2, axis2=-1)) for c in (covariance, of_gyros.covariance)]
    of_accelerometers = [np.sqrt(np.diag(c)) for c in (force_covariance, of_forces.covariance)]
    return [
        (x, diagonals[0], of_gyros.x, diagonals[1]),
        (force_x, of_accelerometers[0], of_forces.x, of_accelerometers[1]),
    ]


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
    parser.add_argument("part", choices=("coverage", "effects", "clean", "live", "speed"))
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--first", type=int, default=0, help="seed of the first run")
    parser.add_argument("--each", action="store_true", help="coverage of each sensor, too")
    parser.add_argument("--between-counts", action="store_true", help="poses anywhere within a count of the encoders")
    parser.add_argument("--noise-spread", type=float, default=1.0, help="factor by which noise is off the data sheet")
    parser.add_argument("--keep", type=Path, help="an .npz file for the figures of all runs")
    arguments = parser.parse_args()
    if arguments.part == "coverage":
        coverage(arguments)
    elif arguments.part in ("effects", "clean"):
        effects(arguments.runs, arguments.first, planted=arguments.part == "effects")
    elif arguments.part == "live":
        live(arguments.runs, arguments.first)
    else:
        speed()


if __name__ == "__main__":
    load_bench(BENCH)  # a mistake in it is told before anything is made
    main()
