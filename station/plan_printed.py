"""A plan as a person reads it."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from rich.console import Console
from rich.markup import escape

from drivers.arrays import Flags, Floats
from estimator.effects.catalogue import TONE_HZ
from estimator.effects.thermal import REFERENCE_C
from estimator.planning import ALIKE, EffectForecast, Forecast
from station.axis_profile import profile_lines
from station.figures import STATE_UNITS
from station.investigation_printed import words
from station.plan import WARMING_TIME_S, Plan
from station.polling import too_steep
from station.rich_table import rich_table

_DEG = 180 / np.pi
_AT_RPS = math.radians(100.0)
_UNITS = {
    "1": ("ppm", 1e6),
    "1/K": ("ppm/K", 1e6),
    "1/(rad/s)": ("ppm at 100 deg/s", 1e6 * _AT_RPS),
    "1/(rad/s)2": ("ppm at 100 deg/s", 1e6 * _AT_RPS**2),
    "rad": ("urad", 1e6),
    "rad/s": ("deg/h", _DEG * 3600),
    "rad/s/K": ("deg/h/K", _DEG * 3600),
    "rad/s/K2": ("deg/h/K2", _DEG * 3600),
    "rad/s/g": ("deg/h/g", _DEG * 3600),
    "rad/s/(K/s)": ("deg/h/(K/min)", _DEG * 60),
    "rad/s2": ("deg/h/min", _DEG * 3600 * 60),
    "s": ("ms", 1e3),
    "s2": ("ms2", 1e6),
}
"""What a person reads instead of an SI unit, and its factor."""
_MARKED = 1.0  # shifts of the states below so many of their sigmas are not worth a word


def print_plan(plan: Plan, console: Console) -> None:
    """Print the plan: what moves, sigmas of the states, smallest effects, what looks alike, what was assumed."""
    _say(console, _headline(plan))
    console.print()
    for line in profile_lines(plan.motion, console.width):
        console.print(line, highlight=False, markup=False, no_wrap=True, overflow="crop")
    console.print()
    _print_states(plan, console)
    _print_excitation(plan.forecast, console)
    if plan.forecast.effects:
        console.print()
        _print_effects(plan.forecast, console)
        _print_corrupted(plan.forecast, console)
        _print_pairs(plan.forecast, console)
    console.print()
    for text in too_steep(plan.script, plan.bench.table.read_time_s):
        _say(console, f"[bold yellow]note:[/] {escape(text)}")
    for note in _assumptions(plan):
        _say(console, f"[dim]assumed:[/] {note}")
    console.print()
    _say(console, _summary(plan))


def _say(console: Console, text: str) -> None:
    console.print(text, highlight=False)


def _headline(plan: Plan) -> str:
    minutes, seconds = divmod(round(plan.script.duration_s), 60)
    return (
        f"[bold]{escape(plan.script.name)}[/]: {plan.script.duration_s:g} s ({minutes}:{seconds:02d} min), "
        f"{len(plan.script.steps)} steps, within the limits of the table"
    )


def _print_states(plan: Plan, console: Console) -> None:
    asked = bool(np.isfinite(plan.required).any())
    several = len({gyro.source for gyro in plan.forecast.gyros}) > 1
    heads = [*(["device"] if several else []), "gyro", *(f"{name}\n{unit}" for name, unit, _ in STATE_UNITS)]
    align = "l" * (1 + several) + "rrrr"
    if asked:
        heads, align = [*heads, "required"], f"{align}l"
    table = rich_table("Predicted sigmas of the states", heads, align)
    for gyro, sd, reached in zip(plan.forecast.gyros, plan.sd, plan.reached, strict=True):
        cells = [gyro.source] if several else []
        cells += [gyro.name, *(_number(v * f) for v, (_, _, f) in zip(sd, STATE_UNITS, strict=True))]
        table.add_row(*cells, *([_reached(reached)] if asked else []), end_section=gyro is plan.forecast.gyros[-1])
    if asked:
        limits = [
            _number(v * f) if np.isfinite(v) else "-" for v, (_, _, f) in zip(plan.required, STATE_UNITS, strict=True)
        ]
        table.add_row(*([""] if several else []), "required", *limits, "", style="dim")
    console.print(table)


def _summary(plan: Plan) -> str:
    if not np.isfinite(plan.required).any():
        return "The bench file requires no sigmas (sd_... of its limits), so there is nothing to reach."
    missed = [gyro.name for gyro, reached in zip(plan.forecast.gyros, plan.reached, strict=True) if not reached.all()]
    if missed:
        return f"[bold red]NOT REACHED[/]  sigmas that the bench requires, for {', '.join(missed)}"
    return "[bold green]OK[/]  every sigma that the bench requires is reached"


def _reached(reached: Flags) -> str:
    missed = [name for (name, _, _), ok in zip(STATE_UNITS, reached, strict=True) if not ok]
    return f"[bold red]NOT REACHED[/] {', '.join(missed)}" if missed else "[green]OK[/]"


def _print_excitation(found: Forecast, console: Console) -> None:
    unseen = [gyro for gyro in found.gyros if len(gyro.unseen)]
    for gyro in unseen:
        _say(console, f"[bold red]unobservable:[/] {gyro.name}: {'; '.join(map(combination, gyro.unseen))}")
    if unseen:
        _say(
            console,
            "Errors in these proportions change nothing that the script shows; only the data sheet limits them.",
        )
    if found.saturated:
        _say(
            console,
            f"[bold yellow]saturated:[/] {found.steady_conditions} steady conditions (rests and rates that differ) for "
            "4 states a gyro. Whatever is constant within each condition is taken up by the states and leaves no "
            "residual, so the calibration can be wrong without a sign of it.",
        )


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


def _print_effects(found: Forecast, console: Console) -> None:
    heads = ("effect", "smallest", "up to*", "unit")
    table = rich_table("Smallest size of each effect that would be found", heads, "lrrl")
    for forecast in found.effects:
        for unit in dict.fromkeys(parameter.unit for parameter in forecast.effect.parameters):
            own = [i for i, parameter in enumerate(forecast.effect.parameters) if parameter.unit == unit]
            shown, factor = _UNITS[unit]
            table.add_row(
                words(forecast.effect.name),
                _smallest(forecast, own, factor),
                _number(float(forecast.largest[own].max()) * factor),
                shown,
            )
    console.print(table)
    _say(console, "[dim]Found in 95 % of runs at 1 % false alarms, each alone. * largest plausible size[/]")
    if any(f.seen.any() and not f.seen.all() for f in found.effects):
        _say(console, "[dim](3/4): the other parameters or gyros, here one of four, cannot be seen[/]")


def _smallest(forecast: EffectForecast, own: Sequence[int], factor: float) -> str:
    smallest, seen = forecast.smallest[own] * factor, forecast.seen[own]
    if not seen.any():
        return "[red]cannot be seen[/]" if np.any(forecast.shift[own]) else "[dim]does nothing[/]"
    least, most = _number(float(smallest[seen].min())), _number(float(smallest[seen].max()))
    text = least if least == most else f"{least} - {most}"
    return text if seen.all() else f"{text} [red]({int(seen.sum())}/{seen.size})[/]"


def _print_corrupted(found: Forecast, console: Console) -> None:
    lines = [line for forecast in found.effects for line in _corrupted(forecast, found)]
    if lines:
        console.print()
        _say(console, "[bold]What cannot be seen would pass as an error of these states[/] (in brackets: in sigmas)")
    for line in lines:
        _say(console, line)


def _corrupted(forecast: EffectForecast, found: Forecast) -> list[str]:
    """Return what the worst parameter that is not seen does to the states, a line for each kind of state."""
    hidden = np.flatnonzero(~forecast.seen.all(axis=1))
    # A gyro whose own parameter is seen is not corrupted unnoticed; a shared one is unseen by all or none.
    sigmas = np.where(forecast.seen[:, :, None], 0.0, np.abs(forecast.shift_sigmas))
    if not len(hidden) or sigmas.max() < _MARKED:
        return []
    worst = int(hidden[np.argmax(sigmas[hidden].max(axis=(1, 2)))])
    parameter = forecast.effect.parameters[worst]
    unit, factor = _UNITS[parameter.unit]
    others = int(np.sum(sigmas[hidden].max(axis=(1, 2)) >= _MARKED)) - 1
    more = f" (and {others} more of its parameters)" if others > 0 else ""
    size = f"{_number(parameter.largest * factor)} {unit}"
    lines = [
        f"[bold]{words(forecast.effect.name)}[/], {parameter.name}, {size}{more}; "
        f"needed to see it: {forecast.effect.shown_by}"
    ]
    for state, (name, state_unit, scale) in enumerate(STATE_UNITS):
        parts = [
            f"{gyro.name} {_signed(shift * scale)} ({sigma:.0f})"
            for gyro, shift, sigma in zip(
                found.gyros, forecast.shift[worst, :, state], sigmas[worst, :, state], strict=True
            )
            if sigma >= _MARKED
        ]
        if parts:
            lines.append(f"  {name} of {', '.join(parts)} {state_unit}")
    return lines


def _print_pairs(found: Forecast, console: Console) -> None:
    console.print()
    if not found.pairs:
        _say(console, f"No two effects that can be seen look alike (correlation above {ALIKE:g}).")
        return
    heads = ("effect", "parameter", "is copied by", "correlation")
    table = rich_table("Effects that this script cannot tell apart", heads, "lllr")
    for pair in found.pairs:
        table.add_row(words(pair.first), pair.parameter, words(pair.second), f"{min(pair.correlation, 0.9999):.4f}")
    console.print(table)


def _assumptions(plan: Plan) -> list[str]:
    bench = plan.bench
    notes = [
        f"a temperature that rises from {REFERENCE_C:g} degC by {plan.temperature_rise_k:g} degC with a time constant "
        f"of {WARMING_TIME_S / 60:g} min (--temperature-rise), a tone at {TONE_HZ:g} Hz",
        "noise and prior as the data sheets in the bench file state them; a run has to find the noise in its data, and "
        "states sigmas up to a third larger for that doubt",
    ]
    unstated = [imu.name for imu in bench.imus if imu.used and not imu.noise.instability]
    if unstated:
        notes.append(f"a bias that does not wander: no bias instability is stated for {', '.join(unstated)}")
    if bench.site is None:
        notes.append("no site in the bench file, so Earth rate is not in the model, but an effect")
    else:
        notes.append("Earth rate is in the model; the effect of that name is what latitude and heading are wrong by")
    if bench.table.uncertainty is not None:
        notes.append("the sigmas hold the table's uncertainty as the bench file states it")
    else:
        notes.append("a perfect table: the bench file states no uncertainty of it")
    return notes


def _signed(value: float) -> str:
    return f"{'-' if value < 0 else '+'}{_number(abs(value))}"


def _number(value: float) -> str:
    """Return three digits without an exponent."""
    if value == 0 or not math.isfinite(value):
        return f"{value:g}"
    digits = max(2 - math.floor(math.log10(abs(value))), 0)
    return f"{value:.{min(digits, 6)}f}"
