"""What a plan says of effects: detectable sizes, those that pass for errors of the states, those that look alike."""

from collections.abc import Iterator, Sequence

from rich.markup import escape
from rich.table import Table

from estimator.effects.constructed import readable
from estimator.planning.planning import ALIKE, Forecast, Pair
from station.render.plans.digits import three_digits
from station.render.terminal import Shown, line, rich_table
from station.views.figures import StateUnit
from station.views.plan import DetectableSizes, HiddenEffect, Shift, StateShifts, detectable_sizes, hidden_effects

_DETECTED = "[dim]Detected in 95 % of runs at 1 % false alarms, each effect alone. * largest plausible size[/]"
_PARTLY = "[dim](3/4): the remaining parameters or gyros, here one of four, are not detectable[/]"
_HIDDEN = "[bold]Undetectable effects would appear as errors of these states[/] (in brackets: in sigmas)"
_MOST_CORRELATED = 0.9999
"""No correlation is told to be 1: the effects are different ones."""


def effects_shown(forecast: Forecast, figures: tuple[StateUnit, ...]) -> Iterator[Shown]:
    """Yield tables and lines on the effects of a forecast, with the states in these units; nothing without effects.

    They are the sizes that can be detected, effects that hide in the states, and pairs that look alike.
    """
    if not forecast.effects:
        return
    sizes = [row for found in forecast.effects for row in detectable_sizes(found)]
    yield line("")
    yield _sizes_table(sizes), {}
    yield line(_DETECTED)
    if any(found.seen.any() and not found.seen.all() for found in forecast.effects):
        yield line(_PARTLY)
    hidden = hidden_effects(forecast, figures)
    if hidden:
        yield line("")
        yield line(_HIDDEN)
    for effect in hidden:
        yield from map(line, _hidden_lines(effect))
    yield line("")
    if forecast.pairs:
        yield _pairs_table(forecast.pairs), {}
    else:
        yield line(f"No two detectable effects look alike (correlation above {ALIKE:g}).")


def _sizes_table(sizes: Sequence[DetectableSizes]) -> Table:
    rows = [[escape(row.effect), _smallest(row), three_digits(row.largest), row.unit] for row in sizes]
    return rich_table("Smallest detectable size of each effect", ["effect", "smallest", "up to*", "unit"], "lrrl", rows)


def _smallest(sizes: DetectableSizes) -> str:
    """Return as markup the smallest detectable size, or a span of them; how many are detectable is added if not all.

    "not detectable", or "no influence" for an effect that does nothing in this script, if none is.
    """
    if sizes.least is None or sizes.most is None:
        return "[red]not detectable[/]" if sizes.has_influence else "[dim]no influence[/]"
    least = three_digits(sizes.least)
    most = three_digits(sizes.most)
    text = least if least == most else f"{least} - {most}"
    if sizes.detected == sizes.count:
        return text
    return f"{text} [red]({sizes.detected}/{sizes.count})[/]"


def _hidden_lines(hidden: HiddenEffect) -> Iterator[str]:
    """Yield a line on an effect that would pass unnoticed, and one for each state that it would shift."""
    more = f" (and {hidden.others} more of its parameters)" if hidden.others > 0 else ""
    size = f"{three_digits(hidden.largest)} {hidden.unit}"
    about = f"{hidden.parameter}, {size}{more}; detected by: {hidden.shown_by}"
    yield f"[bold]{escape(hidden.effect)}[/], {escape(about)}"
    for state in hidden.states:
        yield escape(_state_line(state))


def _state_line(state: StateShifts) -> str:
    return f"  {state.state} of {', '.join(map(_shift, state.shifts))} {state.unit}"


def _shift(shift: Shift) -> str:
    sign = "-" if shift.size < 0 else "+"
    return f"{shift.gyro} {sign}{three_digits(abs(shift.size))} ({shift.sigmas:.0f})"


def _pairs_table(pairs: Sequence[Pair]) -> Table:
    """Return a row for each pair of effects that the script cannot tell apart, with parameter and correlation.

    That is never shown as 1, but as 0.9999 at the most.
    """
    rows = [
        [
            escape(readable(pair.first)),
            escape(pair.parameter),
            escape(readable(pair.second)),
            f"{min(pair.correlation, _MOST_CORRELATED):.4f}",
        ]
        for pair in pairs
    ]
    heads = ["effect", "parameter", "looks like", "correlation"]
    return rich_table("Effects that this script cannot tell apart", heads, "lllr", rows)
