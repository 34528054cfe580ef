"""What was found: states with their uncertainties, the comparison with the limits, the budget."""

from collections.abc import Iterable, Mapping

import numpy as np
from markupsafe import Markup

from drivers.packaged import packaged_toml
from estimator.calibration.values import Calibration
from station.report.figures import ONE, PERCENT, STATES, Unit, figure, plain
from station.report.recorded import Recorded
from station.report.standing import Standing
from station.report.traced import Traced
from station.views.limits import MEAN_NIS, SAMPLES_LOST, LimitLine

_NEXT_TO_NOTHING = 0.01  # ppm, deg/h, urad
SOURCES = packaged_toml("station.views", "budget.toml")["report"]
"""What lines of the budget are called."""


def moved_by(recorded: Recorded, found: Calibration, traced: Traced) -> float:
    """Return by how many of their sigmas an investigation moved the states, the largest."""
    moved = [
        np.abs(traced.states[traced.names.index(label)] - gyro.states) / gyro.sd
        for gyro, label in zip(found.gyros, recorded.labels, strict=True)
        if label in traced.names
    ]
    return float(np.max(moved, initial=0.0))


def quantity(line: LimitLine) -> tuple[str, Unit, str | None]:
    """Return what a limit is of, its unit, and where the recording has the value."""
    if line.state is not None:
        return *STATES[line.state], f"calibration/{'sd' if line.of_u else 'states'}[{line.row},{line.state}]"
    if line.what == SAMPLES_LOST:
        return line.what, PERCENT, None
    return line.what, ONE, "calibration@nis_mean" if line.what == MEAN_NIS else None


def limits_by_gyro(standing: Standing) -> Mapping[str, list[tuple[LimitLine | None, LimitLine | None]]]:
    """Return by gyro the limits of each quantity, and of its standard uncertainty."""
    quantities: dict[tuple[str, str, str], dict[bool, LimitLine]] = {}
    for line in standing.lines:
        quantities.setdefault((line.gyro, line.what, line.note), {})[line.of_u] = line
    gyros: dict[str, list[tuple[LimitLine | None, LimitLine | None]]] = {}
    for (gyro, _, _), lines in quantities.items():
        gyros.setdefault(gyro, []).append((lines.get(False), lines.get(True)))
    return gyros


def shares(u: Iterable[float], source: str, next_to_nothing: float = _NEXT_TO_NOTHING) -> list[Markup]:
    """Return standard uncertainties state by state; what is next to nothing is said to be so. ``source``: %d, state."""
    return [
        figure(value, unit, "< 0.01", source % s)
        if value * unit.factor < next_to_nothing
        else plain(float(value), unit, 2, source % s)
        for s, (value, (_, unit)) in enumerate(zip(u, STATES, strict=True))
    ]
