"""The predicted sigmas of a plan: whether those required are reached, and errors that the script cannot show."""

import math
from collections.abc import Iterator, Sequence

import numpy as np
from rich.markup import escape
from rich.table import Table

from drivers.units import split_quantity
from estimator.planning.planning import Forecast
from station.render.plans.digits import three_digits
from station.render.terminal import Shown, line, rich_table
from station.scripts.plan import Plan
from station.views.figures import StateUnit, state_figures
from station.views.plan import combination

_NOTHING_REQUIRED = "The bench file requires no sigmas (sd_... in [limits]), so there is nothing to compare with."
_REACHED = "[bold green]OK[/]  every sigma that the bench requires is reached"
_NOT_REACHED = "[bold red]NOT REACHED[/]"
_UNOBSERVABLE = "Errors in these proportions have no effect in this script; only the data sheet limits them."


def verdict_line(plan: Plan, others_missed: Sequence[str] = ()) -> Shown:
    """Return whether the plan reaches the sigmas that the bench requires, what misses them, or that none are required.

    ``others_missed`` names what else than gyros misses its own.
    """
    if not requires_sigmas(plan) and not plan.bench.limits.forces.requires_sigmas:
        return line(_NOTHING_REQUIRED)
    gyros = zip(plan.forecast.gyros, plan.reached, strict=True)
    missed = [*(gyro.name for gyro, reached in gyros if not reached.all()), *others_missed]
    if not missed:
        return line(_REACHED)
    return line(f"{_NOT_REACHED}  sigmas that the bench requires, for {escape(', '.join(missed))}")


def requires_sigmas(plan: Plan) -> bool:
    """Return whether the bench file requires the sigma of any state."""
    return bool(np.isfinite(plan.required).any())


def sigmas_table(plan: Plan) -> Table:
    """Return the predicted sigmas by gyro; if the bench requires sigmas, also those and which are reached.

    Devices are named only if there are several.
    """
    figures = state_figures(plan.bench.units)
    required = requires_sigmas(plan)
    several = len({gyro.source for gyro in plan.forecast.gyros}) > 1
    heads = ["device", "gyro"] if several else ["gyro"]
    align = "l" * len(heads) + "r" * len(figures)
    heads += [f"{figure.name}\n{figure.unit}" for figure in figures]
    if required:
        heads.append("required")
        align += "l"
    table = rich_table("Predicted sigmas of the states", heads, align)
    for row, gyro in enumerate(plan.forecast.gyros):
        cells = [gyro.source, gyro.name] if several else [gyro.name]
        cells = [escape(cell) for cell in cells]
        cells += _sizes(plan.sd[row].tolist(), figures)
        if required:
            cells.append(_comparison(plan.reached[row].tolist(), figures))
        table.add_row(*cells, end_section=gyro is plan.forecast.gyros[-1])
    if required:
        first = ["", "required"] if several else ["required"]
        table.add_row(*first, *required_words(plan), "", style="dim")
    return table


def _sizes(sds: Sequence[float], figures: Sequence[StateUnit]) -> list[str]:
    return [three_digits(sd * figure.factor) for sd, figure in zip(sds, figures, strict=True)]


def _comparison(reached: Sequence[bool], figures: Sequence[StateUnit]) -> str:
    """Return whether all states of a gyro reach what is required, or which do not."""
    short = [figure.name for figure, is_reached in zip(figures, reached, strict=True) if not is_reached]
    return f"{_NOT_REACHED} {', '.join(short)}" if short else "[green]OK[/]"


def required_words(plan: Plan) -> list[str]:
    """Return the required sigma of each state as text, in the unit of the state; "-" where none is required."""
    limits = plan.bench.limits
    figures = state_figures(limits.units)
    return [_required(*each) for each in zip(figures, limits.sds, limits.written_sds, strict=True)]


def _required(figure: StateUnit, sd: float, written: str) -> str:
    """Return a required sigma as it was written, without the unit, if that is the unit of the state.

    Else it is ``sd``, in SI, in that unit; "-" if it is infinite.
    """
    quantity = split_quantity(written)
    if quantity is not None and quantity[1] == figure.unit:
        return written.removesuffix(quantity[1]).rstrip()
    return f"{sd * figure.factor:.4g}" if math.isfinite(sd) else "-"


def unobservable_lines(forecast: Forecast) -> Iterator[Shown]:
    """Yield the combinations of states that no sample of the script would show, by gyro, and what that means.

    Nothing if every state of every gyro is shown.
    """
    gyros = [gyro for gyro in forecast.gyros if len(gyro.unseen)]
    for gyro in gyros:
        combinations = "; ".join(map(combination, gyro.unseen))
        yield line(f"[bold red]unobservable:[/] {escape(f'{gyro.name}: {combinations}')}")
    if gyros:
        yield line(_UNOBSERVABLE)
