"""A closed loop as a person reads it, and as --json gives it."""

from typing import Any

from rich.markup import escape

from station.render.investigation_printed import print_investigation, verdict_lines
from station.render.terminal import print_rendered, stdout
from station.run.closed_loop import Loop, Round
from station.views.investigation import investigation_view


def print_loop(loop: Loop) -> None:
    """Print the report: runs, what each investigation led to, the last one in full."""
    console, last = stdout(), loop.rounds[-1]
    views = [investigation_view(turn.found, turn.script_file) for turn in loop.rounds]
    values = {"runs_driven": loop.runs, "rounds": loop.rounds, "views": views, "verdict_lines": verdict_lines}
    print_rendered(console, "station.render", "loop.rich", values)
    print_investigation(last.found, last.following, last.script_file, console)
    console.print(escape(f"ended: {loop.ended}"), highlight=False)
    console.print(f"table time: {loop.used_s / 60:.1f} of {loop.budget_s / 60:g} min", highlight=False)
    console.print(f"recordings, scripts, results: {loop.folder}", highlight=False, markup=False, soft_wrap=True)


def loop_object(loop: Loop) -> dict[str, Any]:
    """Return what --json prints: the last investigation, and how it came to that."""
    last = loop.rounds[-1]
    fitted, judging = ([str(path) for path in loop.recordings(judging=j)] for j in (False, True))
    return {
        **investigation_view(last.found, last.script_file, fitted, judging),
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
    whole = dict(investigation_view(turn.found, turn.script_file))
    kept = ("verdict", "reason", "added", "rivals", "unexplained", "before", "after", "models", "next_script")
    following = turn.following
    return {
        "runs": turn.runs,
        **{key: whole[key] for key in kept},
        "next_name": following and following.script.name,
        "next_probability": following and following.probability,
    }
