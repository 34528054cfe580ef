"""What a person sees in the terminal: progress, the table of states, the verdict; and the JSON for machines."""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, TaskID, TextColumn
from rich.progress import Progress as RichProgress
from rich.table import Table

from estimator.budget import UNSEEN
from estimator.calibration import Calibration, GyroCalibration
from estimator.model import STATES
from estimator.repeatability import Repeatability
from estimator.rests import RestNoise
from station.errors import EXIT_USAGE
from station.figures import STATE_FIGURES, clock, number
from station.outcome import Outcome, Verdict
from station.snapshot import Snapshot

_REFRESH_S = 0.1  # of the wall's clock: a person watches, however fast the loop's clock runs
_COLOURS = {
    Outcome.PASS: "bold green",
    Outcome.ESTIMATED: "bold blue",
    Outcome.FAIL: "bold red",
    Outcome.ABORTED: "bold yellow",
    Outcome.FAULT: "bold red",
}
_BUDGET_WORDS = {
    "noise": "noise (type A)",
    "effects": "effects of the model (type A)",
    "rate": "table rate (type B)",
    "wobble": "table wobble (type B)",
    "orthogonality": "table orthogonality (type B)",
    "timing": "table timing (type B)",
    UNSEEN: "effects that this script cannot show (type B)",
}
_PIPE_WIDTH = 120
_PLAIN_EVERY = 0.1  # without a terminal: one line each tenth of the run


class Progress:
    """Progress of a run on stderr: a bar in a terminal, a few lines elsewhere, nothing when quiet."""

    def __init__(self, quiet: bool) -> None:
        """Show nothing if quiet."""
        self._quiet = quiet
        self._console = Console(stderr=True)
        self._bar: RichProgress | None = None
        self._task = TaskID(0)
        self._shown_at = 0.0
        self._shown_share = -1.0

    def __enter__(self) -> Progress:
        if not self._quiet and self._console.is_terminal:
            columns = (TextColumn("{task.description:<18}"), BarColumn(), TextColumn("{task.fields[detail]}"))
            self._bar = RichProgress(*columns, console=self._console, auto_refresh=False)
            self._bar.start()
            self._task = self._bar.add_task("connecting", total=1.0, detail="")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.refresh()
            self._bar.stop()

    def show(self, look: Callable[[], Snapshot]) -> None:
        """Show where the run is, not more often than a person can read; ``look`` is asked only then."""
        now = time.monotonic()
        if self._quiet or now - self._shown_at < _REFRESH_S:
            return
        self._shown_at = now
        snapshot = look()
        detail = (
            f"{clock(snapshot.remaining_s)} left   {snapshot.samples} samples, {snapshot.lost} lost   "
            f"NIS {number(snapshot.nis_mean, 2)}"
        )
        if self._bar is not None:
            self._bar.update(self._task, description=snapshot.doing, completed=snapshot.share, detail=detail)
            self._bar.refresh()
        elif snapshot.share - self._shown_share >= _PLAIN_EVERY:
            self._shown_share = snapshot.share
            self._console.print(f"{snapshot.share:4.0%}  {snapshot.doing:<18} {detail}", highlight=False)


def print_calibration(calibration: Calibration) -> None:
    """Print the states of every gyro with their sigmas, in the units people use."""
    table = Table(title="States and their standard deviations", title_style="bold", title_justify="left")
    table.add_column("gyro")
    for state in STATE_FIGURES:
        table.add_column(f"{state.name} ({state.unit})", justify="right")
        table.add_column("±", justify="right", style="dim")
    table.add_column("noise (deg/s)", justify="right")
    for gyro in calibration.gyros:
        cells = [gyro.name]
        for state, value, sd in zip(STATE_FIGURES, gyro.states, gyro.sd, strict=True):
            cells += [state.text(value), state.text(sd)]
        table.add_row(*cells, f"{math.degrees(gyro.noise_rps):.4f}")
    console = stdout()
    console.print(table)
    if any(gyro.effects for gyro in calibration.gyros):
        _print_effects(console, calibration.gyros)
    _print_budget(console, calibration)
    nis = (
        f"mean NIS {calibration.nis_mean:.3f} per degree of freedom (1 = the filter's sigmas are true), "
        if np.isfinite(calibration.nis_mean)
        else ""
    )
    console.print(f"{nis}{calibration.samples} samples, {calibration.lost} lost", highlight=False)
    if calibration.holds_for:
        console.print(f"holds for: {calibration.holds_for}", highlight=False)
    for note in calibration.notes:
        console.print(f"note: {note}", highlight=False)


