"""How well a device repeats over its runs of a script, for people and for --json."""

from collections.abc import Iterator, Sequence
from typing import Any

from rich.markup import escape
from rich.table import Table

from estimator.estimation.repeatability import Repeatability
from station.bench.units import Units
from station.render.results.sizes import two_digits
from station.render.terminal import Shown, line, print_all, rich_table, stdout, title
from station.views.figures import StateUnit, state_figures
from station.views.json_values import by_state

_FIGURES = ("mean", "scatter", "expected", "between", "differs")


def print_repeatability(repeats: Sequence[Repeatability], device: str, script: str, units: Units) -> None:
    """Print the scatter of a device's states over its runs of a script, beside that expected from their sigmas.

    Nothing is printed if ``repeats`` is empty.
    """
    if repeats:
        print_all(stdout(), _shown(repeats, device, script, state_figures(units)))


def _shown(repeats: Sequence[Repeatability], device: str, script: str, figures: Sequence[StateUnit]) -> Iterator[Shown]:
    """Yield the scatter of the states over repeated runs, and a line for each that scatters more than by chance.

    ``device`` and ``script`` are for the title, "" if not known.
    """
    of_device = f" of {device}" if device else ""
    of_script = f" of {script}" if script else ""
    runs = f"{repeats[0].runs} runs{of_script}"
    yield title(f"Repeatability{of_device} over {runs}: scatter (expected from noise)")
    yield _table(repeats, figures), {}
    for gyro in repeats:
        for state, figure in enumerate(figures):
            if gyro.differs[state]:
                yield line(escape(_difference(gyro, state, figure)))


def _table(repeats: Sequence[Repeatability], figures: Sequence[StateUnit]) -> Table:
    heads = ["gyro", *(f"{figure.name} ({figure.unit})" for figure in figures)]
    scatter = rich_table(None, heads, "lr")
    for gyro in repeats:
        scatter.add_row(escape(gyro.name), *(_scatter(gyro, state, figure) for state, figure in enumerate(figures)))
    return scatter


def _scatter(gyro: Repeatability, state: int, figure: StateUnit) -> str:
    scatter = two_digits(float(gyro.scatter[state]) * figure.factor)
    expected = two_digits(float(gyro.expected[state]) * figure.factor)
    mark = " !" if gyro.differs[state] else ""
    return f"{scatter} ({expected}){mark}"


def _difference(gyro: Repeatability, state: int, figure: StateUnit) -> str:
    between = two_digits(float(gyro.between[state]) * figure.factor)
    return f"! {figure.name} of {gyro.name} differs between runs by {between} {figure.unit} beyond its noise"


def repeatability_object(repeats: Sequence[Repeatability]) -> list[dict[str, Any]]:
    """Return the repeatability for --json: by gyro the number of runs and, by state, the figures in SI."""
    return [
        {"name": gyro.name, "runs": gyro.runs, **{key: by_state(getattr(gyro, key)) for key in _FIGURES}}
        for gyro in repeats
    ]
