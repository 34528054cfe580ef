"""An investigation as a person reads it, and as --json gives it."""

import math
from collections.abc import Sequence
from dataclasses import asdict, astuple
from pathlib import Path
from typing import Any

from markupsafe import Markup
from rich.console import Console
from rich.table import Table

from estimator.effects.constructed import readable
from estimator.tracing.investigation import Added, Finding, GyroErrors, Investigation, ModelStep, Value
from station.render.residual_printed import residual_object, residual_tables
from station.render.rich_table import rich_table
from station.render.template import rendered
from station.render.terminal import print_rendered, stdout
from station.run.snapshot import by_state, json_object, named
from station.scripts.next_script import NextScript
from station.views.figures import FINDING_STYLES, shown_unit

_DEG = 180 / math.pi
_ADDED = ("effect", "constructed", "expression", "gyros", "probability", "parameters", "out_of_sample", "same")
"""What --json says of an effect that was added."""
_LEAST_SHOWN = 0.005  # suspects less probable than this are one line together
_MOST_SHOWN = 8


def exit_code_of(finding: Finding) -> int:
    """Return 0 if the cause is known or there is none, 1 if it is not known."""
    return 0 if finding in (Finding.NOTHING, Finding.ADDED) else 1


def print_investigation(
    found: Investigation, next_script: NextScript | None, path: Path | None, console: Console | None = None
) -> None:
    """Print the verdict in words, the suspects, the error before and after, what was left out, and what to drive."""
    left_out: dict[str, list[str]] = {}
    for effect, reason in found.left_out.items():
        left_out.setdefault(reason, []).append(words(effect))
    ranked = sorted(found.suspects, key=lambda suspect: -suspect.probability)
    shown = [s for s in ranked if s.probability >= _LEAST_SHOWN][:_MOST_SHOWN]
    values = {
        "found": found,
        "colour": Markup(FINDING_STYLES[found.finding]),
        "verdict": verdict_lines(found),
        "next_script": next_script,
        "path": path,
        "shown": shown,
        "others": ranked[len(shown) :],
        "words": words,
        "probability": probability,
        "residuals": residual_tables(found),
        "models": _models(found.models) if len(found.models) > 1 else None,
        "left_out": left_out,
        "dph": dph,
    }
    print_rendered(console or stdout(), "station.render", "investigation.rich", values)


def verdict_lines(found: Investigation) -> list[str]:
    """Return what was found, in sentences: effects with their parameters, rivals, what is unexplained."""
    values = {
        "found": found,
        "called": lambda added: _constructed_line(added) if added.constructed else words(added.effect),
        "parameters": _parameters,
        "same": lambda added: ", ".join(map(words, added.same)),
        "either": lambda rivals: " or ".join(map(words, rivals)),
        "probability": probability,
    }
    return rendered("station.render", "verdict.txt", values).splitlines()


def _parameters(added: Added) -> dict[str, list[str]]:
    """Return by gyro, or by the name of the parameter where that is of none, what the parameters are."""
    lines: dict[str, list[str]] = {}
    for name, value in added.parameters.items():
        own = next((gyro for gyro in added.gyros if name.startswith(f"{gyro} ")), "")
        shown = f"{name.removeprefix(f'{own} ')} {human(value)}" if own else human(value)
        lines.setdefault(own or name, []).append(shown)
    return lines


def _constructed_line(added: Added) -> str:
    """Return what an effect is that has no name, with the uncertainty of its lag."""
    said, lag = added.effect, added.parameters.get("constant")
    if lag is not None:
        said = said.replace(f"lagged by {lag.value:.4g} s", f"lagged by {human(lag)}")
    return f"CONSTRUCTED: {said}; not in the catalogue"


def words(name: str) -> str:
    """Return the name of an effect as people say it; "a + b" for several."""
    return readable(name)


def probability(share: float) -> str:
    """Return a probability that is never rounded to certainty."""
    if share > 0.999:
        return "above 99.9 %"
    return "below 0.1 %" if share < 0.001 else f"{share * 100:.1f} %"


def human(value: Value) -> str:
    """Return a value and its standard deviation in a unit for people, to two digits of the latter."""
    unit, factor = _unit(value)
    number, sd = value.value * factor, value.sd * factor
    if not math.isfinite(sd) or sd <= 0:
        return f"{number:.4g} {unit}".rstrip()
    digits = max(1 - math.floor(math.log10(sd)), 0)
    return f"{number:.{digits}f} ± {sd:.{digits}f} {unit}".rstrip()


def _unit(value: Value) -> tuple[str, float]:
    if value.unit == "s" and abs(value.value) >= 0.5:  # delays are milliseconds, time constants of a warm-up are not
        return "s", 1.0
    return shown_unit(value.unit)


def _models(models: Sequence[ModelStep]) -> Table:
    """Return one row a model: what it added, its evidence, its error."""
    rows = [
        (
            " + ".join(["four states", *map(words, model.effects)]),
            f"{model.log_evidence:+.1f}" if number else "0",
            dph(model.errors.rms_rps),
            dph(model.errors.max_rps),
            f"{model.errors.coverage95:.1%}",
        )
        for number, model in enumerate(models)
    ]
    table = rich_table(
        "Chain of models", ("model", "log evidence", "rms deg/h", "largest deg/h", "in 95 %"), "lr", rows
    )
    table.columns[0].overflow = "fold"
    return table


def dph(rate_rps: float) -> str:
    """Return a rate in deg/h with three digits."""
    value = rate_rps * _DEG * 3600
    return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"


def investigation_object(
    found: Investigation, next_script: Path | None, recordings: Sequence[str], verification: Sequence[str]
) -> dict[str, Any]:
    """Return what --json prints: SI, shares between 0 and 1, null for what is not known."""
    whole: dict[str, Any] = json_object(
        {
            "verdict": str(found.finding),
            "reason": found.reason,
            "added": [
                named(added, _ADDED) | {"parameters": {name: astuple(v) for name, v in added.parameters.items()}}
                for added in found.added
            ],
            **named(found, ("rivals", "unexplained", "before", "after", "improvement", "in_sample")),
            "next_script": None if next_script is None else str(next_script),
            "models": [
                {"effects": m.effects, "log_evidence": m.log_evidence, **asdict(m.errors)} for m in found.models
            ],
            "gyros": {gyro.name: _gyro(gyro) for gyro in found.gyros},
            "suspects": found.suspects,
            "residual": residual_object(found),
            **named(found, ("left_out", "taken_back", "notes")),
            "recordings": recordings,
            "verification": verification,
        }
    )
    return whole


def _gyro(gyro: GyroErrors) -> dict[str, Any]:
    states = {key: by_state(getattr(gyro, key)) for key in ("states_before", "states_after", "sd_before", "sd_after")}
    moved = {"moved_sigmas": by_state(gyro.moved)}
    return {"before": gyro.before, "after": gyro.after, **states, **moved, "phases": gyro.phases}
