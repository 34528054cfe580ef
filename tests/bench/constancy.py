"""What is measured changes in mid-run: how often that is told, and how often nothing is told of a run that is spoilt.

python tests/bench/constancy.py 20             so many cases of each kind, from the physics, without a wire
python tests/bench/constancy.py 20 --held      other seeds, benches, scripts, kept for the end
python tests/bench/constancy.py 200 --clean    runs in which nothing changes: false alarms, and the sigmas' truth

A PASS is false if a state is off by more than five of its sigmas from what the gyro was before the change and from what
it was after (a state of which only one of the two was measured is right for that one); "before" counts those that are
off from the former, whatever the latter. "shown" counts false ones in which the change leaves ten sigmas or more beside
states that are fitted to it: a script that turns each axis once cannot show what changed between two turns.
"""

from __future__ import annotations

import argparse
import concurrent.futures
import json
import random
import tempfile
from collections import defaultdict
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import station
from estimator.estimation.calibrate import calibrate
from estimator.observations.rows import source_blocks
from estimator.recordings.recording import Recording
from station.bench.bench import Bench, Limits, load_bench
from station.opening.simulate import simulate_bench
from station.opening.twins import truth_of
from station.run.outcome import Outcome, judge
from station.scripts.loop_scripts import exploration_script, verification_script
from station.scripts.script import paper_script

BENCHES = Path(__file__).parents[1] / "data" / "benches"
DEFAULT = Path(station.__file__).parent / "bench" / "default_bench.toml"
SCRIPTS = {"paper": paper_script, "exploration": exploration_script, "verification": verification_script}
SETS = {
    False: (0, ("default", "galil_j1939", "two_triads"), ("paper", "exploration")),
    True: (50_000, ("acutrol_vectornav", "described", "rtu_stim300", "default"), ("verification", "paper")),
}
"""First seed, benches and scripts of the cases that were looked at, and of those kept for the end."""
FALSE, SHOWN = 5.0, 10.0
LIMITS = Limits(*(6 * (np.inf,)), nis_low=0.8, nis_high=1.2, lost=1.0)
"""Nothing is limited that could tell of a change by its size alone."""
KINDS = (
    "scale step",
    "alignment step",
    "gearing, followed",
    "gearing",
    "angle alone",
    "creep, followed",
    "creep",
    "rate register",
    "rate of the other sign",
    "jump at rest",
    "a turn at rest",
    "frozen",
    "stale rate",
)


@dataclass(frozen=True, slots=True)
class Case:
    """A bench, a script, a seed, and what is wrong: tables of a hidden-effects file."""

    kind: str
    bench: str
    script: str
    seed: int
    said: dict[str, Any]


@dataclass(frozen=True, slots=True)
class Found:
    """How a case ended; ``off`` and ``off_before``: the worst state in its sigmas, ``shown``: what the change left."""

    case: Case
    outcome: str
    reason: str
    off: float
    off_before: float
    scores: np.ndarray
    shown: float


def bench_of(name: str) -> Bench:
    return load_bench(DEFAULT if name == "default" else BENCHES / f"{name}.toml")


def case_of(kind: str, seed: int, *, held: bool) -> Case:
    """Return one case of a kind, drawn by its seed."""
    first, benches, scripts = SETS[held]
    dice = random.Random(f"{kind} {first + seed}")
    bench, script = dice.choice(benches), dice.choice(scripts)
    gyros = [len(imu.array) for imu in bench_of(bench).imus if imu.used]
    length_s, sign = SCRIPTS[script]().duration_s, dice.choice((-1, 1))
    at_s = dice.uniform(0.05, 0.95) * length_s
    reading: dict[str, Any] = {"axis": dice.choice("xyz"), "from": f"{at_s} s"}
    share = f"{sign * dice.choice((0.1, 0.2, 0.5, 1.0))} %"
    said: dict[str, Any] = {}
    if kind in ("scale step", "alignment step"):
        chosen, count = dice.randrange(min(gyros)), min(gyros)
        unit, sizes = ("ppm", (500, 1000, 2000, 5000)) if kind == "scale step" else ("deg", (0.03, 0.1, 0.3))
        size = sign * dice.choice(sizes)
        key = "size" if kind == "scale step" else dice.choice(("sigma_j", "sigma_k"))
        each = [f"{size if gyro == chosen else 0} {unit}" for gyro in range(count)]
        said = {kind.replace(" ", "_"): {key: each, "at": f"{at_s} s"}}
        return Case(kind, bench, script, first + seed, said)
    if kind.startswith("gearing"):
        reading |= {"angle": share} | ({"followed": True} if "followed" in kind else {"rate": share})
    elif kind == "angle alone":
        reading |= {"angle": share}
    elif kind.startswith("creep"):
        reading |= {"creep": f"{sign * 0.01} deg/s", "until": f"{at_s + dice.uniform(3, 60)} s"}
        reading |= {"followed": True} if "followed" in kind else {}
    elif kind == "rate register":
        reading |= {"rate": f"{sign} %", "from": "0 s"}
    elif kind == "rate of the other sign":
        reading |= {"rate": "-200 %", "from": "0 s"}
    elif kind in ("jump at rest", "a turn at rest"):
        reading |= {"jump": f"{sign * (3 if 'jump' in kind else 360)} deg", "from": f"{dice.uniform(3, 14)} s"}
    else:
        reading |= {"frozen" if kind == "frozen" else "stale": True, "until": f"{at_s + dice.uniform(1, 20)} s"}
    return Case(kind, bench, script, first + seed, {"table_reading": reading})