def _print_effects(console: Console, gyros: Sequence[GyroCalibration]) -> None:
    """Print what the effects of the error model are on each gyro, a line a parameter, beside what was expected."""
    from estimator.tracing.investigation import Value
    from station.investigation_printed import human, words

    table = Table(title="Effects of the error model", title_style="bold", title_justify="left")
    table.add_column("effect")
    table.add_column("parameter")
    table.add_column("gyro")
    table.add_column("found", justify="right")
    table.add_column("typical size", justify="right", style="dim")
    for place, effect in enumerate(gyros[0].effects):
        rows = gyros[:1] if effect.shared else gyros
        for row, gyro in enumerate(rows):
            value = gyro.effects[place]
            found = human(Value(value.value, value.sd, value.unit))
            typical = human(Value(value.expected_sd, 0.0, value.unit)) if not (row or value.shared) else ""
            heads = ("", "") if row else (escape(words(value.effect)), escape(value.parameter))
            table.add_row(*heads, "all" if value.shared else escape(gyro.name), found, typical)
    console.print(table)


def _print_budget(console: Console, calibration: Calibration) -> None:
    """Print where the sigmas come from: noise and the table's own uncertainty, rms over the gyros."""
    budgets = [{c.name: c.u for c in gyro.budget} for gyro in calibration.gyros]
    names = list(budgets[0]) if budgets else []
    if len(names) > 1 and all(list(budget) == names for budget in budgets):
        table = Table(title="Uncertainty budget, rms over the gyros", title_style="bold", title_justify="left")
        table.add_column("source")
        for heading in ("k (ppm)", "b (deg/h)", "sigma_j (urad)", "sigma_k (urad)"):
            table.add_column(heading, justify="right")
        lines = {_BUDGET_WORDS.get(name, name): np.array([budget[name] for budget in budgets]) for name in names}
        lines["combined"] = np.array([gyro.sd for gyro in calibration.gyros])
        for name, u in lines.items():
            rms = np.sqrt(np.mean(u**2, axis=0)) * (1e6, math.degrees(3600), 1e6, 1e6)
            table.add_row(name, *map(_size, rms))
        console.print(table)
    found = [gyro.noise for gyro in calibration.gyros if gyro.noise is not None]
    if found:
        arw = math.degrees(np.mean([n.mean.arw for n in found]))
        instability = math.degrees(np.mean([n.instability_below for n in found])) * 3600
        walk = math.degrees(np.mean([n.walk_below for n in found])) * 3600 * 60
        console.print(
            f"noise found: angle random walk {arw:.3g} deg/s/rtHz, bias instability below {instability:.2g} deg/h, "
            f"rate random walk below {walk:.2g} deg/h/rth (95 %)",
            highlight=False,
        )
    rests = [gyro.rest for gyro in calibration.gyros if gyro.rest is not None]
    if rests:
        arw = math.degrees(np.mean([rest.noise.arw for rest in rests]))
        console.print(
            f"at rest alone, {np.mean([rest.span_s for rest in rests]):.0f} s: angle random walk {arw:.3g} "
            f"deg/s/rtHz, least Allan deviation {_lowest(rests)}",
            highlight=False,
        )


def _lowest(rests: Sequence[RestNoise]) -> str:
    """Return where the mean Allan deviation of the gyros is least, in words."""
    shortest = min(rests, key=lambda rest: len(rest.tau_s))
    mean = np.mean([rest.deviation_rps[: len(shortest.tau_s)] for rest in rests], axis=0)
    least = int(np.argmin(mean))
    return f"{math.degrees(mean[least]) * 3600:.2g} deg/h at {shortest.tau_s[least]:.0f} s"


def print_repeatability(repeats: Sequence[Repeatability], device: str) -> None:
    """Print how the states of a device scatter over its runs, beside the scatter that their sigmas promise."""
    if not repeats:
        return
    title = (
        f"Repeatability{' of ' + device if device else ''} over {repeats[0].runs} runs: scatter (expected from noise)"
    )
    table = Table()
    table.add_column("gyro")
    for heading in ("k (ppm)", "b (deg/h)", "sigma_j (urad)", "sigma_k (urad)"):
        table.add_column(heading, justify="right")
    scales = np.array([1e6, math.degrees(3600), 1e6, 1e6])
    for gyro in repeats:
        pairs = zip(gyro.scatter * scales, gyro.expected * scales, gyro.differs, strict=True)
        table.add_row(gyro.name, *(f"{_size(s)} ({_size(e)}){' !' if d else ''}" for s, e, d in pairs))
    console = stdout()
    console.print(title, style="bold", highlight=False)
    console.print(table)
    for gyro in repeats:
        for name, between, scale, unit, differs in zip(
            ("k", "b", "sigma_j", "sigma_k"),
            gyro.between,
            scales,
            ("ppm", "deg/h", "urad", "urad"),
            gyro.differs,
            strict=True,
        ):
            if differs:
                console.print(
                    f"! {name} of {gyro.name} differs between runs by {_size(between * scale)} {unit} beyond its noise",
                    highlight=False,
                )


