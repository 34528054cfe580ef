"""The chapter on accelerometers: states, places, intrinsic parameters and sources of uncertainty as finished tables."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from estimator.calibration.accelerometer import ForceCalibration
from station.report.figures import COVERAGE, SYMBOLS, typographic
from station.report.recorded import Recorded
from station.report.tables import Table, table_of
from station.views.accelerometers.result import (
    FORCE_FIGURES,
    LINE_WORDS,
    OFFSET,
    PLACE,
    effect_rows,
    excluded_lines,
    fitted_forces,
    place_figure,
)
from station.views.figures import StateUnit


@dataclass(frozen=True, slots=True, kw_only=True)
class ForceTable:
    """A table with its caption, and a note below it."""

    caption: str
    table: Table
    note: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class ForceChapter:
    """What is said of the accelerometers of one source."""

    device: str
    tables: Sequence[ForceTable]
    lines: Sequence[str]
    excluded: Sequence[str]


def chapters(recorded: Recorded) -> list[ForceChapter]:
    """Return what is said of the accelerometers of each source; none without any."""
    found = recorded.calibration
    return [_chapter(one) for one in found.forces] if found is not None else []


def _chapter(calibration: ForceCalibration) -> ForceChapter:
    """Return the chapter on the accelerometers of one source: tables, delay, gravity, and which are not calibrated.

    The tables are states, effects of the model, places, intrinsic parameters and budget; effects and places only if
    there are any. Without calibrated accelerometers there is none but that of effects. Delay and gravity are lines
    only if they are known.
    """
    tables = []
    if calibration.accelerometers:
        tables = [_states(calibration), _intrinsic(calibration), _budget(calibration)]
        if calibration.placed:
            tables.insert(1, _places(calibration))
    if calibration.effects:
        tables.insert(1, _effects(calibration))
    lines = []
    if calibration.offset is not None:
        late_ms = 1e3 * calibration.offset.offset_s
        wide_ms = COVERAGE * 1e3 * calibration.offset.sd_s
        lines.append(f"Delay after the readings of the table: {late_ms:.3f} ms, U {wide_ms:.3f} ms.")
    if calibration.accelerometers and math.isfinite(calibration.gravity_mps2):
        lines.append(f"Gravity: {calibration.gravity_mps2:.5f} m/s², {calibration.gravity_from}.")
    return ForceChapter(
        device=calibration.device or calibration.source,
        tables=tables,
        lines=[typographic(line) for line in lines],
        excluded=[f"{which}: {reason}" for which, reason in excluded_lines(calibration.excluded)],
    )


def _cells(values: Sequence[float], sds: Sequence[float], figures: Sequence[StateUnit]) -> list[str]:
    """Return each value with its expanded uncertainty, as digits in its unit."""
    cells = []
    for value, sd, figure in zip(values, sds, figures, strict=True):
        cells += [typographic(figure.text(value)), figure.text(COVERAGE * sd)]
    return cells


def _headed(symbol: Markup, figure: StateUnit) -> Markup:
    """Return the head of a column: the symbol of a state and its unit."""
    return Markup("{}, {}").format(symbol, typographic(figure.unit))


def _states(calibration: ForceCalibration) -> ForceTable:
    """Return the table of the states, a row for each accelerometer: each value with its expanded uncertainty."""
    figures = fitted_forces(calibration)
    heads = ["accelerometer"]
    for symbol, figure in zip(SYMBOLS, figures, strict=True):
        heads += [_headed(symbol, figure), "U"]
    rows = [[a.name, *_cells(a.states.tolist(), a.sd.tolist(), figures)] for a in calibration.accelerometers]
    note = "The model is that of the gyros, with the specific force at the place of each as input."
    return ForceTable(caption="States", table=table_of(heads, "l" + 8 * "r", rows), note=note)


def _effects(calibration: ForceCalibration) -> ForceTable:
    """Return a row for each parameter of the effects of the model: name, unit, then value and U by accelerometer."""
    heads = ["effect", "unit"]
    for accelerometer in calibration.accelerometers:
        heads += [accelerometer.name, "U"]
    rows = []
    for row in effect_rows(calibration):
        cells = [row.name, typographic(row.figure.unit)]
        for value, sd in zip(row.values, row.sds, strict=True):
            cells += _cells([value], [sd], [row.figure])
        rows.append(cells)
    note = "These effects were estimated with the states. The constants of the states do not correct them."
    caption = "Effects of the model"
    return ForceTable(
        caption=caption, table=table_of(heads, "ll" + 2 * len(calibration.accelerometers) * "r", rows), note=note
    )


def _places(calibration: ForceCalibration) -> ForceTable:
    """Return a row for each accelerometer, and last for their middle: the place along x, y and z, each with its U."""
    figures = [place_figure(calibration)] * 3
    heads = ["lever arm"]
    for axis in "xyz":
        heads += [f"{axis}, {PLACE.unit}", "U"]
    rows = [[a.name, *_cells(a.place_m.tolist(), a.place_sd_m.tolist(), figures)] for a in calibration.accelerometers]
    rows.append(["middle", *_cells(calibration.arm_m.tolist(), calibration.arm_sd_m.tolist(), figures)])
    caption = "Lever arm, from the point in which the axes of the table meet"
    return ForceTable(caption=caption, table=table_of(heads, "l" + 6 * "r", rows))


def _intrinsic(calibration: ForceCalibration) -> ForceTable:
    """Return a row for each sensitivity, offset and angle between two axes, which another laboratory can reproduce.

    It has the value, U and the unit; three accelerometers have nine rows.
    """
    found = calibration.intrinsic
    rows = []
    for place, name in enumerate(found.names):
        value, sd = float(found.sensitivity[place]), float(found.sensitivity_sd[place])
        rows.append([f"sensitivity of {name}", f"{value:.6f}", f"{COVERAGE * sd:.6f}", "1"])
    for place, name in enumerate(found.names):
        figure = OFFSET.fitted([float(found.offset_sd_mps2[place])])
        own = _cells([float(found.offset_mps2[place])], [float(found.offset_sd_mps2[place])], [figure])
        rows.append([f"offset of {name}", *own, OFFSET.unit])
    for (first, second), angle, sd in zip(found.pairs, found.angle_rad, found.angle_sd_rad, strict=True):
        wide = COVERAGE * float(np.degrees(sd))
        rows.append([f"angle of {first} to {second}", f"{np.degrees(angle):.5f}", f"{wide:.5f}", "°"])
    note = "These do not depend on the mounting. Definitions: Geist et al., J. Res. NIST 122.032 (2017)."
    heads = ["parameter", "value", "U", "unit"]
    return ForceTable(caption="Intrinsic parameters", table=table_of(heads, "lrrl", rows), note=note)


def _budget(calibration: ForceCalibration) -> ForceTable:
    """Return the standard uncertainties of the states by source, rms over the accelerometers, and last the combined.

    The sources are those of the first accelerometer, of which there must be one; where another lacks one it counts as
    0.
    """
    figures = fitted_forces(calibration)
    names = [line.name for line in calibration.accelerometers[0].budget]
    rows = []
    for name in names:
        u = np.sqrt(np.mean([a.line_u(name) ** 2 for a in calibration.accelerometers], axis=0)).tolist()
        rows.append([LINE_WORDS.get(name, name), *(f.text(v) for v, f in zip(u, figures, strict=True))])
    combined = np.sqrt(np.mean([a.sd**2 for a in calibration.accelerometers], axis=0)).tolist()
    rows.append(["combined", *(f.text(v) for v, f in zip(combined, figures, strict=True))])
    heads = [
        "standard uncertainty",
        *(_headed(symbol, figure) for symbol, figure in zip(SYMBOLS, FORCE_FIGURES, strict=True)),
    ]
    return ForceTable(caption="Sources of uncertainty, rms", table=table_of(heads, "lrrrr", rows))
