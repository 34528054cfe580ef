"""A script that a search found, as a person reads it."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from rich.markup import escape
from rich.table import Table

from drivers.types import Floats
from station.bench.units import Units
from station.render.terminal import Shown, line, print_all, rich_table, stdout
from station.views.accelerometers.result import FORCE_FIGURES, PLACE
from station.views.figures import UNKNOWN, StateUnit, state_figures
from station.views.improved import Improved

_FOR_COMPARISON = "required: for comparison only; with --for the sigmas are made as small as possible"


def print_improved(improved: Improved, path: Path, units: Units) -> None:
    """Print the script found, in the file ``path``, and its sigmas in these units."""
    print_all(stdout(), _shown(improved, path, units))


def _shown(improved: Improved, path: Path, units: Units) -> Iterator[Shown]:
    """Yield durations before and after, predicted sigmas, the steps of the script found, the search, and its file."""
    yield line(_durations(improved))
    yield _sigmas(improved, units), {}
    if improved.accelerometers:
        yield _force_sigmas(improved), {}
    if improved.wanted.total_s is not None:
        yield _FOR_COMPARISON, {"style": "dim"}
    for number, timed in enumerate(improved.found.script.timeline(), 1):
        yield line(escape(f"{number:3d}  {timed.span.least_s:7.2f} s  {timed.step.label}"))
    yield line(_search(improved))
    yield f"script: {path}   (station run --script {path})", {"highlight": False, "soft_wrap": True}


def _durations(improved: Improved) -> str:
    before = f"{improved.before.least_s:.1f} s ({escape(improved.before.name)})"
    pauses = f"{improved.with_sequencer_s:.1f} s including the pauses of the sequencer"
    return f"[bold]{improved.found.script.least_s:.1f} s[/] instead of {before}; {pauses}"


def _search(improved: Improved) -> str:
    poses = f", {improved.wanted.poses} poses or more" if improved.accelerometers else ""
    return (
        f"[dim]rests of {improved.wanted.rest_s:g} s or more at both ends separate noise from motion{poses}; "
        f"{improved.found.compared} combinations of turns compared in {improved.search_s:.1f} s[/]"
    )


def _sigmas(improved: Improved, units: Units) -> Table:
    """Return the table of required and reached sigmas by gyro."""
    title = "Sigmas of the states, required and reached"
    return _table(title, "gyro", improved.gyros, state_figures(units), improved.wanted.sd, improved.found.sd)


def _force_sigmas(improved: Improved) -> Table:
    """Return the table of required and reached sigmas of states and place by accelerometer."""
    places = [replace(PLACE, name=axis) for axis in "xyz"]
    title = "Sigmas of accelerometers and their places, required and reached"
    figures = (*FORCE_FIGURES, *places)
    return _table(title, "sensor", improved.accelerometers, figures, improved.wanted.force_sd, improved.found.force_sd)


def _table(
    title: str,
    kind: str,
    rows: Sequence[tuple[str, str]],
    figures: Sequence[StateUnit],
    required: Floats,
    reached: Floats,
) -> Table:
    """Return the table of required and reached sigmas (n, c) of n sensors (device, name), in the units of ``figures``.

    ``kind`` heads the column of names, which has the device only if there are several. A required sigma that is
    infinite is a dash.
    """
    heads = [kind]
    for figure in figures:
        heads += [f"{figure.name}\n{figure.unit}", "\nreached"]
    table = rich_table(title, heads, "l" + "dr" * len(figures))
    several = len({device for device, _ in rows}) > 1
    for row, (device, name) in enumerate(rows):
        cells = [escape(f"{device} {name}" if several else name)]
        for column, figure in enumerate(figures):
            cells.append(_required(float(required[row, column]) * figure.factor))
            cells.append(f"{float(reached[row, column]) * figure.factor:.4g}")
        table.add_row(*cells)
    return table


def _required(sd: float) -> str:
    return UNKNOWN if sd == math.inf else f"{sd:.4g}"
