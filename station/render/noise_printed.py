"""Noise of sensors at rest as a person reads it: N, B and K with intervals, and the Allan deviation."""

from collections.abc import Sequence
from itertools import groupby

import numpy as np
from rich.markup import escape
from rich.table import Table

from estimator.observations.allan.sensor import SensorNoise
from estimator.observations.allan.spectrum import TERMS
from station.render.terminal import Shown, print_all, rich_table, stdout
from station.views.noise import digits, filter_notes, length_words, lengths_s, noise_unit, term_words, warnings_of

_ROWS = 10  # of the table of Allan deviations
_COLUMNS = 3  # sensors side by side in it: 80 characters hold no more


def print_noise(noises: Sequence[SensorNoise], share: float) -> None:
    """Print the noise of sensors with a common unit, and the length to record to know it to ``share``.

    Allan deviations, notes and warnings follow; neighbouring sensors with equal averaging times share a table. There
    must be one sensor or more.
    """
    unit, _ = noise_unit(noises[0].unit, 1)
    shown: list[Shown] = [
        (noise_table(f"Noise at rest with intervals of 95 %, {_rest(noises)}", noises), {}),
        (_lengths(noises, share), {}),
    ]
    for _, alike in groupby(noises, key=lambda noise: noise.curve.tau_s.tolist()):
        of_one_grid = list(alike)
        for start in range(0, len(of_one_grid), _COLUMNS):
            shown.append(
                (_deviations(f"Overlapping Allan deviation, {unit}", of_one_grid[start : start + _COLUMNS]), {})
            )
    shown += [(escape(f"note: {note}"), {"highlight": False}) for note in filter_notes(noises)]
    shown += [(escape(f"warning: {warning}"), {"highlight": False}) for warning in warnings_of(noises)]
    print_all(stdout(), shown)


def _rest(noises: Sequence[SensorNoise]) -> str:
    """Return how long sensors rested: the shortest of all rests, and the shortest of the longest without a gap."""
    span_s = min(noise.span_s for noise in noises)
    longest_s = min(noise.longest_s for noise in noises)
    text = f"{span_s:.0f} s of rest"
    return text if longest_s >= 0.99 * span_s else f"{text}, the longest {longest_s:.0f} s"


def noise_table(title: str, noises: Sequence[SensorNoise]) -> Table:
    """Return the table of N, B and K of sensors with a common unit, a row for each sensor, with intervals of 95 %."""
    units = [noise_unit(noises[0].unit, term) for term in range(len(TERMS))]
    heads = ["sensor", *(f"{name}, {unit}" for name, (unit, _) in zip(TERMS, units, strict=True))]
    rows = []
    for noise in noises:
        cells = [term_words(noise.terms[name], factor) for name, (_, factor) in zip(TERMS, units, strict=True)]
        rows.append([escape(noise.name), *cells])
    return rich_table(title, heads, "lr", rows)


def _lengths(noises: Sequence[SensorNoise], share: float) -> Table:
    """Return the table of the lengths of rest that give each term a standard uncertainty of ``share``."""
    rows = []
    for noise in noises:
        lengths = zip(TERMS, lengths_s(noise, share), strict=True)
        cells = [length_words(length, seen=noise.terms[name].seen) for name, length in lengths]
        rows.append([escape(noise.name), *cells])
    title = f"Length of one rest for a standard uncertainty of {share * 100:.3g} %"
    return rich_table(title, ["sensor", *TERMS], "lr", rows)


def _deviations(title: str, noises: Sequence[SensorNoise]) -> Table:
    """Return a table of Allan deviations with intervals, one column per sensor, in the unit shown.

    The sensors must have the same averaging times, of which it shows ten or fewer.
    """
    _, factor = noise_unit(noises[0].unit, 1)
    tau_s = noises[0].curve.tau_s
    rows = []
    for row in np.unique(np.linspace(0, len(tau_s) - 1, _ROWS).round().astype(int)).tolist():
        cells = [digits(tau_s[row])]
        for noise in noises:
            curve = noise.curve
            low, high = digits(curve.low[row] * factor), digits(curve.high[row] * factor)
            cells.append(f"{digits(curve.deviation[row] * factor)} ({low} to {high})")
        rows.append(cells)
    return rich_table(title, ["s", *(escape(noise.name) for noise in noises)], "r", rows)
