"""station loop: calibrate, explore, verify on the bench, investigate, run a script to separate rivals, report."""

import argparse
import asyncio
import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path

from drivers.errors import DeviceError
from estimator.errors import EstimatorError
from estimator.recordings.reading import read_recording
from estimator.tracing.investigate import investigate
from estimator.tracing.investigation import Finding
from station.atomic_write import free_path
from station.bench.bench import Bench
from station.commands.common import chosen_bench, clock, drive
from station.commands.investigate import Limits, following_script, write_next
from station.errors import EXIT_ABORTED, EXIT_USAGE, UsageError
from station.exports.investigation_file import write_investigation
from station.render.investigation_printed import exit_code_of
from station.render.investigations.loop import loop_object, print_loop, runs_object
from station.render.lines import tell
from station.render.progress import TracingProgress
from station.run.closed_loop import CALIBRATION, EXPLORATION, NEXT, VERIFICATION, Driven, Loop, Round
from station.run.event_loop.loops import run_to_end
from station.run.outcome import Outcome
from station.run.session import RunOptions
from station.scripts.loop_scripts import exploration_script, verification_script
from station.scripts.script import Script, check, paper_script

_AROUND_S = 10.0  # for connecting, homing and coming to rest
_LEAST_CHANCE = 0.05  # of settling it: below it table time is wasted


def command_loop(arguments: argparse.Namespace) -> int:
    """Calibrate, explore, verify and investigate on a bench, and drive deciding scripts until the matter is settled.

    Exit codes as ``station investigate``, or those of an aborted run or a fault; 3 for Ctrl-C between runs.
    """
    loop: Loop | None = None
    try:
        bench = chosen_bench(arguments)
        loop = Loop(_folder(arguments.output), 60 * arguments.minutes)
        scripts = _first_scripts(bench, loop.budget_s)
        loop.folder.mkdir(parents=True)
        with clock(bench, arguments.scale) as runner:
            _close(loop, scripts, _Driver(bench, runner, arguments, loop))
        if loop.stopped is None:
            return _report(loop, arguments.json)
        return _end(loop, loop.stopped.outcome.exit_code, loop.stopped.reason, arguments.json)
    except (UsageError, EstimatorError, OSError) as error:
        return _end(loop, EXIT_USAGE, str(error), arguments.json)
    except DeviceError as error:
        return _end(loop, Outcome.FAULT.exit_code, str(error), arguments.json)
    except KeyboardInterrupt:
        return _end(loop, EXIT_ABORTED, "stopped by Ctrl-C between runs, with the table at rest", arguments.json)


class _Driver:
    """Drives scripts one after the other on one clock, so that time and temperature continue between them."""

    def __init__(self, bench: Bench, runner: asyncio.Runner, arguments: argparse.Namespace, loop: Loop) -> None:
        self.bench, self.arguments = bench, arguments
        self._runner, self._loop = runner, loop

    def drive(self, purpose: str, script: Script) -> bool:
        """Drive a script, and add the run to the loop; return False if it was aborted or in fault.

        Its verdict is then ``stopped`` of the loop. The recording is named by number and ``purpose``.
        """
        loop, number = self._loop, len(self._loop.runs) + 1
        if not self.arguments.json:
            tell(f"run {number}, {purpose}: {script.name}, {script.least_s:.0f} s", sys.stderr)
        began_s = self._now_s()
        options = RunOptions(reset_fault=self.arguments.reset_fault, time_scale=self.arguments.scale or 1.0)
        path = loop.folder / f"{number}-{purpose}.h5"
        result = run_to_end(self._runner, drive(self._seeded(number), script, path, options, self.arguments.json))
        loop.runs.append(Driven(purpose, script, result, self._now_s() - began_s))
        if result.verdict.outcome in (Outcome.ABORTED, Outcome.FAULT):
            loop.stopped = result.verdict
        return loop.stopped is None

    def _now_s(self) -> float:
        return self._runner.get_loop().time()

    def _seeded(self, number: int) -> Bench:
        """Return the bench with noise of its own for each run: twins that repeat it would pass it off as signal."""
        twin = self.bench.twin
        return replace(self.bench, twin=replace(twin, seed=twin.seed + 1_000_003 * (number - 1)))


