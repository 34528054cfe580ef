"""A plan as a person reads it."""

from collections.abc import Iterator, Sequence

from rich.console import Console
from rich.markup import escape

from estimator.effects.conditions import REFERENCE_C
from estimator.effects.disturbances import TONE
from estimator.observations.coverage import coverage_notes
from estimator.planning.planning import Forecast
from station.errors import sentence
from station.render.plans.early_late import beside_table, proved_words
from station.render.plans.effects import effects_shown
from station.render.plans.sigmas import sigmas_table, unobservable_lines, verdict_line
from station.render.terminal import Shown, line, print_all, template_lines
from station.scripts.axis_profile import profile_lines
from station.scripts.plan import WARMING_TIME_S, Plan
from station.scripts.polling import too_steep
from station.scripts.script import Script
from station.views.figures import clock_between, seconds_between, state_figures


def print_plan(plan: Plan, console: Console, early_late: Plan | None = None, missed: Sequence[str] = ()) -> None:
    """Print the plan: verdict on the sigmas, motion, sigmas, states not shown, effects, notes, assumptions.

    The notes are on constancy, and on what of the script was rounded or is too steep to be read.
    ``early_late`` is the plan of a script of the same length that turns each axis early and late, if one is offered.
    ``missed`` names what else than gyros misses its required sigmas.
    """
    figures = state_figures(plan.bench.units)
    shown = [
        verdict_line(plan, missed),
        *_motion(plan, console.width),
        (sigmas_table(plan), {}),
        *unobservable_lines(plan.forecast),
        *_saturated(plan.forecast),
        *effects_shown(plan.forecast, figures),
        line(""),
        *_notes(coverage_notes(plan.constancy)),
        *_early_late(plan, early_late),
        *_notes([*plan.rounded, *too_steep(plan.script, plan.bench.table.read_time_s)]),
        *_assumed(plan),
    ]
    print_all(console, shown)


def _motion(plan: Plan, width: int) -> Iterator[Shown]:
    """Yield name and length of the script, and the rates of the axes over time in ``width`` columns.

    A last line names the steps of which the duration is not known, if there are any.
    """
    span = plan.script.span
    seconds = seconds_between(span.least_s, span.most_s)
    minutes = clock_between(span.least_s, span.longer_s)
    steps = f"{len(plan.script.steps)} steps, within the limits of the table"
    yield line(f"[bold]{escape(plan.script.name)}[/]: {seconds} ({minutes} min), {steps}")
    yield line("")
    for drawn in profile_lines(plan.motion, width):
        yield drawn, {"highlight": False, "markup": False, "no_wrap": True, "overflow": "crop"}
    unknown = open_steps(plan.script)
    if unknown:
        yield unknown, {"style": "dim"}
    yield line("")


def open_steps(script: Script) -> str:
    """Return a sentence on the steps of unknown duration, for which a plan assumes the least; "" if there are none."""
    steps = [
        f"{timed.step.label}: {seconds_between(timed.span.least_s, timed.span.most_s)}"
        for timed in script.timeline()
        if not timed.span.is_exact
    ]
    if not steps:
        return ""
    return sentence("script.open_steps", steps="; ".join(steps))


def _saturated(forecast: Forecast) -> Iterator[Shown]:
    """Yield a warning if the script has no more steady conditions than states."""
    if forecast.saturated:
        yield line(
            f"[bold yellow]saturated:[/] {forecast.steady_conditions} different steady conditions (rests and rates) "
            "for 4 states per gyro. The states absorb any error that is constant within each condition and leave no "
            "residual, so the calibration can be wrong without any sign."
        )


def _notes(texts: list[str]) -> Iterator[Shown]:
    for text in texts:
        yield line(f"[bold yellow]note:[/] {escape(text)}")


def _early_late(plan: Plan, offered: Plan | None) -> Iterator[Shown]:
    """Yield the sigmas of a script that turns each axis early and late; nothing if none is offered."""
    if offered is None:
        return
    yield beside_table(plan, offered), {}
    yield line(f"{escape(proved_words(offered))}; `station plan --early-late` writes this script")
    yield line("")


def _assumed(plan: Plan) -> list[Shown]:
    """Return what the plan assumes of temperature, tones, constant biases, site and table."""
    imus = [imu for imu in plan.bench.imus if imu.used]
    values = {
        "from_degc": f"{REFERENCE_C:g}",
        "rise_degc": f"{plan.temperature_rise_k:g}",
        "warming_min": f"{WARMING_TIME_S / 60:g}",
        "tone_hz": f"{TONE.listed(0.0)[0]['frequency_hz']:g}",
        "constant_biases": ", ".join(imu.name for imu in imus if not imu.noise.instability),
        "has_site": plan.bench.site is not None,
        "has_uncertain_table": plan.bench.table.uncertainty is not None,
    }
    return template_lines("station.render", "assumed.rich", values)
