"""The figures of a calibration on the result screen."""

import math

from rich.text import Text

from station.screen.archive.entries import Whole
from station.screen.panes.lines import TITLE, joined, line
from station.screen.panes.states import StateCell, StatesView, state_lines
from station.views.figures import figures_from, number


def calibrated_text(whole: Whole) -> Text:
    """Return the states with their sigmas, and consistency, samples and noise as far as the recording has them."""
    exceeded = frozenset(
        StateCell(gyro=limit.gyro, state=limit.state, of_sigma=limit.of_sigma) for limit in whole.broken
    )
    view = StatesView(figures=figures_from(whole.entry.units), gyros=whole.entry.gyros, exceeded=exceeded)
    lines = [line(("States and their sigmas", TITLE)), *state_lines(view)]
    if whole.samples is not None:
        nis = number(whole.nis_mean, 3)
        lines.append(line(f"Consistency (NIS): {nis}. Near 1, the stated uncertainties match the scatter."))
        lines.append(line(f"samples: {whole.samples}, {whole.lost} lost"))
    if whole.noise is not None:
        walk_rps, instability_rps = whole.noise
        walk = f"{math.degrees(walk_rps):.3g} deg/s/rtHz"
        instability = f"{math.degrees(instability_rps) * 3600:.2g} deg/h"
        lines.append(line(f"noise: angle random walk {walk}, bias instability < {instability}"))
    return joined(lines)
