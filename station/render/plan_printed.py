"""A plan as a person reads it."""

import math

import numpy as np
from rich.console import Console

from drivers.types import Floats
from estimator.effects.conditions import REFERENCE_C
from estimator.effects.disturbances import TONE
from estimator.planning.planning import ALIKE, EffectForecast
from station.render.terminal import print_rendered
from station.scripts.axis_profile import profile_lines
from station.scripts.plan import WARMING_TIME_S, Plan
from station.scripts.polling import too_steep
from station.views.figures import shown_unit

MARKED = 1.0
"""Shifts of the states below so many of their sigmas are not worth a word."""


def print_plan(plan: Plan, console: Console) -> None:
    """Print the plan: what moves, sigmas of the states, smallest effects, what looks alike, what was assumed."""
    found = plan.forecast
    values = {
        "plan": plan,
        "profile": profile_lines(plan.motion, console.width),
        "size": _number,
        "is_required": bool(np.isfinite(plan.required).any()),
        "combination": combination,
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


def combination(direction: Floats) -> str:
    """Return a direction of the states in words, such as "k + 0.58 sigma_j"; a bias in it is in rad/s."""
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
    """Return of the parameters that are not seen which does most to the states, and how many others do enough.

    Between the two by how many sigmas it moves the states of each gyro (gyros, 4). None if none does enough.
    """
    sigmas = unnoticed(forecast)
    largest = sigmas.max(axis=(1, 2), initial=0.0)
    worst = int(np.argmax(largest))
    return (worst, sigmas[worst], int(np.sum(largest >= MARKED)) - 1) if largest[worst] >= MARKED else None


def unnoticed(forecast: EffectForecast) -> Floats:
    """Return by how many sigmas each parameter moves the states of each gyro (P, gyros, 4) where it is not seen."""
    # A gyro whose own parameter is seen is not corrupted unnoticed; a shared one is unseen by all or none.
    return np.where(forecast.seen[:, :, None], 0.0, np.abs(forecast.shift_sigmas))


def _number(value: float) -> str:
    """Return three digits without an exponent."""
    if value == 0 or not math.isfinite(value):
        return f"{value:g}"
    digits = max(2 - math.floor(math.log10(abs(value))), 0)
    return f"{value:.{min(digits, 9)}f}"
