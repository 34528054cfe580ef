"""The figures of a calibration on the result screen."""

import math

from rich.text import Text

from station.screen.archive.entries import ReadRecording
from station.screen.panes.lines import TITLE, joined, line
from station.screen.panes.states import StateCell, StatesView, state_lines
from station.views.figures import figures_from, number


def calibrated_text(recording: ReadRecording) -> Text:
    """Return, below a heading, the states with their sigmas, exceeded ones in red; NIS, samples and noise if known."""
    exceeded = frozenset(
        StateCell(gyro=limit.gyro, state=limit.state, of_sigma=limit.of_sigma) for limit in recording.broken
    )
    view = StatesView(figures=figures_from(recording.entry.units), gyros=recording.entry.gyros, exceeded=exceeded)
    lines = [line(("States and their sigmas", TITLE)), *state_lines(view)]
    if recording.samples is not None:
        nis = number(recording.nis_mean, 3)
        lines.append(line(f"Consistency (NIS): {nis}. Near 1, the stated uncertainties match the scatter."))
        lines.append(line(f"samples: {recording.samples}, {recording.lost} lost"))
    if recording.noise is not None:
        walk_rps, instability_rps = recording.noise
        walk = f"{math.degrees(walk_rps):.3g} deg/s/rtHz"
        instability = f"{math.degrees(instability_rps) * 3600:.2g} deg/h"
        lines.append(line(f"noise: angle random walk {walk}, bias instability < {instability}"))
    return joined(lines)
