"""A closed loop of runs and investigations, for people and for --json."""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from rich.markup import escape
from rich.table import Table

from station.render.investigation_printed import next_shown
from station.render.investigations.verdict import verdict_sentences
from station.render.terminal import Shown, line, print_all, rich_table, stdout, unbroken
from station.views.figures import dph
from station.views.investigation import InvestigationView, investigation_object, investigation_view
from station.views.json_values import named

if TYPE_CHECKING:  # importing a loop also imports drivers, twins and servers, half a second
    from station.run.closed_loop import Driven, Loop, Round

_KEPT = ("verdict", "reason", "added", "rivals", "unexplained", "before", "after", "models", "next_script")
"""What --json tells of every round."""


def print_loop(loop: "Loop") -> None:
    """Print the report: runs, the result of each investigation, the last one in full."""
    print_all(stdout(), _shown(loop))


def _shown(loop: "Loop") -> Iterator[Shown]:
    """Yield the runs of a loop, its investigations, why it ended, the table time used and the folder of the results.

    Investigations before the last are a line each; the last is shown in full.
    """
    yield _runs(loop.runs), {}
    for number, turn in enumerate(loop.rounds[:-1], 1):
        yield line(escape(_round(number, turn)))
    last = loop.rounds[-1]
    if len(loop.rounds) > 1:
        yield line(f"investigation {len(loop.rounds)}, {last.runs} runs:")
    yield from next_shown(_view(last), last.following, last.script_file)
    yield line(escape(f"ended: {loop.ended}"))
    yield line(f"table time: {loop.used_s / 60:.1f} of {loop.budget_s / 60:g} min")
    yield unbroken(f"recordings, scripts, results: {loop.folder}")


def _runs(driven: "list[Driven]") -> Table:
    """Return a row for each run: purpose, script, recording, table time, and the verdict on this run alone."""
    runs = rich_table("Runs", ["run", "script", "recording", "table time", "verdict alone"], "lllrl", fold=True)
    for number, run in enumerate(driven, 1):
        runs.add_row(
            f"{number} {run.purpose}",
            escape(run.script.name),
            escape(run.result.recording.name),
            f"{run.table_s / 60:.1f} min",
            str(run.result.verdict.outcome),
        )
    return runs


def _round(number: int, turn: "Round") -> str:
    """Return an investigation in a line: its result, the error before and after, and what was driven next."""
    what = _view(turn)
    result = "; ".join(verdict_sentences(what)) or what.reason
    following = f"; next: {turn.following.words()}" if turn.following else ""
    return (
        f"investigation {number}, {turn.runs} runs: {what.verdict}: {result}; "
        f"rms error {dph(what.before.rms_rps)} -> {dph(what.after.rms_rps)} deg/h{following}"
    )


def _view(turn: "Round") -> InvestigationView:
    return investigation_view(turn.investigation, turn.script_file)


def loop_object(loop: "Loop") -> dict[str, Any]:
    """Return the result of a loop for --json: the keys of the last investigation, and "rounds" and "runs", two lists.

    Further keys are "folder", "minutes_used" and "minutes" (allowed) on the table, and "ended", which says why.
    """
    last = loop.rounds[-1]
    fitted = [str(path) for path in loop.recordings(judging=False)]
    judging = [str(path) for path in loop.recordings(judging=True)]
    return {
        **investigation_object(investigation_view(last.investigation, last.script_file, fitted, judging)),
        "rounds": [_round_object(turn) for turn in loop.rounds],
        "runs": runs_object(loop),
        "folder": str(loop.folder),
        "minutes_used": loop.used_s / 60,
        "minutes": loop.budget_s / 60,
        "ended": loop.ended,
    }


def runs_object(loop: "Loop") -> list[dict[str, Any]]:
    """Return the runs of a loop for --json: "purpose", "table_s", "script", "recording", "outcome" and "reason"."""
    return [
        {
            **named(run, ("purpose", "table_s")),
            "script": run.script.name,
            "recording": str(run.result.recording),
            "outcome": str(run.result.verdict.outcome),
            "reason": run.result.verdict.reason,
        }
        for run in loop.runs
    ]


def _round_object(turn: "Round") -> dict[str, Any]:
    """Return one round of a loop for --json: how many runs it had, and of its investigation the keys in ``_KEPT``.

    ``next_name`` and ``next_probability``, with which that script decides between rivals, are None if none follows.
    """
    whole = investigation_object(_view(turn))
    following = turn.following
    return {
        "runs": turn.runs,
        **{key: whole[key] for key in _KEPT},
        "next_name": following and following.script.name,
        "next_probability": following and following.probability,
    }
