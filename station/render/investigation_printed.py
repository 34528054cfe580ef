"""An investigation, and a closed loop of them, as a person reads it, in a terminal and on the screen."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from markupsafe import Markup
from rich.console import Console
from rich.markup import escape

from estimator.effects.constructed import readable as words
from estimator.tracing.investigation import Finding, Investigation
from estimator.tracing.residuals.origin import Origin
from estimator.tracing.residuals.residual import BY_CHANCE
from station.render.template import rendered
from station.render.terminal import Shown, print_all, print_rendered, shown_of, stdout
from station.run.closed_loop import Loop, Round
from station.scripts.next_script import NextScript
from station.views.figures import FINDING_STYLES, human, number
from station.views.investigation import InvestigationView, ResidualView, investigation_view
from station.views.json_values import named

_LEAST_SHOWN = 0.005  # suspects less probable than this are one line together
_MOST_SHOWN = 8
_DEPENDENCES_SHOWN = 3
_LEAST_DEPENDENCE = 0.15


def exit_code_of(finding: Finding) -> int:
    """Return 0 if the cause is known or there is none, 1 if it is not known."""
    return 0 if finding in (Finding.NOTHING, Finding.ADDED) else 1


def print_investigation(
    found: Investigation, next_script: NextScript | None, path: Path | None, console: Console | None = None
) -> None:
    """Print the verdict in words, the suspects, the error before and after, what was left out, and what to drive."""
    drive = next_script.words() if next_script else ""
    what = investigation_view(found, path)
    print_all(console or stdout(), investigation_shown(what, f"station run --script {path}", drive))


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


def investigation_shown(what: InvestigationView, how: str, drive: str = "") -> list[Shown]:
    """Return lines and tables of an investigation; ``how`` its next script is driven, ``drive`` what that is."""
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
        "residuals": _residuals(what["residual"]),
        "cells": _CELLS,
        "origin_line": origin_line,
        "left_out": left_out,
    }
    return shown_of("station.render", "investigation.rich", values)


def verdict_lines(what: InvestigationView) -> list[str]:
    """Return what was found, in sentences: effects with their parameters, rivals, what is unexplained."""
    values = {
        "what": what,
        "called": lambda added: _constructed_line(added) if added["constructed"] else words(added["effect"]),
        "parameters": _parameters,
    }
    return rendered("station.render", "verdict.txt", values).splitlines()


def _parameters(added: Mapping[str, Any]) -> dict[str, list[str]]:
    """Return by gyro, or by the name of the parameter where that is of none, what the parameters are."""
    lines: dict[str, list[str]] = {}
    for name, value in added["parameters"].items():
        own = next((gyro for gyro in added["gyros"] if name.startswith(f"{gyro} ")), "")
        shown = f"{name.removeprefix(f'{own} ')} {human(*value)}" if own else human(*value)
        lines.setdefault(own or name, []).append(shown)
    return lines


def _constructed_line(added: Mapping[str, Any]) -> str:
    """Return what an effect is that has no name, with the uncertainty of its lag."""
    said, lag = str(added["effect"]), added["parameters"].get("constant")
    if lag is not None:
        said = said.replace(f"lagged by {lag[0]:.4g} s", f"lagged by {human(*lag)}")
    return f"CONSTRUCTED: {said}; not in the catalogue"


def _residuals(residual: Mapping[str, Any] | None) -> list[tuple[str, ResidualView, ResidualView]]:
    """Return what is left, before and after: of the recordings fitted; of the verification run where it is not noise.

    Nothing if the residual was not looked at.
    """
    if residual is None:
        return []
    shown, verified = [("recordings fitted", residual["before"], residual["after"])], residual["verification"]
    if verified is not None and not _is_noise(verified["after"]):
        shown.append(("verification run", verified["before"], verified["after"]))
    return shown


def _is_noise(residual: ResidualView) -> bool:
    """Return whether a residual passes for noise, in every gyro and in what they have in common."""
    split = residual["split"]
    clean = all(_is_white(gyro) and not gyro["beyond"] for gyro in residual["gyros"].values())
    return clean and (split is None or split["origin"] == Origin.NOISE)


def origin_line(before: ResidualView, after: ResidualView) -> str:
    """Return in words whether what is left is common to all gyros, before and after."""
    question = "common to all gyros, or each gyro's own?"
    if before["split"] is None or after["split"] is None:
        return f"{question} cannot be told: {before['no_split'] or after['no_split']}"
    if after == before:
        return f"{question} {_origin(before['split'])}"
    return f"{question} before: {_origin(before['split'])}; after: {_origin(after['split'])}"


def _origin(split: Mapping[str, Any]) -> str:
    origin, own_share = str(split["origin"]), split["own_share"]
    common = origin == Origin.COMMON
    if common and split["spare"] == 1:
        return f"{origin}, as far as one gyro more than axes can tell"
    return origin if own_share is None or common else f"{origin}, {own_share:.0%}"


def _nis(gyro: Mapping[str, Any]) -> str:
    nis = gyro["nis"]
    return number(nis, 2) if nis is None or nis < 100 else f"{nis:.3g}"


def _is_white(gyro: Mapping[str, Any]) -> bool:
    return (gyro["white_p"] or 0) >= BY_CHANCE


def _white(gyro: Mapping[str, Any]) -> str:
    return f"{gyro['white_p']:.2g}" if _is_white(gyro) else "< 0.0001"


def _depends_on(gyro: Mapping[str, Any]) -> str:
    shares = {variable: d["share"] for variable, d in gyro["depends_on"].items() if d["share"] >= _LEAST_DEPENDENCE}
    ranked = sorted(shares, key=lambda variable: -shares[variable])[:_DEPENDENCES_SHOWN]
    return ", ".join(f"{variable} {shares[variable]:.0%}" for variable in ranked) or "nothing"


_CELLS: Mapping[str, Callable[[Mapping[str, Any]], str]] = {
    "NIS": _nis,
    "white, p": _white,
    "beyond noise": lambda gyro: f"{gyro['beyond']:.0%}",
    "depends on": _depends_on,
}


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
            **named(run, ("purpose", "table_s")),
            "script": run.script.name,
            "recording": str(run.result.recording),
            "outcome": str(run.result.verdict.outcome),
            "reason": run.result.verdict.reason,
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
