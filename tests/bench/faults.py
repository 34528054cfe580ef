"""Runs with faults of twins, wires, hosts and of what is measured: how they end, each judged.

python tests/bench/faults.py 600               seeds 0 to 599: a bench, one fault or two, each in a phase of the run
python tests/bench/faults.py 200 --held        other seeds, and a bench and faults that are kept for the end
python tests/bench/faults.py --seed 17         exactly that run, told in full
python tests/bench/faults.py --each            every fault once on every bench, during the turn

Virtual time, on all cores. A run must end within 30 s of virtual time beyond its script, leave a file that can be read
and the table at rest by a stop of the station's (by its own watchdog only if nothing can reach it), name a device that
has a fault if it ends by one, call nothing a defect of the station, and not PASS with a state off by more than five of
its sigmas from all that the gyro was in the run.
"""

from __future__ import annotations

import argparse
import asyncio
import concurrent.futures
import functools
import itertools
import math
import os
import random
import re
import signal
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

import h5py
import numpy as np

from estimator.calibration.values import Calibration
from estimator.recordings.reading import read_recording
from station.bench.bench import Bench, load_bench
from station.opening import open_bench
from station.opening.twins import truth_of
from station.run.event_loop.loops import VirtualLoop, run_to_end
from station.run.outcome import Outcome
from station.run.session import Result, Session
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
LIMITS = '[limits]\nnis_low = 0.8\nnis_high = 1.2\nlost = "90 %"\n'
"""Nothing is limited that could tell of a fault by its size alone."""
WIRE = {
    "latency": 'latency = "10 ms"',
    "jitter": 'jitter = "5 ms"',
    "loss": 'loss = "2 %"',
    "one byte at a time": "one_byte = true",
    "bit flips": 'bit_flips = "0.1 %"',
    "silence": 'silent_from = "{at} s"',
    "unplug": 'unplug = "{at} s"',
    "replug": 'unplug = "{at} s"\nreplug = "{at} s + 0.4 s"',
    "another device": 'unplug = "{at} s"\nreplug = "{at} s + 0.4 s"\nanother = "{at} s + 0.2 s"',
    "exchanged": 'another = "{at} s"',
}
DEVICE = {
    "stuck": 'stuck = 2\nfrom = "{at} s"',
    "saturated": 'saturated = 2\nfrom = "{at} s"',
    "dropped": 'dropped = "2 %"\nfrom = "{at} s"',
    "doubled": 'doubled = "2 %"\nfrom = "{at} s"',
    "clock drift": 'clock = "50 ppm"',
    "huge": 'huge = "1 %"\nfrom = "{at} s"',
    "no temperature": "no_temperature = true",
    "swapped": 'swapped = "2 %"',
    "repeats": 'repeats = "{at} s"',
    "backwards": 'backwards = "{at} s"',
}
TABLE = {
    "device fault": 'axis = "z"\nat = "{at} s"\nkind = "fault"',
    "limit switch": 'axis = "z"\nat = "{at} s"\nkind = "limit"',
    "servo trip": 'axis = "z"\nat = "{at} s"\nkind = "servo"',
    "runaway": 'axis = "y"\nat = "{at} s"\nkind = "runaway"',
}
READING = {
    "frozen encoder": "frozen = true",
    "jump by a turn": 'jump = "360 deg"',
    "jump by 3 deg": 'jump = "3 deg"',
    "stale rate": "stale = true",
    "rate 1 % off": 'rate = "1 %"',
    "rate of the other sign": 'rate = "-200 %"',
    "gearing": 'angle = "0.5 %"',
    "gearing, followed": 'angle = "0.5 %"\nfollowed = true',
    "creep": 'creep = "0.01 deg/s"\nuntil = "{at} s + 6 s"',
}
HOST = ("clock set", "suspended", "memory short", "disk error", "interrupted twice")
STEP_PPM = 2000.0
ENDS_THE_RUN = {"silence", "unplug", "device fault", "limit switch", "servo trip", "runaway"}
"""Faults that no run gets over when they come while the table turns."""
NOT_FOR = {"modbus": {"one byte at a time", "exchanged", "another device"}}
"""Lines of text can be passed in single bytes; the controller on Modbus TCP is one server for all."""
PHASES = ("opening", "homing", "rest", "ramp", "turn", "last rest", "closing")
HELD_BENCH, HELD_FAULTS, HELD_SEED = "two_triads", {"backwards", "suspended", "stale rate", "swapped"}, 100_000
_TURN_S = 12.0
_HANGS_S, _WALL_S = 30.0, 240
_OFF = 5.0


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault of the table ("table"), of a device by name, or of the "host"."""

    device: str
    kind: str
    text: str
    phase: str = "turn"
    at_s: float = _TURN_S

    @property
    def section(self) -> str:
        """Where the text stands: in the bench file, "" for the hidden-effects file, or nowhere."""
        if self.kind in READING or self.kind == "scale step" or self.device == "host":
            return ""
        return "twin.fault" if self.device == "table" else f"twin.{self.device}.fault"

    @property
    def said(self) -> str:
        return f"{self.device} {self.kind} ({self.phase}, {self.at_s:.2f} s)"


@dataclass(frozen=True, slots=True)
class Ended:
    """How a run with faults ended, and what is wrong with that, if anything."""

    bench: str
    faults: tuple[Fault, ...]
    outcome: str
    reason: str
    wrong: str
    wall_s: float
    seed: int = 0


Case = tuple[str, tuple[Fault, ...], int]


@functools.cache
def faults_of(bench: str, at_s: float = _TURN_S, phase: str = "turn") -> list[Fault]:
    """Return every fault that a bench can have, those that begin at an instant at this one."""
    read = load_bench(BENCHES / f"{bench}.toml")
    device = next(imu.name for imu in read.imus if imu.used)
    table = {kind: text for kind, text in {**WIRE, **TABLE}.items() if kind not in NOT_FOR.get(read.table.protocol, ())}
    both = [("table", kind, text) for kind, text in table.items()]
    both += [(device, kind, text) for kind, text in {**WIRE, **DEVICE}.items()]
    both += [("table", kind, _reading(text)) for kind, text in READING.items()]
    both += [(device, "scale step", f'[scale_step]\nsize = "{STEP_PPM:g} ppm"\nat = "{{at}} s"\n')]
    both += [("host", kind, "") for kind in HOST]
    return [Fault(name, kind, _at(text, at_s), phase, at_s) for name, kind, text in both]


def _reading(text: str) -> str:
    return f'[table_reading]\naxis = "z"\nfrom = "{{at}} s"\n{text}\n'


def _at(text: str, at_s: float) -> str:
    """Put the instant in, and add what stands beside it."""
    text = text.replace("{at}", f"{at_s:.3f}")
    return re.sub(r"([\d.]+) s \+ ([\d.]+) s", lambda sum: f"{float(sum[1]) + float(sum[2]):.3f} s", text)


@functools.cache
def instants(bench: str) -> dict[str, tuple[float, float]]:
    """Return when each phase begins and ends in a run of this bench without a fault, and "end"."""
    with tempfile.TemporaryDirectory() as name:
        folder = _folder(name, bench, (), 0, lenient=True)
        ran = _Run(folder, ())
        ran.go()
        with h5py.File(folder / "run.h5") as file:
            texts = [bytes(text).decode() for text in file["events/text"]]
            began_s = file["events/t_ns"][texts.index("script begins")] * 1e-9
    home_s = 0.5 * began_s
    spans = (0.0, home_s, began_s, began_s + 6.0, began_s + 7.0, began_s + 19.0, began_s + 21.5, ran.ended_s)
    return {**dict(zip(PHASES, itertools.pairwise(spans), strict=True)), "end": (ran.ended_s, ran.ended_s)}


def _folder(name: str, bench: str, faults: Sequence[Fault], seed: int, *, lenient: bool) -> Path:
    folder = Path(name)
    hidden = "".join(fault.text for fault in faults if not fault.section)
    twin = f'[twin]\nseed = {seed}\nwatchdog = "1 s"\n' + 'hidden = "hidden.toml"\n' * bool(hidden)
    text = (BENCHES / f"{bench}.toml").read_text().replace("[twin]\n", twin, 1)
    if lenient:
        text = re.sub(r"\[limits\]\n(?:(?!\[).*\n)*", LIMITS + "\n", text)
    tables: dict[str, list[str]] = {}
    for fault in faults:
        if fault.section:
            tables.setdefault(fault.section, []).append(fault.text)
    text += "".join(f"\n[{key}]\n" + "\n".join(lines) + "\n" for key, lines in tables.items())
    (folder / "hidden.toml").write_text(hidden)
    (folder / "bench.toml").write_text(text)
    (folder / "script.toml").write_text(SCRIPT)
    return folder


class _Run:
    """One run in virtual time, and what was seen of it from outside."""

    def __init__(self, folder: Path, faults: Sequence[Fault]) -> None:
        self.folder, self.faults = folder, faults
        self.bench = load_bench(folder / "bench.toml")
        self.result: Result | None = None
        self.ended_s, self.turned, self.turns = math.inf, False, False
        self._shift_s = 0.0

    def go(self) -> Result:
        told = time.time
        clock = mock.patch("time.time", side_effect=lambda: told() + self._shift_s)
        with clock, asyncio.Runner(loop_factory=VirtualLoop) as runner:
            return run_to_end(runner, self._main())

    async def _main(self) -> Result:
        loop = asyncio.get_running_loop()
        async with open_bench(self.bench) as opened:
            session = Session(opened, load_script(self.folder / "script.toml"), self.folder / "run.h5")
            for fault in self.faults:
                if fault.device == "host":
                    loop.call_later(fault.at_s, self._strike, fault.kind)
            self.result = await session.run()
            self.ended_s = loop.time()
            await asyncio.sleep(0.01)  # rates that a drive calls zero end within that
            self.turned = not opened.at_rest()
            if self.turned:  # a table that cannot be reached is stopped by its own watchdog
                await asyncio.sleep(2 * self.bench.twin.watchdog_s + 5.0)
            self.turns = not opened.at_rest()
        return self.result

    def _strike(self, kind: str) -> None:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, VirtualLoop)
        if kind == "clock set":
            self._shift_s += 3600.0
        elif kind == "suspended":
            loop._now += 5.0
        elif kind == "memory short":
            raise MemoryError("none left")
        elif kind == "disk error":
            raise OSError(5, "Input/output error")
        else:
            loop.call_later(0.05, self._strike, "interrupt")
            raise KeyboardInterrupt


def ended(case: Case, *, lenient: bool = False) -> Ended:
    """Run a bench with faults; never raises. ``lenient``: limits that a short script can meet."""
    bench, faults, seed = case
    began = time.perf_counter()
    with tempfile.TemporaryDirectory() as name:
        outcome = reason = ""
        try:
            _limit_wall()
            ran = _Run(_folder(name, bench, faults, seed, lenient=lenient), faults)
            verdict = ran.go().verdict
            outcome, reason = str(verdict.outcome), verdict.reason
            wrong = _misjudged(ran, instants(bench)["end"][0] if lenient else math.inf)
        except BaseException as error:  # what a person would see as a traceback
            wrong = f"raised {type(error).__name__}: {error}"
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
    return Ended(bench, faults, outcome, reason, wrong, time.perf_counter() - began, seed)


def _limit_wall() -> None:
    def end(*_: object) -> None:
        raise TimeoutError(f"no end within {_WALL_S} s of the wall's clock")

    if os.name == "posix":
        signal.signal(signal.SIGALRM, end)
        signal.setitimer(signal.ITIMER_REAL, _WALL_S)


def _misjudged(ran: _Run, usual_end_s: float) -> str:
    assert ran.result is not None
    verdict, faults = ran.result.verdict, ran.faults
    late_s = sum(6.0 for fault in faults if fault.kind == "suspended")
    if "defect of the station" in verdict.reason:
        return verdict.reason
    if ran.ended_s > usual_end_s + _HANGS_S + late_s:
        return f"it hung: it ended at {ran.ended_s:.1f} s, {ran.ended_s - usual_end_s:.1f} s late"
    gone = any(fault.device == "table" and fault.kind in {*WIRE, "suspended"} for fault in faults)
    if ran.turns or (ran.turned and not gone):
        return "the table turns" if ran.turns else "the table turned when the session had ended"
    return _in_file(ran) or _named(faults, verdict.outcome, verdict.reason) or _off(ran)


def _in_file(ran: _Run) -> str:
    assert ran.result is not None
    verdict = ran.result.verdict
    with h5py.File(ran.folder / "run.h5") as file:
        if (file.attrs["outcome"], file.attrs["reason"]) != (str(verdict.outcome), verdict.reason):
            return "the file says another outcome, or reason"
    if verdict.outcome in (Outcome.PASS, Outcome.FAIL):
        read_recording(ran.folder / "run.h5")
    return ""


def _named(faults: Sequence[Fault], outcome: Outcome, reason: str) -> str:
    if outcome is Outcome.FAULT:
        named = [fault for fault in faults if reason.startswith(f"{fault.device}:") or f"({fault.device}:" in reason]
        behind = any(fault.kind == "suspended" for fault in faults)  # a drive's watchdog, or a source that fell silent
        return "" if named or behind else f"no device that has a fault is named in {reason!r}"
    if outcome is Outcome.ABORTED:
        return "" if any(fault.device == "host" for fault in faults) else f"it was aborted: {reason!r}"
    fatal = [fault for fault in faults if fault.kind in ENDS_THE_RUN and fault.phase in ("ramp", "turn")]
    return f"{fatal[0].kind} of {fatal[0].device} passed unseen" if fatal else ""


def _off(ran: _Run) -> str:
    """Return which state of a run that passed is off from all that its gyro was."""
    assert ran.result is not None
    found = ran.result.calibration
    if ran.result.verdict.outcome is not Outcome.PASS or found is None:
        return ""
    off, row, state = worst(found, ran.bench, ran.faults)
    name = ("k", "b", "sigma_j", "sigma_k")[state]
    return f"PASS with {name} of {found.gyros[row].name} off by {off:.1f} sigma" if off > _OFF else ""


def worst(found: Calibration, bench: Bench, faults: Sequence[Fault]) -> tuple[float, int, int]:
    """Return by how many of its sigmas the worst state is off from the nearest it was, its gyro and its column."""
    rows: dict[str, Iterator[Any]] = {}
    for imu in (imu for imu in bench.imus if imu.used):
        true = truth_of(bench.twin.truths.again(), imu)
        of_states = [
            np.broadcast_to(x, len(imu.array)) for x in (true.k, true.b_rps, true.sigma_j_rad, true.sigma_k_rad)
        ]
        shifts = [_shift(fault) for fault in faults if fault.device == imu.name]
        shifts += [-STEP_PPM * 1e-6] * any(fault.kind == "scale step" for fault in faults)
        of_k = np.array([0.0, *shifts, *(3 - len(shifts)) * [0.0]])[:, None, None] * [1.0, 0.0, 0.0, 0.0]
        rows[imu.name] = iter(np.swapaxes(np.column_stack(of_states) + of_k, 0, 1))  # (gyro, instant, state)
    # A calibration may name the gyros of several devices in turn; those of one device are in its order.
    off = np.array([np.min(abs(next(rows[g.device]) - g.states) / g.sd, axis=0) for g in found.gyros])
    row, state = np.unravel_index(np.nanargmax(off), off.shape)
    return float(off[row, state]), int(row), int(state)


def _shift(fault: Fault) -> float:
    return 0.005 if fault.kind in ("another device", "exchanged") else 0.0


def compatible(faults: Sequence[Fault]) -> bool:
    """Return whether faults can be written into one bench file."""
    keys = [(f.section, line.split(" =")[0]) for f in faults for line in f.text.split("\n") if line]
    return len(set(keys)) == len(keys)


def drawn(seed: int) -> Case:
    """Return the run of a seed: a bench, one fault or two, each at an instant of some phase."""
    dice, held = random.Random(seed), seed >= HELD_SEED
    benches = sorted(path.stem for path in BENCHES.glob("*.toml"))
    bench = dice.choice([name for name in benches if held or name != HELD_BENCH])
    while True:
        faults = tuple(_fault(dice, bench, held=held) for _ in range(dice.choice((1, 2))))
        if compatible(faults):
            return bench, faults, seed


def _fault(dice: random.Random, bench: str, *, held: bool) -> Fault:
    phase = dice.choice(PHASES)
    at_s = round(dice.uniform(*instants(bench)[phase]), 3)
    while True:
        fault = dice.choice(faults_of(bench, at_s, phase))
        if held or fault.kind not in HELD_FAULTS:
            return fault


def each() -> list[Case]:
    """Return each fault once on each bench, during the turn."""
    benches = sorted(path.stem for path in BENCHES.glob("*.toml"))
    return [(bench, (fault,), 0) for bench in benches for fault in faults_of(bench)]


def _judged(seed: int) -> Ended:
    return ended(drawn(seed), lenient=True)


def _each_judged(case: Case) -> Ended:
    return ended(case, lenient=True)


def _told(all_found: Sequence[Ended]) -> Iterator[str]:
    """Yield a table by fault, one by bench, and each defect with what repeats it."""
    by_fault = [
        (f"{f.device if f.device in ('table', 'host') else 'imu'} {f.kind}", e) for e in all_found for f in e.faults
    ]
    for title, keys in (("fault", by_fault), ("bench", [(e.bench, e) for e in all_found])):
        rows: dict[str, Counter[str]] = defaultdict(Counter)
        for key, found in keys:
            rows[key].update(("runs", found.outcome, *(["wrong"] * bool(found.wrong))))
        columns = ("runs", *map(str, Outcome), "wrong")
        yield f"\n{title:<32}" + "".join(f"{column:>10}" for column in columns)
        for key, row in sorted(rows.items()):
            yield f"{key:<32}" + "".join(f"{row[column] or '-':>10}" for column in columns)
    for found in all_found:
        if found.wrong:
            yield f"\npython tests/bench/faults.py --seed {found.seed}" * bool(found.seed) + f"\n  {_line(found)}"
    bad = sum(bool(found.wrong) for found in all_found)
    yield f"\n{len(all_found) - bad} of {len(all_found)} ended as they should"


def _line(found: Ended) -> str:
    said = ", ".join(fault.said for fault in found.faults)
    wrong = f"\n  WRONG: {found.wrong}" if found.wrong else ""
    return f"{found.bench}, {said}: {found.outcome} {found.reason[:400]} ({found.wall_s:.1f} s){wrong}"


def main() -> None:
    """Run what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=int, nargs="?", default=100)
    parser.add_argument("--held", action="store_true")
    parser.add_argument("--from", type=int, default=1, dest="first")
    parser.add_argument("--seed", type=int)
    parser.add_argument("--each", action="store_true")
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    parser.add_argument("--verbose", action="store_true")
    arguments = parser.parse_args()
    if arguments.seed is not None:
        print(_line(_judged(arguments.seed)))
        return
    first = HELD_SEED * arguments.held + arguments.first
    cases: Any = each() if arguments.each else range(first, first + arguments.runs)
    found = []
    for bench in {case[0] for case in each()}:
        instants(bench)  # here, once for all workers
    with concurrent.futures.ProcessPoolExecutor(arguments.workers) as pool:
        runs = [pool.submit(_each_judged if arguments.each else _judged, case) for case in cases]
        for run in concurrent.futures.as_completed(runs):
            found.append(one := run.result())
            if arguments.verbose or one.wrong:
                print(one.seed, _line(one), flush=True)
    print("\n".join(_told(found)))


if __name__ == "__main__":
    main()
