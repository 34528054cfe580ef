"""A plan as a person reads it."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from rich.console import Console
from rich.table import Table

from drivers.types import Floats
from estimator.effects.conditions import REFERENCE_C
from estimator.effects.constructed import readable as words
from estimator.effects.disturbances import TONE
from estimator.planning.planning import ALIKE, EffectForecast, Forecast
from station.render.terminal import print_rendered, rich_table
from station.scripts.axis_profile import profile_lines
from station.scripts.plan import WARMING_TIME_S, Plan
from station.scripts.polling import too_steep
from station.views.figures import STATE_UNITS, shown_unit

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
        "effects": _effects(found),
        "warnings": [*plan.rounded, *too_steep(plan.script, plan.bench.table.read_time_s)],
        "partly_seen": any(f.seen.any() and not f.seen.all() for f in found.effects),
        "corrupted": [line for forecast in found.effects for line in _corrupted(forecast, found)],
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


def _effects(found: Forecast) -> Table:
    heads = ("effect", "smallest", "up to*", "unit")
    table = rich_table("Smallest size of each effect that would be found", heads, "lrrl")
    for forecast in found.effects:
        for unit in dict.fromkeys(parameter.unit for parameter in forecast.effect.parameters):
            own = [i for i, parameter in enumerate(forecast.effect.parameters) if parameter.unit == unit]
            shown, factor = shown_unit(unit)
            largest = _number(float(forecast.largest[own].max()) * factor)
            table.add_row(words(forecast.effect.name), _smallest(forecast, own, factor), largest, shown)
    return table


def _smallest(forecast: EffectForecast, own: Sequence[int], factor: float) -> str:
    smallest, seen = forecast.smallest[own] * factor, forecast.seen[own]
    if not seen.any():
        return "[red]cannot be seen[/]" if np.any(forecast.shift[own]) else "[dim]does nothing[/]"
    least, most = _number(float(smallest[seen].min())), _number(float(smallest[seen].max()))
    text = least if least == most else f"{least} - {most}"
    return text if seen.all() else f"{text} [red]({int(seen.sum())}/{seen.size})[/]"


def _corrupted(forecast: EffectForecast, found: Forecast) -> list[str]:
    """Return what the worst parameter that is not seen does to the states, a line for each kind of state."""
    hidden = np.flatnonzero(~forecast.seen.all(axis=1))
    sigmas = unnoticed(forecast)
    if not len(hidden) or sigmas.max() < MARKED:
        return []
    worst = int(hidden[np.argmax(sigmas[hidden].max(axis=(1, 2)))])
    parameter = forecast.effect.parameters[worst]
    unit, factor = shown_unit(parameter.unit)
    others = int(np.sum(sigmas[hidden].max(axis=(1, 2)) >= MARKED)) - 1
    more = f" (and {others} more of its parameters)" if others > 0 else ""
    size = f"{_number(parameter.largest * factor)} {unit}"
    lines = [
        f"[bold]{words(forecast.effect.name)}[/], {parameter.name}, {size}{more}; "
        f"needed to see it: {forecast.effect.record.shown_by}"
    ]
    for state, (name, state_unit, scale) in enumerate(STATE_UNITS):
        parts = [
            f"{gyro.name} {'-' if shift < 0 else '+'}{_number(abs(shift * scale))} ({sigma:.0f})"
            for gyro, shift, sigma in zip(
                found.gyros, forecast.shift[worst, :, state], sigmas[worst, :, state], strict=True
            )
            if sigma >= MARKED
        ]
        if parts:
            lines.append(f"  {name} of {', '.join(parts)} {state_unit}")
    return lines


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
