"""An investigation, and a closed loop of them, as a person reads it, in a terminal and on the screen."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from markupsafe import Markup
from rich.console import Console

from estimator.effects.constructed import readable as words
from estimator.tracing.investigation import Finding, Investigation
from estimator.tracing.residuals.origin import Origin
from estimator.tracing.residuals.residual import BY_CHANCE
from station.render.template import rendered
from station.render.terminal import Shown, print_all, print_rendered, shown_of, stdout
from station.scripts.next_script import NextScript
from station.views.figures import FINDING_STYLES
from station.views.investigation import InvestigationView, investigation_view
from station.views.json_values import named

if TYPE_CHECKING:  # importing a loop also imports drivers, twins and servers, half a second
    from station.run.closed_loop import Loop, Round

_LEAST_SHOWN = 0.005  # suspects less probable than this are one line together
_MOST_SHOWN = 8


def exit_code_of(finding: Finding) -> int:
    """Return 0 if the cause is known or there is none, 1 if it is not known."""
    return 0 if finding in (Finding.NOTHING, Finding.ADDED) else 1


def print_investigation(
    found: Investigation, next_script: NextScript | None, path: Path | None, console: Console | None = None
) -> None:
    """Print the verdict in words, the suspects, the error before and after, what was left out, and the next script."""
    print_all(console or stdout(), _shown(investigation_view(found, path), next_script, path))


def _shown(what: InvestigationView, next_script: NextScript | None, path: Path | None) -> list[Shown]:
    return investigation_shown(what, f"station run --script {path}", next_script.words() if next_script else "")


def print_loop(loop: "Loop") -> None:
    """Print the report: runs, the result of each investigation, the last one in full."""
    views = [investigation_view(turn.found, turn.script_file) for turn in loop.rounds]
    last = _shown(views[-1], loop.rounds[-1].following, loop.rounds[-1].script_file)
    values = {"driven": loop, "views": views, "verdict_lines": verdict_lines, "last": last}
    print_rendered(stdout(), "station.render", "loop.rich", values)


def investigation_shown(what: InvestigationView, how: str, drive: str = "") -> list[Shown]:
    """Return the lines and tables of an investigation.

    ``how`` is the command that runs its next script, ``drive`` a line on that script, empty if there is none.
    """
    left_out: dict[str, list[str]] = {}
    for effect, reason in what["left_out"].items():
        left_out.setdefault(reason, []).append(words(effect))
    ranked = sorted(what["suspects"], key=lambda suspect: -(suspect["probability"] or 0))
    shown = [s for s in ranked if (s["probability"] or 0) >= _LEAST_SHOWN][:_MOST_SHOWN]
    values = {
        "what": what,
        "colour": Markup(FINDING_STYLES.get(what["verdict"], "bold")),
        "verdict": verdict_lines(what),
        "drive": drive,
        "how": how,
        "shown": shown,
        "others": ranked[len(shown) :],
        "figure": lambda value: "inf" if value is None else f"{value:.3g}",
        "by_chance": BY_CHANCE,
        "origins": Origin,
        "left_out": left_out,
    }
    return shown_of("station.render", "investigation.rich", values)


def verdict_lines(what: InvestigationView) -> list[str]:
    """Return the result in sentences: effects with their parameters, rivals, the unexplained part."""
    return rendered("station.render", "verdict.txt", {"what": what}).splitlines()


def loop_object(loop: "Loop") -> dict[str, Any]:
    """Return the result of a loop for --json: the last investigation, and the rounds and runs that led to it."""
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


def runs_object(loop: "Loop") -> list[dict[str, Any]]:
    """Return the runs of a loop for --json."""
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
    """Return one round of a loop for --json."""
    whole = dict(investigation_view(turn.found, turn.script_file))
    kept = ("verdict", "reason", "added", "rivals", "unexplained", "before", "after", "models", "next_script")
    following = turn.following
    return {
        "runs": turn.runs,
        **{key: whole[key] for key in kept},
        "next_name": following and following.script.name,
        "next_probability": following and following.probability,
    }
