"""The results: states with their uncertainties, the comparison with the limits, the budget."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from drivers.packaged import packaged_toml
from drivers.units import split_quantity
from estimator.calibration.gyro import GyroCalibration
from estimator.calibration.values import Calibration
from station.report.document_status import Standing
from station.report.figures import ONE, PERCENT, SYMBOLS, Unit, figure, plain, stated, typographic
from station.report.investigation_chapter import Traced
from station.report.recorded import Recorded
from station.run.outcome import Outcome
from station.views.limits import MEAN_NIS, SAMPLES_LOST, LimitLine

SOURCES = packaged_toml("station.views", "budget.toml")["report"]
"""What lines of the budget are called."""


@dataclass(frozen=True, slots=True)
class DeviceSummary:
    """The largest error of each state among the gyros of one device.

    ``largest`` has a gyro and its row in the calibration for each of the four states. ``verdict`` is PASS or FAIL by
    the limits of the device and of the run, or how the run ended otherwise; empty if nothing was judged.
    """

    name: str
    largest: tuple[tuple[GyroCalibration, int], ...]
    verdict: str


def summary(recorded: Recorded, standing: Standing) -> list[DeviceSummary]:
    """Return a summary of each device, in the order of the gyros; none without a calibration."""
    if recorded.calibration is None:
        return []
    rows: dict[str, list[int]] = {}
    for row, gyro in enumerate(recorded.calibration.gyros):
        rows.setdefault(gyro.source, []).append(row)
    return [_device_summary(recorded, standing, name, own) for name, own in rows.items()]


def _device_summary(recorded: Recorded, standing: Standing, name: str, rows: Sequence[int]) -> DeviceSummary:
    """Return the summary of one device, whose gyros are ``rows``; PASS if only other devices failed."""
    assert recorded.calibration is not None
    gyros = recorded.calibration.gyros
    largest = [max(rows, key=lambda row: abs(float(gyros[row].states[state]))) for state in range(4)]
    verdict = "" if standing.verdict is None else str(standing.verdict.outcome)
    own = all(line.within for line in standing.lines if line.row is None or line.row in rows)
    if verdict == Outcome.FAIL and own and not all(line.within for line in standing.lines):
        verdict = str(Outcome.PASS)  # it is another device that failed
    return DeviceSummary(name, tuple((gyros[row], row) for row in largest), verdict)


def moved_by(recorded: Recorded, found: Calibration, traced: Traced) -> float:
    """Return the largest shift of a state by an investigation, in sigmas of the calibration."""
    moved = [
        np.abs(traced.states[traced.names.index(label)] - gyro.states) / gyro.sd
        for gyro, label in zip(found.gyros, recorded.labels, strict=True)
        if label in traced.names
    ]
    return float(np.max(moved, initial=0.0))


def quantity(line: LimitLine) -> tuple[str, Unit, str | None]:
    """Return the quantity of a limit, its unit, and where the recording holds the value (None if nowhere)."""
    if line.state is not None and line.unit is not None:
        unit = Unit(typographic(line.unit.unit), line.unit.factor)
        return SYMBOLS[line.state], unit, f"calibration/{'sd' if line.of_u else 'states'}[{line.row},{line.state}]"
    if line.unit is not None:  # of an accelerometer
        return line.what, Unit(typographic(line.unit.unit), line.unit.factor), None
    if line.what == SAMPLES_LOST:
        return line.what, PERCENT, None
    return line.what, ONE, "calibration@nis_mean" if line.what == MEAN_NIS else None


def written(line: LimitLine) -> Markup:
    """Return the upper bound of a limit as in the bench file; without its unit if that is the column's."""
    _, unit, _ = quantity(line)
    parsed = split_quantity(line.written)
    if parsed is None:
        return stated(line.high, unit)
    text = line.written.removesuffix(parsed[1]).rstrip() if typographic(parsed[1]) == unit.name else line.written
    return figure(line.high, unit, typographic(text))


def limits_by_gyro(standing: Standing) -> Mapping[str, list[tuple[LimitLine | None, LimitLine | None]]]:
    """Return by gyro, for each quantity, its limit and that of its standard uncertainty; None where there is none."""
    quantities: dict[tuple[str, str, str], dict[bool, LimitLine]] = {}
    for line in standing.lines:
        quantities.setdefault((line.gyro, line.what, line.note), {})[line.of_u] = line
    gyros: dict[str, list[tuple[LimitLine | None, LimitLine | None]]] = {}
    for (gyro, _, _), lines in quantities.items():
        gyros.setdefault(gyro, []).append((lines.get(False), lines.get(True)))
    return gyros


def shares(u: Iterable[float], source: str, states: Sequence[tuple[Markup, Unit]]) -> list[Markup]:
    """Return standard uncertainties state by state, in the units of these. ``source``: %d, state."""
    return [
        plain(float(value), unit, 2, source % s) for s, (value, (_, unit)) in enumerate(zip(u, states, strict=True))
    ]
