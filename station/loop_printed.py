"""A closed loop as a person reads it, and as --json gives it."""

from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from station.closed_loop import Loop, Round
from station.investigation_printed import dph, investigation_object, print_investigation, verdict_lines
from station.rich_table import rich_table
from station.terminal import stdout


def print_loop(loop: Loop) -> None:
    """Print the report: runs, what each investigation led to, the last one in full."""
    console = stdout()
    console.print(_runs(loop))
    for number, turn in enumerate(loop.rounds[:-1], 1):
        console.print(f"investigation {number}, {turn.runs} runs: {escape(_round(turn))}", highlight=False)
    last = loop.rounds[-1]
    if len(loop.rounds) > 1:
        console.print(f"investigation {len(loop.rounds)}, {last.runs} runs:", highlight=False)
    print_investigation(last.found, last.following, last.script_file, console)
    _say(console, f"ended: {loop.ended}")
    _say(console, f"table time: {loop.used_s / 60:.1f} of {loop.budget_s / 60:g} min")
    console.print(f"recordings, scripts, results: {loop.folder}", highlight=False, markup=False, soft_wrap=True)


def _runs(loop: Loop) -> Table:
    table = rich_table("Runs", ("run", "script", "recording", "table time", "judged alone"), "lllrl", fold=True)
    for number, run in enumerate(loop.runs, 1):
        table.add_row(
            f"{number} {run.purpose}",
            escape(run.script.name),
            escape(run.result.recording.name),
            f"{run.table_s / 60:.1f} min",
            str(run.result.verdict.outcome),
        )
    return table


def _round(turn: Round) -> str:
    found, following = turn.found, turn.following
    text = f"{found.finding}: {'; '.join(verdict_lines(found)) or found.reason}"
    text += f"; rms error {dph(found.before.rms_rps)} -> {dph(found.after.rms_rps)} deg/h"
    return f"{text}; so next: {following.words()}" if following else text


def loop_object(loop: Loop) -> dict[str, Any]:
    """Return what --json prints: the last investigation, and how it came to that."""
    last = loop.rounds[-1]
    fitted, judging = ([str(path) for path in loop.recordings(judging=j)] for j in (False, True))
    return {
        **investigation_object(last.found, last.script_file, fitted, judging),
        "rounds": [_round_object(turn) for turn in loop.rounds],
        "runs": runs_object(loop),
        "folder": str(loop.folder),
        "minutes_used": loop.used_s / 60,
        "minutes": loop.budget_s / 60,
        "ended": loop.ended,
    }


def runs_object(loop: Loop) -> list[dict[str, Any]]:
    """Return the runs as what --json prints."""
    return [
        {
            "purpose": run.purpose,
            "script": run.script.name,
            "recording": str(run.result.recording),
            "outcome": str(run.result.verdict.outcome),
            "reason": run.result.verdict.reason,
            "table_s": run.table_s,
        }
        for run in loop.runs
    ]


def _round_object(turn: Round) -> dict[str, Any]:
    whole = investigation_object(turn.found, turn.script_file, (), ())
    kept = ("verdict", "reason", "added", "rivals", "unexplained", "before", "after", "models", "next_script")
    following = turn.following
    return {
        "runs": turn.runs,
        **{key: whole[key] for key in kept},
        "next_name": following and following.script.name,
        "next_probability": following and following.probability,
    }


def _say(console: Console, text: str) -> None:
    console.print(escape(text), highlight=False)