def _close(loop: Loop, scripts: Sequence[tuple[str, Script]], driver: _Driver) -> None:
    """Drive the first scripts, then investigate and drive the next script, again and again.

    It ends when nothing more is to be driven, see ``_why_ended``, or a run is aborted or in fault. The loop gets the
    runs, the rounds and, except after such a run, why it ended.
    """
    for purpose, script in scripts:
        if not driver.drive(purpose, script):
            return
    while True:
        loop.rounds.append(turn := _investigate(loop, driver))
        loop.ended = _why_ended(turn, loop.left_s)
        if loop.ended or turn.following is None or not driver.drive(NEXT, turn.following.script):
            return


def _investigate(loop: Loop, driver: _Driver) -> Round:
    """Investigate the recordings so far; if causes cannot be told apart, find and write the next script.

    The round has no script for any other finding, nor if none fits into the time that is left.
    """
    fitted, judging = (
        [read_recording(path, trusted=True) for path in loop.recordings(judging=j)] for j in (False, True)
    )
    with TracingProgress(driver.arguments.json) as progress:
        investigation = investigate(fitted, judging, most_effects=driver.arguments.most_effects, progress=progress.show)
    if investigation.finding is not Finding.CANNOT_TELL:
        return Round(len(loop.runs), investigation, None, None)
    limits = Limits(driver.bench.table.limits, driver.bench.name)
    following = following_script(investigation, fitted, judging, limits, loop.left_s - _AROUND_S)
    path = None
    if following is not None:
        path = loop.folder / f"{len(loop.runs) + 1}-{NEXT}.toml"
        write_next(path, following, limits)
    return Round(len(loop.runs), investigation, following, path)


def _why_ended(turn: Round, left_s: float) -> str:
    """Return why nothing more is to be driven, "" if the round's next script should be.

    That is so unless its chance to settle the matter is below 5 %.
    """
    if turn.investigation.finding is Finding.UNEXPLAINED:
        return "unexplained: no further run can tell the remaining effects of the catalogue apart"
    if turn.investigation.finding is not Finding.CANNOT_TELL:
        return "settled"
    if turn.following is None:
        return f"no script that decides between them fits into the {max(left_s, 0) / 60:.1f} min of table time left"
    return "" if turn.following.probability >= _LEAST_CHANCE else turn.following.words()


def _first_scripts(bench: Bench, budget_s: float) -> list[tuple[str, Script]]:
    """Return purpose and script of the three runs of every loop: calibration, exploration, verification.

    UsageError if the budget is too short, ScriptError if the table cannot drive them.
    """
    first = {CALIBRATION: paper_script(), EXPLORATION: exploration_script(), VERIFICATION: verification_script()}
    scripts = [(name, check(script, bench.table.limits)) for name, script in first.items()]
    needed_s = sum(script.least_s + _AROUND_S for _, script in scripts)
    if needed_s > budget_s:
        raise UsageError(f"--minutes {budget_s / 60:g}: the first three runs take {needed_s / 60:.1f} min")
    return scripts


def _folder(name: str | None) -> Path:
    """Return the folder ``name`` to make, by default a new one named by the time; UsageError if it exists."""
    if name is not None:
        if Path(name).exists():
            raise UsageError(f"--output {name} exists already. Give another name")
        return Path(name)
    return free_path(Path("recordings") / f"loop-{datetime.now():%Y%m%d-%H%M%S}")


def _report(loop: Loop, as_json: bool) -> int:
    """Write the last investigation into the loop's folder, print the result, and return its finding's exit code."""
    found, result = loop.rounds[-1].investigation, loop_object(loop)
    write_investigation(loop.folder / "investigation.h5", found, result)
    if as_json:
        print(json.dumps(result))
    else:
        print_loop(loop)
    return exit_code_of(found.finding)


def _end(loop: Loop | None, code: int, reason: str, as_json: bool) -> int:
    """Print on stderr why there is no report and where the recordings are; return ``code``.

    ``as_json`` prints on stdout, as well, a result without a verdict, with the reason and the runs so far. ``loop`` is
    None if it never began.
    """
    kept = loop is not None and loop.folder.is_dir()
    where = f"; the recordings are in {loop.folder}" if loop and kept else ""
    tell(f"station: {reason}{where}", sys.stderr)
    if as_json:
        empty = {"verdict": None, "reason": reason, "runs": runs_object(loop) if loop else []}
        print(json.dumps({**empty, "folder": str(loop.folder) if loop and kept else None}))
    return code
