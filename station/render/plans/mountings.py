"""What runs in three mountings will show together, as a person reads it."""

from collections.abc import Iterator, Sequence

from rich.markup import escape
from rich.table import Table

from station.bench.units import Units
from station.opening.planned_mountings import PlannedMountings
from station.render.results.calibration import fitted_figures
from station.render.terminal import Shown, line, print_all, rich_table, stdout
from station.views.accelerometers.result import fitted_forces
from station.views.figures import StateUnit


def print_planned_mountings(planned: Sequence[PlannedMountings], units: Units) -> None:
    """Print the predicted sigmas of the states of each device, those of gyros in these units."""
    for one in planned:
        print_all(stdout(), _shown(one, units))


def _shown(planned: PlannedMountings, units: Units) -> Iterator[Shown]:
    """Yield a line on what is joined, and a table each of gyros and accelerometers."""
    device = escape(planned.device)
    yield line("")
    yield line(f"Three runs with x, y and z of {device} along the axis, joined by `station calibrate --join`:")
    gyros = [(gyro.name, gyro.sd.tolist()) for gyro in planned.calibration.gyros]
    figures = fitted_figures(units, planned.calibration)
    yield _table(f"Predicted sigmas of the gyros of {device}", "gyro", figures, gyros), {}
    for forces in (forces for forces in planned.calibration.forces if forces.accelerometers):
        sds = [(each.name, each.sd.tolist()) for each in forces.accelerometers]
        yield _table("The same of its accelerometers", "sensor", fitted_forces(forces), sds), {}


def _table(
    title: str, sensor_kind: str, figures: Sequence[StateUnit], rows: Sequence[tuple[str, list[float]]]
) -> Table:
    """Return the table of predicted standard deviations; ``rows`` has the name of each sensor and its four, in SI."""
    heads = [f"\n{sensor_kind}", *(f"± {figure.name}\n{figure.unit}" for figure in figures)]
    cells = [[escape(name), *(figure.text(sd) for figure, sd in zip(figures, own, strict=True))] for name, own in rows]
    return rich_table(title, heads, "lrrrr", cells)
