"""An investigation as a person reads it, and as --json gives it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from estimator.effects.constructed import readable
from estimator.model import STATES
from estimator.tracing.investigation import (
    Added,
    Errors,
    Finding,
    GyroErrors,
    Investigation,
    ModelStep,
    Unexplained,
    Value,
)
from station.next_script import NextScript
from station.residual_printed import print_residual, residual_object
from station.terminal import stdout

_DEG = 180 / math.pi
_UNITS = {
    "1": ("ppm", 1e6),
    "1/K": ("ppm/degC", 1e6),
    "1/(rad/s)": ("ppm per deg/s", 1e6 / _DEG),
    "1/(rad/s)2": ("ppm per (deg/s)2", 1e6 / _DEG**2),
    "rad": ("mrad", 1e3),
    "rad/s": ("deg/s", _DEG),
    "rad/s/K": ("deg/s/degC", _DEG),
    "rad/s/K2": ("deg/s/degC2", _DEG),
    "rad/s/g": ("deg/s/g", _DEG),
    "rad/s/(K/s)": ("deg/s/(degC/min)", _DEG / 60),
    "rad/s2": ("deg/s/h", _DEG * 3600),
    "rad/s/rts": ("deg/h/rth", _DEG * 3600 * 60),
}
"""What a person reads instead of an SI unit, and its factor."""
_COLOURS = {
    Finding.NOTHING: "bold green",
    Finding.ADDED: "bold green",
    Finding.PARTLY: "bold yellow",
    Finding.CANNOT_TELL: "bold yellow",
    Finding.UNEXPLAINED: "bold red",
}
_LEAST_SHOWN = 0.005  # suspects less probable than this are one line together
_MOST_SHOWN = 8


def exit_code_of(finding: Finding) -> int:
    """Return 0 if the cause is known or there is none, 1 if it is not known."""
    return 0 if finding in (Finding.NOTHING, Finding.ADDED) else 1


def print_investigation(
    found: Investigation, next_script: NextScript | None, path: Path | None, console: Console | None = None
) -> None:
    """Print the verdict in words, the suspects, the error before and after, what was left out, and what to drive."""
    console = console or stdout()
    _say(console, f"[{_COLOURS[found.finding]}]{str(found.finding).upper()}[/]  {escape(found.reason)}")
    for line in verdict_lines(found):
        _say(console, f"  {escape(line)}")
    if next_script is not None and path is not None:
        _print_next(next_script, path, console)
    if found.suspects:
        console.print()
        _print_suspects(found, console)
    console.print()
    print_residual(found, console)
    _print_errors(found, console)
    if len(found.models) > 1:
        console.print(models_table(found.models))
    for reason in dict.fromkeys(found.left_out.values()):
        effects = [words(effect) for effect, why in found.left_out.items() if why == reason]
        _say(console, f"left out, {escape(reason)}: {escape(', '.join(effects))}")
    for note in found.notes:
        _say(console, f"note: {escape(note)}")


def verdict_lines(found: Investigation) -> list[str]:
    """Return what was found, in sentences: effects with their parameters, rivals, what is unexplained."""
    lines = [line for added in found.added for line in _added_lines(added, len(found.gyros))]
    for rivals in found.rivals:
        said = "these recordings cannot tell apart" if len(rivals) > 1 else "these recordings do not prove"
        lines.append(f"{said}: {' or '.join(map(words, rivals))}")
    if found.unexplained is not None:
        lines.append(unexplained_line(found.unexplained))
    return lines


def unexplained_line(unexplained: Unexplained) -> str:
    """Return what is unexplained in words."""
    return (
        f"unexplained: {unexplained.share:.0%} of the power of what is left depends on {unexplained.depends_on}, and "
        "neither an effect of the catalogue nor a law composed of what was measured explains it; the sigmas of the "
        "states allow for it"
    )


def _added_lines(added: Added, gyros: int) -> list[str]:
    who = "all gyros" if len(added.gyros) == gyros else ", ".join(added.gyros)
    called = _constructed_line(added) if added.constructed else words(added.effect)
    head = f"{called}, probability {probability(added.probability)}, shown by {who or 'no gyro alone'}"
    lines: dict[str, list[str]] = {}
    for name, value in added.parameters.items():
        own = next((gyro for gyro in added.gyros if name.startswith(f"{gyro} ")), "")
        lines.setdefault(own or name, []).append(
            f"{name.removeprefix(f'{own} ')} {human(value)}" if own else human(value)
        )
    said = [head, *(f"  {name}: {', '.join(parts)}" for name, parts in lines.items())]
    told = added.out_of_sample
    if told is not None:
        by_run = "" if told.by_run is None else f"whole recordings by {told.by_run:.0f}, "
        said.append(f"  makes what was left out of the fit more probable: {by_run}steps by {told.by_step:.0f} (log)")
    if added.same:
        said.append(f"  {', '.join(map(words, added.same))} could put out the same here, but is less expected")
    return said


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
    if value.unit == "s":  # delays are milliseconds, time constants of a warm-up are not
        return ("ms", 1e3) if abs(value.value) < 0.5 else ("s", 1.0)
    return _UNITS.get(value.unit, (value.unit, 1.0))


def _print_next(following: NextScript, path: Path, console: Console) -> None:
    _say(console, f"  drive next: {escape(following.words())}")
    console.print(f"  script: {path}   (station run --script {path})", highlight=False, soft_wrap=True, markup=False)


def _print_suspects(found: Investigation, console: Console) -> None:
    table = Table(title="What the first model may lack", title_style="bold", title_justify="left")
    table.add_column("suspect")
    table.add_column("probability", justify="right")
    table.add_column("log evidence", justify="right")
    ranked = sorted(found.suspects, key=lambda suspect: -suspect.probability)
    shown = [s for s in ranked if s.probability >= _LEAST_SHOWN][:_MOST_SHOWN]
    for suspect in shown:
        table.add_row(escape(words(suspect.effect)), probability(suspect.probability), f"{suspect.log_evidence:+.1f}")
    rest = len(ranked) - len(shown)
    if rest:
        left = sum(s.probability for s in ranked if s not in shown)
        table.add_row(f"{rest} others together", probability(left), "", style="dim")
    console.print(table)


def _print_errors(found: Investigation, console: Console) -> None:
    where = "cross-validated by step, in-sample" if found.in_sample else "verification run"
    table = Table(
        title=f"Error of the compensated rate, before and after ({where})", title_style="bold", title_justify="left"
    )
    table.add_column("gyro")
    for heading in ("rms\ndeg/h", "\nafter", "largest\ndeg/h", "\nafter", "in 95 %\nbefore", "\nafter"):
        table.add_column(heading, justify="right")
    table.add_column("states moved, in old sigmas\nk / b / sigma_j / sigma_k", justify="right")
    for gyro in found.gyros:
        moved = " / ".join(f"{value:+.1f}" for value in gyro.moved)
        table.add_row(escape(gyro.name), *_both(gyro.before, gyro.after), moved)
    if len(found.gyros) > 1:
        table.add_section()
        table.add_row("all", *_both(found.before, found.after), "")
    console.print(table)
    _say(console, improvement_line(found))
    if found.in_sample:
        _say(
            console,
            "[yellow]in-sample:[/] no verification run was given (--verify); these figures are cross-validated by step "
            "of the same recordings, and say less than a run of its own would",
        )


def _both(before: Errors, after: Errors) -> list[str]:
    return [
        dph(before.rms_rps),
        dph(after.rms_rps),
        dph(before.max_rps),
        dph(after.max_rps),
        f"{before.coverage95:.1%}",
        f"{after.coverage95:.1%}",
    ]


def improvement_line(found: Investigation) -> str:
    """Return by how much the error became smaller, and how well that is known."""
    gain = found.improvement
    if gain is None:
        return f"rms error {dph(found.before.rms_rps)} deg/h; nothing was added, so nothing changed"
    return (
        f"rms error {dph(found.before.rms_rps)} -> {dph(found.after.rms_rps)} deg/h: {gain.ratio:.3g} times smaller "
        f"(95 %: {gain.low:.3g} to {gain.high:.3g}), over the whole of the run, its noise taken off"
    )


def models_table(models: Sequence[ModelStep], title: str = "Chain of models") -> Table:
    """Return one row a model: what it added, its evidence, its error."""
    table = Table(title=title, title_style="bold", title_justify="left")
    table.add_column("model", overflow="fold")
    for heading in ("log evidence", "rms deg/h", "largest deg/h", "in 95 %"):
        table.add_column(heading, justify="right")
    for number, model in enumerate(models):
        table.add_row(
            " + ".join(["four states", *map(words, model.effects)]),
            f"{model.log_evidence:+.1f}" if number else "0",
            dph(model.errors.rms_rps),
            dph(model.errors.max_rps),
            f"{model.errors.coverage95:.1%}",
        )
    return table


def dph(rate_rps: float) -> str:
    """Return a rate in deg/h with three digits."""
    value = rate_rps * _DEG * 3600
    return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"


def investigation_object(
    found: Investigation, next_script: Path | None, recordings: Sequence[str], verification: Sequence[str]
) -> dict[str, Any]:
    """Return what --json prints: SI, shares between 0 and 1, null for what is not known."""
    return {
        "verdict": str(found.finding),
        "reason": found.reason,
        "added": [
            {
                "effect": added.effect,
                "constructed": added.constructed,
                "expression": added.expression,
                "gyros": list(added.gyros),
                "probability": _finite(added.probability),
                "parameters": {name: [_finite(v.value), _finite(v.sd), v.unit] for name, v in added.parameters.items()},
                "out_of_sample": added.out_of_sample and asdict(added.out_of_sample),
                "same": list(added.same),
            }
            for added in found.added
        ],
        "rivals": [list(rivals) for rivals in found.rivals],
        "unexplained": found.unexplained and asdict(found.unexplained),
        "before": _errors(found.before),
        "after": _errors(found.after),
        "improvement": found.improvement and {k: _finite(v) for k, v in asdict(found.improvement).items()},
        "in_sample": found.in_sample,
        "next_script": None if next_script is None else str(next_script),
        "models": [
            {"effects": list(m.effects), "log_evidence": _finite(m.log_evidence), **_errors(m.errors)}
            for m in found.models
        ],
        "gyros": {gyro.name: _gyro(gyro) for gyro in found.gyros},
        "suspects": [
            {"effect": s.effect, "log_evidence": _finite(s.log_evidence), "probability": _finite(s.probability)}
            for s in found.suspects
        ],
        "residual": residual_object(found),
        "left_out": dict(found.left_out),
        "taken_back": list(found.taken_back),
        "notes": list(found.notes),
        "recordings": list(recordings),
        "verification": list(verification),
    }


def empty_object(reason: str, recordings: Sequence[str], verification: Sequence[str]) -> dict[str, Any]:
    """Return what --json prints when there is no verdict."""
    return {"verdict": None, "reason": reason, "recordings": list(recordings), "verification": list(verification)}


def _gyro(gyro: GyroErrors) -> dict[str, Any]:
    return {
        "before": _errors(gyro.before),
        "after": _errors(gyro.after),
        "states_before": _states(gyro.states_before),
        "states_after": _states(gyro.states_after),
        "sd_before": _states(gyro.sd_before),
        "sd_after": _states(gyro.sd_after),
        "moved_sigmas": _states(gyro.moved),
        "phases": [
            {key: _finite(value) if isinstance(value, float) else value for key, value in asdict(phase).items()}
            for phase in gyro.phases
        ],
    }


def _errors(errors: Errors) -> dict[str, float | None]:
    return {key: _finite(value) for key, value in asdict(errors).items()}


def _states(values: Any) -> dict[str, float | None]:
    return dict(zip(STATES, map(_finite, values), strict=True))


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _say(console: Console, text: str) -> None:
    console.print(text, highlight=False)
