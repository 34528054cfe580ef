"""Gauge studies of a station in the terminal."""

from collections.abc import Iterator, Sequence

from rich.markup import escape
from rich.table import Table

from estimator.geometry.model import STATES
from station.render.terminal import Shown, line, rich_table, template_lines, title
from station.views.figures import UNKNOWN, StateUnit, figures_from, number
from station.views.history import GaugeStudy, GaugeView

_HEADS = ("", "repeat.", "reprod.", "devices", "%GRR", "sd / sigma (95 %)")
_NO_RUN = "can be used: a study needs calibrations with a serial number that did not end MANUAL, ABORTED or FAULT"
_TOO_FEW = "not enough data: the study needs two or more devices, each run twice by one operator on one bench; found"
_NOT_REPRODUCED = (
    "reproducibility is unknown and not in %GRR: it needs two operators or benches that ran the same device"
)


def gauge_shown(folder: str, studies: Sequence[GaugeView]) -> Iterator[Shown]:
    """Yield the studies of the runs in a folder, with an explanation of their columns.

    A line says so if there is no run, if too few devices were measured repeatedly, or if runs lack operator or bench.
    """
    if not studies:
        yield line(f"no run in {escape(folder)} {_NO_RUN}")
    for view in studies:
        yield line("")
        yield title(_title(view))
        yield from _unstated(view)
        if view.study is None:
            yield line(f"{_TOO_FEW} {view.repeated}")
        else:
            yield from _study(view.study, figures_from(view.units))
    if any(view.study for view in studies):
        yield line("")
        yield from template_lines("station.render", "gauge.rich", {})


def _title(view: GaugeView) -> str:
    """Return the script and the numbers of runs, devices, operators, benches and, if any, FAIL in a gauge study."""
    counts = [
        f"{_counted(view.runs, 'run')} of {_counted(view.devices, 'device')}",
        _counted(len(view.operators), "operator"),
        _counted(len(view.benches), "bench", "benches"),
    ]
    if view.failed:
        counts.append(f"including {view.failed} FAIL")
    return f"Gauge study of {view.script or 'no script'}: {', '.join(counts)}"


def _counted(count: int, noun: str, plural: str = "") -> str:
    return f"{count} {noun}" if count == 1 else f"{count} {plural or f'{noun}s'}"


def _unstated(view: GaugeView) -> Iterator[Shown]:
    """Yield a line if runs lack an operator or a bench."""
    for what, names in (("operator", view.operators), ("bench", view.benches)):
        if "" in names:
            yield line(f"runs without a stated {what} are included and count as one {what}")


def _study(study: GaugeStudy, figures: Sequence[StateUnit]) -> Iterator[Shown]:
    yield _table(study, figures), {}
    wide = [figure.name for state, figure in zip(STATES, figures, strict=True) if _scatters(study, state)]
    if wide:
        yield line(f"! scatters more than its sigmas predict: {', '.join(wide)}")
    if all(value is None for value in study.reproducibility.values()):
        yield line(_NOT_REPRODUCED)


def _table(study: GaugeStudy, figures: Sequence[StateUnit]) -> Table:
    """Return a row for each state: repeatability, reproducibility, spread of devices, GRR, and ratio with interval."""
    table = rich_table(None, _HEADS, "lr")
    for state, figure in zip(STATES, figures, strict=True):
        ratio, low, high = study.ratio[state], study.ratio_low[state], study.ratio_high[state]
        table.add_row(
            f"{figure.name} ({figure.unit})",
            _size(study.repeatability[state], figure.factor),
            _size(study.reproducibility[state], figure.factor),
            _size(study.parts[state], figure.factor),
            _percent(study.grr[state]),
            f"{_size(ratio)} ({_size(low)} to {_size(high)})",
        )
    return table


def _scatters(study: GaugeStudy, state: str) -> bool:
    """Return whether the scatter of a state is larger than its sigmas predict, beyond chance."""
    low = study.ratio_low[state]
    return low is not None and low > 1


def _size(value: float | None, factor: float = 1.0) -> str:
    """Return ``value`` times ``factor`` with fewer decimals the larger it is; a dash for None."""
    if value is None:
        return UNKNOWN
    size = value * factor
    if size >= 100:
        return number(size, 0)
    return number(size, 1 if size >= 10 else 2)


def _percent(share: float | None) -> str:
    return UNKNOWN if share is None else f"{_size(share, 100)} %"
