"""A plan as a person reads it."""

import math
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from drivers.types import Floats
from drivers.units import split_quantity
from estimator.effects.conditions import REFERENCE_C
from estimator.effects.disturbances import TONE
from estimator.observations.coverage import coverage_notes
from estimator.planning.planning import ALIKE, EffectForecast
from station.errors import sentence
from station.render.terminal import Shown, print_all, print_rendered, rich_table
from station.scripts.axis_profile import profile_lines
from station.scripts.plan import WARMING_TIME_S, Plan
from station.scripts.polling import too_steep
from station.scripts.script import Script
from station.views.figures import clock_between, seconds_between, shown_unit, state_figures

MARKED = 1.0
"""Shifts of the states below so many of their sigmas are not worth a word."""


def print_plan(plan: Plan, console: Console, early_late: Plan | None = None) -> None:
    """Print the plan: motion, sigmas of the states, smallest visible effects, effects that look alike, assumptions.

    ``early_late`` is the plan of a script of the same length that turns each axis early and late, if one is offered.
    """
    found = plan.forecast
    span = plan.script.span
    values = {
        "lasting": seconds_between(span.least_s, span.most_s),
        "lasting_minutes": clock_between(span.least_s, span.longer_s),
        "open_steps": open_steps(plan.script),
        "plan": plan,
        "state_figures": state_figures(plan.bench.units),
        "profile": profile_lines(plan.motion, console.width),
        "size": _number,
        "required_words": required_words(plan),
        "is_required": bool(np.isfinite(plan.required).any()),
        "combination": combination,
        "not_proved": coverage_notes(plan.constancy),
        "early_late": early_late and beside_table(plan, early_late),
        "early_late_proves": early_late and proved_words(early_late),
        "warnings": [*plan.rounded, *too_steep(plan.script, plan.bench.table.read_time_s)],
        "partly_seen": any(f.seen.any() and not f.seen.all() for f in found.effects),
        "worst_hidden": _worst_hidden,
        "marked": MARKED,
        "shown_unit": shown_unit,
        "alike": ALIKE,
        "reference_c": REFERENCE_C,
        "warming_time_s": WARMING_TIME_S,
        "tone_hz": TONE.listed(0.0)[0]["frequency_hz"],
    }
    print_rendered(console, "station.render", "plan.rich", values)


def open_steps(script: Script) -> str:
    """Return a sentence on the steps of unknown duration, for which the plan assumes the least; empty if there are
    none.
    """
    steps = [
        f"{timed.step.label}: {seconds_between(timed.span.least_s, timed.span.most_s)}"
        for timed in script.timeline()
        if not timed.span.is_exact
    ]
    if not steps:
        return ""
    return sentence("script.open_steps", steps="; ".join(steps))


def required_words(plan: Plan) -> list[str]:
    """Return the required sigma of each state as text, in the unit of the state; "-" where none is required."""
    limits, found = plan.bench.limits, []
    for figure, sd, written in zip(state_figures(limits.units), limits.sds, limits.written_sds, strict=True):
        quantity = split_quantity(written)
        if quantity is not None and quantity[1] == figure.unit:
            found.append(written.removesuffix(quantity[1]).rstrip())
        else:
            found.append(f"{sd * figure.factor:.4g}" if math.isfinite(sd) else "-")
    return found


def print_early_late(asked: Plan, offered: Plan, path: Path, console: Console) -> None:
    """Print the sigmas of a script that turns each axis early and late, beside those of the asked one, and its file."""
    file_line = escape(f"script: {path}   (station run --script {path})")
    shown: list[Shown] = [
        (beside_table(asked, offered), {}),
        (proved_words(offered), {"highlight": False}),
        (file_line, {"highlight": False, "soft_wrap": True}),
    ]
    print_all(console, shown)


def beside_table(asked: Plan, offered: Plan) -> Table:
    """Return a table of the predicted sigmas of ``offered``, which turns each axis early and late, beside those of
    ``asked``.
    """
    heads = ["gyro"]
    figures = state_figures(asked.bench.units)
    for figure in figures:
        heads += [f"{figure.name}\n{figure.unit}", "\nasked"]
    sigmas = rich_table(
        f"Predicted sigmas with every axis turned early and late, in {offered.script.least_s:.4g} s",
        heads,
        "lrdrdrdrd",
    )
    several = len({gyro.source for gyro in offered.forecast.gyros}) > 1
    for gyro, own, others in zip(offered.forecast.gyros, offered.sd, asked.sd, strict=True):
        cells = [escape(f"{gyro.source} {gyro.name}" if several else gyro.name)]
        for state, figure in enumerate(figures):
            cells += [_number(float(own[state] * figure.factor)), _number(float(others[state] * figure.factor))]
        sigmas.add_row(*cells)
    return sigmas


def proved_words(plan: Plan) -> str:
    """Return in words over which time a script proves constancy, by axis."""
    spans = [
        f"{one.axis} from {one.covered_s[0]:.0f} to {one.covered_s[1]:.0f} s" for one in plan.constancy if one.covered_s
    ]
    return f"constancy proved: {', '.join(spans)}"


def combination(direction: Floats) -> str:
    """Return a direction (4,) of the states in words, such as "k + 0.58 sigma_j"; a bias in it is in rad/s."""
    names = ("k", "b", "sigma_j", "sigma_k")
    text = ""
    for value, name in zip(direction, names, strict=True):
        if value == 0:
            continue
        size = "" if math.isclose(abs(value), 1.0, rel_tol=5e-4) else f"{abs(value):.3g} "
        sign = (" - " if value < 0 else " + ") if text else ("-" if value < 0 else "")
        text += f"{sign}{size}{name}"
    return text


def _worst_hidden(forecast: EffectForecast) -> tuple[int, Floats, int] | None:
    """Return the unseen parameter that affects the states most: its index, its shifts and the number of others that
    matter.

    Shifts (gyros, 4) are in sigmas of the states. None if no parameter shifts a state by ``MARKED`` sigmas.
    """
    sigmas = unnoticed(forecast)
    largest = sigmas.max(axis=(1, 2), initial=0.0)
    worst = int(np.argmax(largest))
    return (worst, sigmas[worst], int(np.sum(largest >= MARKED)) - 1) if largest[worst] >= MARKED else None


def unnoticed(forecast: EffectForecast) -> Floats:
    """Return by how many sigmas each parameter shifts the states (P, gyros, 4); 0 where the parameter is seen."""
    # A gyro whose own parameter is seen is not corrupted unnoticed; a shared one is unseen by all or none.
    return np.where(forecast.seen[:, :, None], 0.0, np.abs(forecast.shift_sigmas))


def _number(value: float) -> str:
    """Return three digits without an exponent."""
    if value == 0 or not math.isfinite(value):
        return f"{value:g}"
    digits = max(2 - math.floor(math.log10(abs(value))), 0)
    return f"{value:.{min(digits, 9)}f}"
