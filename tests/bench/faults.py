"""Runs with faults of twins and wires, one at a time and in random pairs: how they end.

python tests/bench/faults.py                  every fault on every bench of tests/data/benches once
python tests/bench/faults.py --pairs 200      random pairs, seeded

Virtual time, all in one process each. Each run must leave the table at rest and a file that can be read, name the right
device if it ends by a fault, show no traceback, and end within a minute of the wall's clock.
"""

from __future__ import annotations

import argparse
import asyncio
import concurrent.futures
import functools
import itertools
import random
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from estimator.recordings.reading import read_recording
from station.bench.bench import load_bench
from station.opening import open_bench
from station.run.event_loop.loops import VirtualLoop
from station.run.outcome import Outcome
from station.run.session import Session
from station.scripts.script import load_script

BENCHES = Path(__file__).parents[1] / "data" / "benches"
SCRIPT = """
[[step]]
kind = "rest"
duration = "6 s"
[[step]]
kind = "rotate"
axis = "z"
rate = "20 deg/s"
duration = "14 s"
acceleration = "20 deg/s2"
[[step]]
kind = "rest"
duration = "2 s"
"""
WIRE = {
    "latency": 'latency = "10 ms"',
    "jitter": 'jitter = "5 ms"',
    "loss": 'loss = "2 %"',
    "one byte at a time": "one_byte = true",
    "bit flips": 'bit_flips = "0.1 %"',
    "silence": 'silent_from = "{at} s"',
    "unplug": 'unplug = "{at} s"',
}
DEVICE = {
    "stuck": 'stuck = 2\nfrom = "{at} s"',
    "saturated": 'saturated = 2\nfrom = "{at} s"',
    "dropped": 'dropped = "2 %"',
    "doubled": 'doubled = "2 %"',
    "clock drift": 'clock = "50 ppm"',
}
TABLE = {
    "device fault": 'axis = "z"\nat = "{at} s"\nkind = "fault"',
    "limit switch": 'axis = "z"\nat = "{at} s"\nkind = "limit"',
    "servo trip": 'axis = "z"\nat = "{at} s"\nkind = "servo"',
}
ENDS_THE_RUN = {"silence", "unplug", "device fault", "limit switch", "servo trip"}
"""Faults that no run gets over when they come while the table turns."""


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault of the table ("table") or of a device by name."""

    device: str
    kind: str
    text: str


@dataclass(frozen=True, slots=True)
class Ended:
    """How a run with faults ended, and what is wrong with that, if anything."""

    bench: str
    faults: tuple[Fault, ...]
    outcome: str
    reason: str
    wrong: str
    wall_s: float


@functools.cache
def faults_of(bench: str) -> list[Fault]:
    """Return every fault that a bench can have, during the turn where it begins at an instant."""
    read = load_bench(BENCHES / f"{bench}.toml")
    # Of lines of text a wire can pass single bytes.
    device, on_bytes = read.imus[0].name, read.table.protocol != "modbus"
    table = {**{k: v for k, v in WIRE.items() if on_bytes or k != "one byte at a time"}, **TABLE}
    both = [("table", kind, text) for kind, text in table.items()]
    both += [(device, kind, text) for kind, text in {**WIRE, **DEVICE}.items()]
    return [Fault(name, kind, text.format(at=12.0)) for name, kind, text in both]


def ended(case: tuple[str, tuple[Fault, ...], int]) -> Ended:
    """Run a bench with faults; never raises."""
    bench, faults, seed = case
    began = time.perf_counter()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        twin = f'[twin]\nseed = {seed}\nwatchdog = "1 s"\n'
        text = (BENCHES / f"{bench}.toml").read_text().replace("[twin]\n", twin, 1)
        tables: dict[str, list[str]] = {}
        for fault in faults:
            key = "twin.fault" if fault.device == "table" else f"twin.{fault.device}.fault"
            tables.setdefault(key, []).append(fault.text)
        text += "".join(f"\n[{key}]\n" + "\n".join(lines) + "\n" for key, lines in tables.items())
        (folder / "bench.toml").write_text(text)
        (folder / "script.toml").write_text(SCRIPT)
        try:
            outcome, reason, wrong = _run(folder)
        except BaseException as error:  # what a person would see as a traceback
            outcome, reason, wrong = "", "", f"raised {type(error).__name__}: {error}"
    return Ended(
        bench, faults, outcome, reason, wrong or _misjudged(faults, outcome, reason), time.perf_counter() - began
    )


def _run(folder: Path) -> tuple[str, str, str]:
    bench, path = load_bench(folder / "bench.toml"), folder / "run.h5"

    async def main() -> tuple[str, str, str]:
        async with open_bench(bench) as opened:
            result = await Session(opened, load_script(folder / "script.toml"), path).run()
            turning = not opened.at_rest()
            if turning:  # a table that cannot be reached is stopped by its own watchdog
                await asyncio.sleep(2 * bench.twin.watchdog_s + 5.0)
                turning = not opened.at_rest()
        return str(result.verdict.outcome), result.verdict.reason, "the table turns" if turning else ""

    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        outcome, reason, wrong = runner.run(main())
    if "defect of the station" in reason:
        wrong = reason
    if not wrong and outcome in ("PASS", "FAIL"):
        read_recording(path)
    return outcome, reason, wrong


def _misjudged(faults: tuple[Fault, ...], outcome: str, reason: str) -> str:
    if outcome == str(Outcome.FAULT):
        named = [fault for fault in faults if reason.startswith(f"{fault.device}:") or f"({fault.device}:" in reason]
        return "" if named else f"no device that has a fault is named in {reason!r}"
    fatal = [fault for fault in faults if fault.kind in ENDS_THE_RUN]
    return f"{fatal[0].kind} of {fatal[0].device} passed unseen" if fatal else ""


def compatible(pair: tuple[Fault, ...]) -> bool:
    """Return whether two faults can be written into one bench file."""
    keys = [(fault.device, line.split(" =")[0]) for fault in pair for line in fault.text.split("\n")]
    return len(set(keys)) == len(keys)


def campaign(pairs: int, first_seed: int = 0) -> list[tuple[str, tuple[Fault, ...], int]]:
    """Return each fault once on each bench, or so many random pairs."""
    benches = sorted(path.stem for path in BENCHES.glob("*.toml"))
    if not pairs:
        return [(bench, (fault,), 0) for bench in benches for fault in faults_of(bench)]
    cases = []
    for seed in itertools.count(first_seed):
        dice = random.Random(seed)
        bench = dice.choice(benches)
        pair = tuple(dice.sample(faults_of(bench), 2))
        if compatible(pair):
            cases.append((bench, pair, seed))
        if len(cases) == pairs:
            return cases
    return cases


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, default=0)
    parser.add_argument("--verbose", action="store_true")
    arguments = parser.parse_args()
    cases = campaign(arguments.pairs)
    bad = 0
    with concurrent.futures.ProcessPoolExecutor(2) as pool:
        for found in pool.map(ended, cases):
            bad += bool(found.wrong)
            if found.wrong or arguments.verbose:
                said = ", ".join(f"{fault.device} {fault.kind}" for fault in found.faults)
                print(f"{found.bench}, {said}: {found.outcome} {found.reason} ({found.wall_s:.1f} s)", flush=True)
                if found.wrong:
                    print(f"  WRONG: {found.wrong}", flush=True)
    print(f"{len(cases) - bad} of {len(cases)} ended as they should")
