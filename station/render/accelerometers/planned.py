"""What a script will show of accelerometers, as a person reads it."""

import math
from collections.abc import Sequence

from rich.markup import escape
from rich.table import Table

from estimator.estimation.accelerometers.force_effects import BY_NAME
from station.bench.bench import ForceLimits
from station.opening.planned_forces import PlannedForces
from station.render.terminal import Shown, print_all, rich_table, stdout
from station.views.accelerometers.planned import DETECTED
from station.views.accelerometers.result import PLACE, fitted_forces, place_figure
from station.views.figures import number


def print_planned_forces(planned: Sequence[PlannedForces], limits: ForceLimits) -> None:
    """Print the predicted sigmas of the accelerometers of each device beside what the bench requires, and effects.

    Of effects it is the smallest size that a run would detect. Effects that are not shown and notes follow as lines. A
    device without calibrated accelerometers has these lines alone.
    """
    for one in planned:
        shown: list[Shown] = [(_sigmas(one, limits), {}), (_effects(one), {})] if one.calibration.accelerometers else []
        shown += [(escape(line), {"highlight": False}) for line in (*_not_shown(one), *one.notes)]
        print_all(stdout(), shown)


def _sigmas(planned: PlannedForces, limits: ForceLimits) -> Table:
    """Return the predicted sigmas of states and places by accelerometer.

    Further rows have those of their middle, the lever arm, if that is limited, and what the bench requires, if
    anything, with "-" where it requires nothing.
    """
    figures, place = fitted_forces(planned.calibration), place_figure(planned.calibration)
    heads = ["\nsensor", *(f"± {f.name}\n{f.unit}" for f in figures), *(f"± {axis}\n{PLACE.unit}" for axis in "xyz")]
    rows = []
    for accelerometer in planned.calibration.accelerometers:
        cells = [escape(accelerometer.name)]
        cells += [figure.text(sd) for figure, sd in zip(figures, accelerometer.sd.tolist(), strict=True)]
        cells += [place.text(sd) for sd in accelerometer.place_sd_m.tolist()]
        rows.append(cells)
    if math.isfinite(limits.sd_arm_m):
        rows.append(["middle", *[""] * len(figures), *map(place.text, planned.calibration.arm_sd_m.tolist())])
    required = (*zip(figures, limits.sds, strict=True), *[(place, limits.sd_arm_m)] * 3)
    if limits.requires_sigmas:
        rows.append(["required", *(f.text(sd) if math.isfinite(sd) else "-" for f, sd in required)])
    title = f"Predicted standard deviations of the accelerometers of {escape(planned.device)}"
    return rich_table(title, heads, "l" + 7 * "r", rows)


def _effects(planned: PlannedForces) -> Table:
    """Return a row for each parameter of each effect: smallest size that a run detects, largest plausible one, unit.

    "not shown" where the former is not the smaller. Sizes are rms over the accelerometers.
    """
    rows = []
    for name, sd in planned.effects.items():
        effect = BY_NAME[name]
        for parameter, own in zip(effect.parameters, sd.tolist(), strict=True):
            least = DETECTED * own
            label = name.replace("_", " ") if len(effect.parameters) == 1 else f"{name.replace('_', ' ')}, {parameter}"
            shown = least < effect.largest
            size = f"{least * effect.shown:.3g}" if shown else "not shown"
            rows.append([label, size, number(effect.largest * effect.shown, 0), effect.shown_unit])
    heads = ["effect", "smallest detected", "largest plausible", "unit"]
    return rich_table("Effects of accelerometers, each alone, at 1 % false alarms", heads, "lrrl", rows)


def _not_shown(planned: PlannedForces) -> list[str]:
    """Return a sentence on each effect with a parameter that a run would not detect at its largest plausible size.

    It says what would show the effect.
    """
    lines = []
    for name, sd in planned.effects.items():
        effect = BY_NAME[name]
        if DETECTED * float(sd.max()) >= effect.largest:
            lines.append(f"{name.replace('_', ' ')} is not shown. It needs {effect.shown_by}")
    return lines