def repeatability_object(repeats: Sequence[Repeatability]) -> list[dict[str, Any]]:
    """Return the repeatability as what --json prints: by gyro the runs and, by state, the figures in SI."""
    return [
        {
            "name": gyro.name,
            "runs": gyro.runs,
            **{
                key: dict(zip(STATES, getattr(gyro, key).tolist(), strict=True))
                for key in ("mean", "scatter", "expected", "between", "differs")
            },
        }
        for gyro in repeats
    ]


def _size(value: float) -> str:
    return "< 0.01" if value < 0.01 else f"{value:.2g}" if value < 10 else f"{value:.0f}"


def print_verdict(verdict: Verdict, recording: Path) -> None:
    """Print how it ended, why, and where the recording is."""
    console = stdout()
    console.print(f"[{_COLOURS[verdict.outcome]}]{verdict.outcome}[/]  {verdict.reason}", highlight=False)
    console.print(f"recording: {recording}", highlight=False, soft_wrap=True)


@dataclass(frozen=True, slots=True)
class OverviewLine:
    """One recording among many. ``seen`` is the largest sigma of its states as a share of the data sheet's."""

    recording: str
    device: str
    script: str
    verdict: Verdict
    nis_mean: float
    seen: float


def print_overview(lines: Sequence[OverviewLine], folder: str) -> None:
    """Print one line a recording: what it is of, how it was judged, how well it shows its states, how true it is."""
    table = Table(title=f"Recordings in {escape(folder)}", title_style="bold", title_justify="left")
    for heading in ("recording", "device", "script"):
        table.add_column(heading, overflow="fold")
    table.add_column("outcome")
    for heading in ("worst sigma / prior", "mean NIS"):
        table.add_column(heading, justify="right")
    table.add_column("reason", overflow="fold")
    for line in lines:
        outcome = line.verdict.outcome
        table.add_row(
            escape(line.recording),
            escape(line.device),
            escape(line.script),
            f"[{_COLOURS[outcome]}]{outcome}[/]",
            f"{line.seen:.2%}",
            f"{line.nis_mean:.3f}" if np.isfinite(line.nis_mean) else "",
            "" if outcome is Outcome.PASS else escape(line.verdict.reason),
        )
    stdout().print(table)


def refuse(reason: str, as_json: bool, outcome: Outcome | None = None, recording: str | None = None) -> int:
    """Say on stderr why there is no result, and as JSON an empty one; return the exit code."""
    print(f"station: {reason}", file=sys.stderr)
    if as_json:
        empty: dict[str, Any] = {"outcome": outcome and str(outcome), "reason": reason, "recording": recording}
        print(json.dumps({**empty, "gyros": [], "nis_mean": None, "samples": 0, "lost": 0}))
    return outcome.exit_code if outcome else EXIT_USAGE


def result_object(verdict: Verdict, recording: str, calibration: Calibration | None) -> dict[str, Any]:
    """Return the result as what --json prints."""
    gyros = [
        {
            "name": gyro.name,
            **dict(zip(STATES, map(float, gyro.states), strict=True)),
            "sd": dict(zip(STATES, map(float, gyro.sd), strict=True)),
            "budget": {c.name: dict(zip(STATES, map(float, c.u), strict=True)) for c in gyro.budget},
            "noise": gyro.noise
            and {
                "arw_rps_rthz": gyro.noise.mean.arw,
                "instability_rps": gyro.noise.mean.instability,
                "instability_below_rps": gyro.noise.instability_below,
                "walk_rps_rts": gyro.noise.mean.walk,
                "walk_below_rps_rts": gyro.noise.walk_below,
            },
            **({"effects": _effects_object(gyro)} if gyro.effects else {}),
        }
        for gyro in (calibration.gyros if calibration else ())
    ]
    nis = calibration.nis_mean if calibration and np.isfinite(calibration.nis_mean) else None
    return {
        "outcome": str(verdict.outcome),
        "reason": verdict.reason,
        "recording": recording,
        "gyros": gyros,
        "nis_mean": nis,
        "samples": calibration.samples if calibration else 0,
        "lost": calibration.lost if calibration else 0,
        "holds_for": calibration.holds_for if calibration else "",
        "doubts": list(calibration.doubts) if calibration else [],
        "excluded": {e.name: e.reason for e in calibration.excluded} if calibration else {},
        "parity": {
            c.name: {"rms_sigma": c.rms_sigma, "worst_sigma": c.worst_sigma, "suspect": c.suspect}
            for c in (calibration.parity if calibration else ())
        },
    }


def _effects_object(gyro: GyroCalibration) -> dict[str, dict[str, list[float | str]]]:
    """Return by effect and parameter the value, its standard deviation and its unit."""
    found: dict[str, dict[str, list[float | str]]] = {}
    for value in gyro.effects:
        found.setdefault(value.effect, {})[value.parameter] = [value.value, value.sd, value.unit]
    return found


def stdout() -> Console:
    """Return the console for results; a pipe has no width of its own, and a table of 80 columns loses its numbers."""
    console = Console()
    return console if console.is_terminal else Console(width=_PIPE_WIDTH)
