"""Whole runs over wires that misbehave: every kind in every phase of a run; when the table stands, and what is said.

python tests/bench/misbehaving.py                            all protocols, kinds and phases (some 460 runs, 10 minutes)
python tests/bench/misbehaving.py --protocols galil --phases "last stop" --kinds reset,flood

Real sockets and pseudo-terminals, virtual time. A row a kind, a column a phase: seconds from the strike until the table
stands, or what is wrong; below, each reason that was given, with --verbose.
"""

from __future__ import annotations

import argparse
import asyncio
import logging
import math
import selectors
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "drivers"))

import h5py
from misbehaving_wire import KINDS, Kind, Proxy
from test_misbehaving_wires import AT_REST_S, PHASES, Found, joined

from station.bench.bench import load_bench
from station.opening import open_bench
from station.run.event_loop.loops import VirtualLoop
from station.run.session import Result, Session
from station.run.snapshot import Phase
from station.scripts.script import Rest, Rotate, Script

BENCH = Path(__file__).parents[1] / "data" / "benches" / "rtu_stim300.toml"
DEG = math.pi / 180
SCRIPT = Script("x and back", (Rest(0.2), Rotate("x", 20 * DEG, 2.0, 40 * DEG, "x"), Rest(0.2)))
STRIKES_S = {"homing": 0.2, "ramp": 0.45, "steady": 1.2, "last stop": 1.2}
"""After the phase of the run that it is in has begun."""
Case = tuple[str, Kind, str]
_ON_THEIR_WAY_S = 0.0003  # of the host's: the kernel may hand bytes on a little later
_SERVED_S = 0.0001  # of the loop's clock, for sockets that are ready: who asks without end is timed out, too


class LoopbackLoop(VirtualLoop):
    """A loop whose clock jumps when nothing is left to do and nothing is on its way through the kernel."""

    def advance(self, seconds: float | None) -> None:
        """Serve the sockets that are ready; else let the clock jump."""
        wait_s = 0.0 if seconds == 0 else _ON_THEIR_WAY_S
        ready = selectors.DefaultSelector.select(self._selector, wait_s)  # type: ignore[attr-defined]
        if ready:
            self._process_events(ready)  # type: ignore[attr-defined]
            self._now += _SERVED_S
        else:
            super().advance(seconds)


class Whole(Found):
    """How a run ended: what is wrong with it is judged as of a driver."""

    @property
    def wrong(self) -> str:
        """Return what is wrong, empty if nothing is."""
        protocol, kind, phase = self.case
        if "defect of the station" in self.reason:
            return "defect"
        # A serial line that is broken is so when it is opened again: nobody can stop the table over it.
        reachable = not kind.lasting and (protocol != "rtu" or not kind.says)
        if self.printed or reachable:
            return super().wrong
        return "" if self.rest_s <= AT_REST_S or "not seen" in self.reason or phase == "connecting" else "not told"


async def ended(case: Case, folder: Path) -> Whole:
    """Run the script on a wire that is struck in one phase."""
    protocol, kind, phase = case
    found, proxy, loop = Whole(case), Proxy(), asyncio.get_running_loop()
    async with joined(protocol, proxy) as (table, model), open_bench(load_bench(BENCH)) as twins:
        path = folder / f"{'-'.join((protocol, kind.name, phase))}.h5".replace(" ", "_")
        session = Session(replace(twins, table=table, at_rest=model.at_rest), SCRIPT, path)

        async def strike() -> None:
            while session.snapshot().phase is not (Phase.HOMING if phase == "homing" else Phase.RUNNING):
                await asyncio.sleep(0.005)
            await asyncio.sleep(STRIKES_S[phase])
            if phase == "last stop":
                session.stop()
            proxy.strike(kind)

        async def watch() -> None:
            while True:
                if loop.time() < proxy.struck_s or not model.at_rest():
                    found.rest_s = math.nan
                elif math.isnan(found.rest_s):
                    found.rest_s = loop.time() - proxy.struck_s
                await asyncio.sleep(0.01)

        if phase == "connecting":
            proxy.strike(kind)
        helpers = [asyncio.ensure_future(watch())]
        helpers += [asyncio.ensure_future(strike())] if phase != "connecting" else []
        result: Result = await session.run()
        await asyncio.sleep(0.03)
        for helper in helpers:
            helper.cancel()
        # A run that goes on is at rest when its script is over, and fails by its sigmas.
        found.reason = result.verdict.reason if str(result.verdict.outcome) in ("FAULT", "ABORTED") else ""
        if phase == "last stop":
            stopped, _, found.reason = found.reason.partition("; ")
            found.printed += [] if stopped == "stopped by the operator in step 'x'" else [stopped]
        if not found.reason and not kind.says:
            found.rest_s = 0.0 if model.at_rest() else math.inf
        with h5py.File(path) as file:
            if file.attrs["reason"] != result.verdict.reason:
                found.printed.append("a recording without its outcome")
    return found


def run_cases(cases: Sequence[Case]) -> list[Whole]:
    """Return how each case ended, with what was logged or reached the loop's handler."""
    printed: list[str] = []

    class Kept(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            printed.append(record.getMessage())

    async def main(folder: Path) -> list[Whole]:
        asyncio.get_running_loop().set_exception_handler(lambda _, context: printed.append(str(context)))
        found = []
        for case in cases:
            found.append(await ended(case, folder))
            found[-1].printed += printed
            printed.clear()
        return found

    kept = Kept(logging.WARNING)
    logging.getLogger().addHandler(kept)
    try:
        with tempfile.TemporaryDirectory() as folder, asyncio.Runner(loop_factory=LoopbackLoop) as runner:
            return runner.run(main(Path(folder)))
    finally:
        logging.getLogger().removeHandler(kept)


def table(found: Sequence[Whole]) -> str:
    """Return kinds by phases: how long until the table stood, or what is wrong."""
    by_case = {(one.case[0], one.case[1].name, one.case[2]): one for one in found}
    lines = [f"{'':36s}" + "".join(f"{phase:>22s}" for phase in PHASES)]
    for protocol, name in dict.fromkeys((one.case[0], one.case[1].name) for one in found):
        cells = [by_case.get((protocol, name, phase)) for phase in PHASES]
        said = ["" if one is None else one.wrong[:20] or f"{one.rest_s:.2f}" for one in cells]
        lines.append(f"{protocol + ', ' + name:36s}" + "".join(f"{text:>22s}" for text in said))
    return "\n".join(lines)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--protocols", default=",".join(KINDS))
    parser.add_argument("--phases", default=",".join(PHASES))
    parser.add_argument("--kinds", default="", help="names, with commas; all if left out")
    parser.add_argument("--verbose", action="store_true")
    arguments = parser.parse_args()
    wanted = arguments.kinds.split(",") if arguments.kinds else []
    every = [
        (protocol, kind, phase)
        for protocol in arguments.protocols.split(",")
        for kind in KINDS[protocol]
        for phase in arguments.phases.split(",")
        if not wanted or kind.name in wanted
    ]
    done = run_cases(every)
    print(table(done))
    for one in done:
        if one.wrong or arguments.verbose:
            print(one)
    wrong = sum(bool(one.wrong) for one in done)
    print(f"{len(done) - wrong} of {len(done)} ended as they should")