def found_of(case: Case) -> Found:
    """Make a case, calibrate and judge it."""
    bench = bench_of(case.bench)
    with tempfile.NamedTemporaryFile("w", suffix=".toml") as hidden:
        for name, table in case.said.items():
            lines = (f"{key} = {json.dumps(value)}\n" for key, value in table.items())
            hidden.write(f"[{name}]\n" + "".join(lines))
        hidden.flush()
        made = replace(bench, twin=replace(bench.twin, hidden=Path(hidden.name)))
        recording = simulate_bench(made, SCRIPTS[case.script](), case.seed)
    calibration = calibrate(recording, excluded=bench.excluded)
    shown = shown_by(recording, simulate_bench(bench, SCRIPTS[case.script](), case.seed)) if case.said else 0.0
    verdict = judge(calibration, LIMITS)
    truths = {imu.name: truth_of(bench.twin.truths.again(), imu) for imu in bench.imus if imu.used}
    off, before, scores = [], [], []
    for device, truth in truths.items():
        own = [gyro for gyro in calibration.gyros if gyro.device == device]
        wide = [np.broadcast_to(v, len(own)) for v in (truth.k, truth.b_rps, truth.sigma_j_rad, truth.sigma_k_rad)]
        then, after = np.array(wide).T, np.array(wide).T
        if "scale_step" in case.said:
            after[:, 0] -= (
                (1 - then[:, 0]) * np.array([float(s.split()[0]) for s in case.said["scale_step"]["size"]]) * 1e-6
            )
        for column, key in ((2, "sigma_j"), (3, "sigma_k")):
            if key in case.said.get("alignment_step", {}):
                after[:, column] += np.radians([float(s.split()[0]) for s in case.said["alignment_step"][key]])
        states, sd = np.array([gyro.states for gyro in own]), np.array([gyro.sd for gyro in own])
        low, high = np.minimum(then, after), np.maximum(then, after)
        nearest = np.where(np.abs(states - low) < np.abs(states - high), low, high)
        off.append(np.abs((states - nearest) / sd).max())
        before.append(np.abs((states - then) / sd).max())
        scores.append((states - then) / sd)
    return Found(case, str(verdict.outcome), verdict.reason, max(off), max(before), np.vstack(scores), shown)


def shown_by(spoilt: Recording, clean: Recording) -> float:
    """Return by how many sigmas of white noise a change shows at best, beside states that are fitted to it."""
    squares = 0.0
    for name, data in spoilt.sources.items():
        ours, its = source_blocks(spoilt, data), source_blocks(clean, clean.sources[name])
        _, here, there = np.intersect1d(ours.index, its.index, return_indices=True)
        one = np.column_stack([np.ones(len(here)), ours.w_rps[here]])
        change = ours.z_rps[here] - its.z_rps[there]
        left = change - one @ np.linalg.lstsq(one, change, rcond=None)[0]
        squares += float(np.sum(left**2)) * ours.length_s / data.noise.arw**2
    return float(np.sqrt(squares))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("count", type=int)
    parser.add_argument("--held", action="store_true")
    parser.add_argument("--clean", action="store_true")
    parser.add_argument("--kind", choices=KINDS)
    parser.add_argument("--verbose", action="store_true")
    parser.add_argument("--jobs", type=int, default=1)
    told = parser.parse_args()
    kinds = ("clean",) if told.clean else (told.kind,) if told.kind else KINDS
    cases = [case_of(kind, seed, held=told.held) for kind in kinds for seed in range(told.count)]
    rows: dict[str, list[Found]] = defaultdict(list)
    with concurrent.futures.ProcessPoolExecutor(told.jobs) as pool:
        for found in pool.map(
            found_of, [Case(c.kind, c.bench, c.script, c.seed, {}) if told.clean else c for c in cases]
        ):
            rows[found.case.kind].append(found)
            false = found.outcome == Outcome.PASS and found.off > FALSE
            if false or told.verbose or (told.clean and found.outcome != Outcome.PASS):
                print(f"{'FALSE ' if false else ''}{found.outcome} off {found.off:.1f}, shown {found.shown:.1f}:")
                print(f"  {found.case}\n  {found.reason}", flush=True)
    print(f"{'kind':24} {'cases':>5} {'PASS':>5} {'false':>5} {'shown':>5} {'before':>6} {'rms score':>9}")
    for kind, its in rows.items():
        good = [found for found in its if found.outcome == Outcome.PASS]
        false, before = (sum(getattr(f, key) > FALSE for f in good) for key in ("off", "off_before"))
        shown = sum(found.off > FALSE and found.shown > SHOWN for found in good)
        rms = float(np.sqrt(np.mean(np.concatenate([f.scores.ravel() for f in its]) ** 2)))
        print(f"{kind:24} {len(its):5} {len(good):5} {false:5} {shown:5} {before:6} {rms:9.2f}")


if __name__ == "__main__":
    main()
