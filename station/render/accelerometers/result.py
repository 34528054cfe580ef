"""The calibration of accelerometers as a person reads it: states, places, and what another laboratory compares."""

import math
from collections.abc import Sequence

import numpy as np
from rich.markup import escape
from rich.table import Table

from estimator.calibration.accelerometer import ForceCalibration
from station.render.terminal import Shown, print_all, rich_table, stdout
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
from station.views.figures import StateUnit, number


def print_forces(forces: Sequence[ForceCalibration], *, details: bool) -> None:
    """Print the accelerometers of each source, and which are not calibrated.

    Places, effects, delay and gravity are printed if they are known. With ``details`` also the sources of uncertainty
    and what does not depend on the mounting. A source without calibrated accelerometers has none of these.
    """
    for one in forces:
        shown: list[Shown] = []
        if one.accelerometers:
            shown.append((_states_table(one), {}))
            if one.placed:
                shown.append((_places_table(one), {}))
            if one.effects:
                shown.append((_effects_table(one), {}))
            shown += [(line, {"highlight": False}) for line in _lines(one)]
        shown += [
            (f"[red]{escape(which)}:[/red] {escape(reason)}", {"highlight": False})
            for which, reason in excluded_lines(one.excluded)
        ]
        if details and one.accelerometers:
            shown.append((_intrinsic_table(one), {}))
            shown.append((_budget_table(one), {}))
        print_all(stdout(), shown)


def _states_table(calibration: ForceCalibration) -> Table:
    """Return a row for each accelerometer: its states with their standard deviations."""
    figures = fitted_forces(calibration)
    heads = ["\nsensor"]
    for figure in figures:
        heads += [f"{figure.name}\n{figure.unit}", "±"]
    rows = []
    for accelerometer in calibration.accelerometers:
        cells = [escape(accelerometer.name)]
        for figure, value, sd in zip(figures, accelerometer.states.tolist(), accelerometer.sd.tolist(), strict=True):
            cells += [figure.text(value), figure.text(sd)]
        rows.append(cells)
    return rich_table(
        f"Accelerometers of {calibration.device or calibration.source} and their standard deviations", heads, "lr", rows
    )


def _places_table(calibration: ForceCalibration) -> Table:
    """Return where each accelerometer sits, and last their middle, with standard deviations."""
    figure = place_figure(calibration)
    rows = [_place_row(a.name, a.place_m.tolist(), a.place_sd_m.tolist(), figure) for a in calibration.accelerometers]
    rows.append(_place_row("middle", calibration.arm_m.tolist(), calibration.arm_sd_m.tolist(), figure))
    heads = ["\nlever arm"]
    for axis in "xyz":
        heads += [f"{axis}\n{PLACE.unit}", "±"]
    return rich_table("Places from where the axes of the table meet", heads, "lr", rows)


def _effects_table(calibration: ForceCalibration) -> Table:
    """Return a row for each parameter of the effects of the model: name, unit, then value and sd by accelerometer."""
    heads = ["\neffect", "\nunit"]
    for accelerometer in calibration.accelerometers:
        heads += [f"{escape(accelerometer.name)}\nvalue", "±"]
    rows = []
    for row in effect_rows(calibration):
        cells = [row.name, row.figure.unit]
        for value, sd in zip(row.values, row.sds, strict=True):
            cells += [row.figure.text(value), row.figure.text(sd)]
        rows.append(cells)
    return rich_table("Effects of the model", heads, "ll" + 2 * len(calibration.accelerometers) * "r", rows)


def _place_row(name: str, place_m: Sequence[float], sd_m: Sequence[float], figure: StateUnit) -> list[str]:
    """Return the cells of a row: a name, and each component with its standard deviation."""
    cells = [escape(name)]
    for value, sd in zip(place_m, sd_m, strict=True):
        cells += [figure.text(value), figure.text(sd)]
    return cells


def _lines(calibration: ForceCalibration) -> list[str]:
    """Return sentences on the delay and the gravity, if they are known."""
    lines = []
    if calibration.offset is not None:
        late_ms = 1e3 * calibration.offset.offset_s
        wide_ms = 1e3 * calibration.offset.sd_s
        lines.append(f"delay: {late_ms:.3f} ± {wide_ms:.3f} ms after the readings of the table")
    if math.isfinite(calibration.gravity_mps2):  # recordings of several places have several
        lines.append(f"gravity: {calibration.gravity_mps2:.5f} m/s2, {calibration.gravity_from}")
    return lines


def _intrinsic_table(calibration: ForceCalibration) -> Table:
    """Return a row for each sensitivity, offset and angle, with standard deviation and unit.

    Sensitivity and offset of an accelerometer stand together; the angles come last. The mounting changes none of them.
    """
    found = calibration.intrinsic
    rows = []
    for place, name in enumerate(found.names):
        sensitivity = (found.sensitivity[place], found.sensitivity_sd[place])
        offset = (found.offset_mps2[place] * OFFSET.factor, found.offset_sd_mps2[place] * OFFSET.factor)
        rows.append([f"sensitivity of {escape(name)}", f"{sensitivity[0]:.6f}", f"{sensitivity[1]:.6f}", "1"])
        rows.append([f"offset of {escape(name)}", f"{offset[0]:.4f}", f"{offset[1]:.4f}", OFFSET.unit])
    for (first, second), angle, sd in zip(found.pairs, found.angle_rad, found.angle_sd_rad, strict=True):
        name = f"angle of {escape(first)} to {escape(second)}"
        rows.append([name, f"{np.degrees(angle):.5f}", f"{np.degrees(sd):.5f}", "deg"])
    return rich_table("Intrinsic parameters (Geist et al. 2017)", ["parameter", "value", "±", "unit"], "lrrl", rows)


def _budget_table(calibration: ForceCalibration) -> Table:
    """Return the standard uncertainties of the states by source, rms over the accelerometers, and last the combined.

    The sources are those of the first accelerometer; where another lacks one it counts as 0.
    """
    figures = fitted_forces(calibration)
    names = [line.name for line in calibration.accelerometers[0].budget]
    rows = []
    for name in names:
        u = np.sqrt(np.mean([a.line_u(name) ** 2 for a in calibration.accelerometers], axis=0)).tolist()
        rows.append(
            [LINE_WORDS.get(name, name), *(number(v * f.factor, f.digits) for v, f in zip(u, figures, strict=True))]
        )
    combined = np.sqrt(np.mean([a.sd**2 for a in calibration.accelerometers], axis=0)).tolist()
    rows.append(["combined", *(number(v * f.factor, f.digits) for v, f in zip(combined, figures, strict=True))])
    heads = ["\nsource of uncertainty", *(f"{f.name}\n{f.unit}" for f in FORCE_FIGURES)]
    return rich_table("Sources of the standard deviations, rms over the accelerometers", heads, "lr", rows)
