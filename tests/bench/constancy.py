"""What is measured changes in mid-run: how often that is told, and how often nothing is told of a run that is spoilt.

python tests/bench/constancy.py 20             so many cases of each kind, from the physics, without a wire
python tests/bench/constancy.py 20 --held      other seeds, benches, scripts, kept for the end
python tests/bench/constancy.py 200 --clean    runs in which nothing changes: false alarms, and the sigmas' truth
python tests/bench/constancy.py 8 --between    changes while everything rests, before, between and after turns

A PASS is false if a state is off by more than five of its sigmas from what the gyro was before the change and from what
it was after (a state of which only one of the two was measured is right for that one); "before" counts those that are
off from the former, whatever the latter. "shown" counts false ones in which the change leaves ten sigmas or more beside
states that are fitted to it: a script that turns each axis once cannot show what changed between two turns.

With ``--between`` "silent" counts the false ones that do not say so: the verdict must hold the words "constancy not
proved", and the JSON must state, of an axis that the change concerns, that its constancy is not proved at that instant.
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
from station.render.printing import result_object
from station.run.outcome import Outcome, judge
from station.scripts.loop_scripts import between_rests, exploration_script, there_and_back, verification_script
from station.scripts.script import Rest, Rotate, Script, Step, paper_script

BENCHES = Path(__file__).parents[1] / "data" / "benches"
DEFAULT = Path(station.__file__).parent / "bench" / "default_bench.toml"


def turn(axis: str, rate_dps: float, duration_s: float) -> Rotate:
    """Return a turn with ramps of 20 deg/s2."""
    return there_and_back(axis, rate_dps, duration_s)[0]


def forth_and_back() -> Script:
    """Return each axis turned forth and at once back, one axis after the other: 330 s."""
    return between_rests("forth and back", [step for axis in "xyz" for step in there_and_back(axis, 20.0, 50.0)])


def close_together() -> Script:
    """Return each axis turned twice with a rest of 4 s between its turns: 342 s."""
    steps: list[Step] = []
    for axis in "xyz":
        steps += [turn(axis, 15.0, 50.0), Rest(4.0), turn(axis, 15.0, 50.0)]
    return between_rests("close together", steps)


def slow_then_fast() -> Script:
    """Return each axis turned slowly and briefly at the start, fast at the end: 315 s."""
    slow = [turn(axis, 5.0, 15.0) for axis in "xyz"]
    fast = [turn(axis, -40.0, 60.0) for axis in "zyx"]
    return between_rests("slow then fast", [*slow, Rest(60.0), *fast])


def strong_at_either_end() -> Script:
    """Return x turned mostly early, y and z mostly late; each also briefly at the other end: 326 s."""
    early = [turn("x", 30.0, 60.0), turn("y", 6.0, 12.0), turn("z", 6.0, 12.0)]
    late = [turn("x", -6.0, 12.0), turn("y", 30.0, 60.0), turn("z", 30.0, 60.0)]
    return between_rests("strong at either end", [*early, Rest(80.0), *late])


def one_axis_once() -> Script:
    """Return x and y turned early and late, z once in the middle: 330 s."""
    ends = [turn(axis, 20.0, 50.0) for axis in "xy"]
    back = [turn(axis, -20.0, 50.0) for axis in "xy"]
    return between_rests("one axis once", [*ends, turn("z", 20.0, 100.0), *back])


def early_and_late() -> Script:
    """Return each axis turned early, and late in the other direction: 340 s."""
    early = [turn(axis, 20.0, 40.0) for axis in "xyz"]
    late = [turn(axis, -20.0, 40.0) for axis in "xyz"]
    return between_rests("early and late", [*early, Rest(70.0), *late])


SCRIPTS = {
    "paper": paper_script,
    "exploration": exploration_script,
    "verification": verification_script,
    "forth and back": forth_and_back,
    "close together": close_together,
    "slow then fast": slow_then_fast,
    "strong at either end": strong_at_either_end,
    "one axis once": one_axis_once,
    "early and late": early_and_late,
}
SETS = {
    False: (0, ("default", "galil_j1939", "two_triads"), ("paper", "exploration")),
    True: (50_000, ("acutrol_vectornav", "described", "rtu_stim300", "default"), ("verification", "paper")),
}
"""First seed, benches and scripts of the cases that were looked at, and of those kept for the end."""
BETWEEN = {
    False: (
        100_000,
        ("default", "galil_j1939", "two_triads"),
        ("paper", "forth and back", "slow then fast", "early and late"),
    ),
    True: (
        150_000,
        ("default", "acutrol_vectornav", "described", "rtu_stim300"),
        ("paper", "close together", "strong at either end", "one axis once", "early and late", "exploration"),
    ),
}
"""The same of the changes between turns."""
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
BETWEEN_KINDS = ("gearing", "gearing, followed", "scale step", "alignment step")
NOT_PROVED = "constancy not proved"


@dataclass(frozen=True, slots=True)
class Case:
    """A bench, a script, a seed, and what is wrong: tables of a hidden-effects file."""

    kind: str
    bench: str
    script: str
    seed: int
    said: dict[str, Any]
    at_s: float = float("nan")
    axes: str = "xyz"


@dataclass(frozen=True, slots=True)
class Found:
    """How a case ended; ``off`` and ``off_before``: the worst state in its sigmas, ``shown``: what the change left.

    ``told``: whether verdict and JSON both say that nothing proves that there was no such change.
    """

    case: Case
    outcome: str
    reason: str
    off: float
    off_before: float
    scores: np.ndarray
    shown: float
    told: bool


def bench_of(name: str) -> Bench:
    return load_bench(DEFAULT if name == "default" else BENCHES / f"{name}.toml")


def case_of(kind: str, seed: int, *, held: bool, between: bool = False) -> Case:
    """Return one case of a kind, drawn by its seed; ``between``: its change is at the end of a step."""
    first, benches, scripts = (BETWEEN if between else SETS)[held]
    dice = random.Random(f"{kind} {first + seed}")
    bench, script = dice.choice(benches), dice.choice(scripts)
    gyros = [len(imu.array) for imu in bench_of(bench).imus if imu.used]
    length_s, sign = SCRIPTS[script]().least_s, dice.choice((-1, 1))
    at_s = dice.uniform(0.05, 0.95) * length_s
    if between:
        timeline = SCRIPTS[script]().timeline()
        at_s = dice.choice([0.5 * timeline[0].span.least_s, *(timed.start_s for timed in timeline[1:])])
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
        return Case(kind, bench, script, first + seed, said, at_s)
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
    return Case(kind, bench, script, first + seed, {"table_reading": reading}, at_s, reading["axis"])


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
    said = result_object(verdict, "", calibration)
    told = NOT_PROVED in verdict.reason and any(
        entry["axis"] in case.axes
        and (entry["covered_s"] is None or not entry["covered_s"][0] <= case.at_s <= entry["covered_s"][1])
        for entry in said.get("constancy", ())
    )
    return Found(case, str(verdict.outcome), verdict.reason, max(off), max(before), np.vstack(scores), shown, told)


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
    parser.add_argument("--between", action="store_true")
    parser.add_argument("--kind", choices=KINDS)
    parser.add_argument("--verbose", action="store_true")
    parser.add_argument("--jobs", type=int, default=1)
    told = parser.parse_args()
    kinds = BETWEEN_KINDS if told.between else KINDS
    kinds = ("clean",) if told.clean else (told.kind,) if told.kind else kinds
    cases = [case_of(kind, seed, held=told.held, between=told.between) for kind in kinds for seed in range(told.count)]
    rows: dict[str, list[Found]] = defaultdict(list)
    with concurrent.futures.ProcessPoolExecutor(told.jobs) as pool:
        for found in pool.map(
            found_of, [Case(c.kind, c.bench, c.script, c.seed, {}) if told.clean else c for c in cases]
        ):
            rows[found.case.kind].append(found)
            false = found.outcome == Outcome.PASS and found.off > FALSE
            if false or told.verbose or (told.clean and found.outcome != Outcome.PASS):
                silent = "SILENT " if false and told.between and not found.told else ""
                word = "FALSE " if false else ""
                print(f"{silent}{word}{found.outcome} off {found.off:.1f}, shown {found.shown:.1f}:")
                print(f"  {found.case}\n  {found.reason}", flush=True)
    heads = ("cases", "PASS", "false", "shown", "silent", "before", "rms score")
    print(f"{'kind':24}" + "".join(f"{head:>{max(len(head), 5) + 1}}" for head in heads))
    for kind, its in rows.items():
        good = [found for found in its if found.outcome == Outcome.PASS]
        false, before = (sum(getattr(f, key) > FALSE for f in good) for key in ("off", "off_before"))
        shown = sum(found.off > FALSE and found.shown > SHOWN for found in good)
        rms = float(np.sqrt(np.mean(np.concatenate([f.scores.ravel() for f in its]) ** 2)))
        silent = sum(found.off > FALSE and not found.told for found in good)
        print(f"{kind:24} {len(its):5} {len(good):5} {false:5} {shown:5} {silent:6} {before:6} {rms:9.2f}")


if __name__ == "__main__":
    main()
