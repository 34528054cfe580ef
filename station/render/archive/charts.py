"""Control charts of a device in the terminal: limits, the last value, and in which zone each run lies."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from rich.markup import escape
from rich.table import Table

from station.render.terminal import Shown, line, rich_table, title
from station.views.figures import StateUnit, figures_from
from station.views.history import ChartView, HistoryRow

_HEADS = ("gyro", "mean", "lower", "upper", "last", "EWMA", "±", "runs, latest on the right")
_ENOUGH_RUNS = 20
_MOST_ZONES = 40
_ZONES = "CBA"
_OUTSIDE_ZONE = "!"
_OUTSIDE = "outside the limits of single runs"
_EWMA_OUTSIDE = "the moving average is outside its limits"
_PROVISIONAL = "limits of fewer than 20 runs are provisional"
_NO_CHART = "no control chart: it needs two comparable calibrations that did not fail"
_LEGEND = (
    "lower and upper: mean ± 2.66 mean moving ranges; EWMA: lambda 0.2, L 3 (Montgomery; ISO 7870-2, -6). "
    "Zones: C within one third of the limits, B within two thirds, A within the limits, ! outside; "
    "lower case: below the mean"
)


@dataclass(kw_only=True, frozen=True, slots=True)
class _Place:
    """One state of one gyro in a chart, by their places, with the name of the gyro and the unit of the state."""

    gyro: int
    state: int
    name: str
    figure: StateUnit


def history_shown(
    folder: str, recordings: Sequence[HistoryRow], count: int, serial: str | None, charts: Sequence[ChartView]
) -> Iterator[Shown]:
    """Yield how many recordings of the ``count`` in the folder are listed, which are unreadable, and a device's charts.

    ``serial`` is that of the device, None if no charts were asked for. A line says why there are none, or below them
    what their columns mean.
    """
    more = "; --last N shows more, --csv and --json show all" if count > len(recordings) else ""
    yield line(escape(f"{len(recordings)} of {count} recordings in {folder}, newest first{more}"))
    for row in recordings:
        if row.wrong:
            yield line(escape(f"{row.file}: {row.wrong}"))
    if serial is not None and not charts:
        yield line(_NO_CHART)
    for chart in charts:
        yield line("")
        yield from _chart(serial, chart)
    if charts:
        yield line(_LEGEND)


def _chart(serial: str | None, view: ChartView) -> Iterator[Shown]:
    """Yield the control chart of a device: a title, a table for each state, and a line for each run out of limits.

    The last line says that the limits are provisional if there are few runs.
    """
    failed = list(view.counted).count(False)
    counts = f"{len(view.files)} runs of {view.script or 'no script'} on {view.bench or 'no bench'}"
    unused = f", {failed} FAIL not used for the limits" if failed else ""
    yield title(f"Control charts of {serial}: {counts}{unused}")
    marks: list[str] = []
    for state, figure in enumerate(figures_from(view.units)):
        places = [_Place(gyro=row, state=state, name=name, figure=figure) for row, name in enumerate(view.gyros)]
        yield _table(view, figure, places), {}
        marks += [mark for place in places for mark in _marks(view, place)]
    for mark in marks:
        yield line(escape(mark))
    if len(view.files) < _ENOUGH_RUNS:
        yield line(_PROVISIONAL)


def _table(view: ChartView, figure: StateUnit, places: Sequence[_Place]) -> Table:
    rows = [_row(view, place) for place in places]
    return rich_table(f"{figure.name} ({figure.unit})", _HEADS, "lrrrrrrr", rows)


def _row(view: ChartView, place: _Place) -> list[str]:
    """Return eight texts: name of a gyro, mean, lower and upper limit, last value, moving average, its limit, zones.

    Values are of one state, in the unit of ``place.figure``; the zones are a letter for each of the latest 40 runs.
    """
    chart = view.chart
    at = place.gyro, place.state
    low, high = chart.limits
    values = [
        chart.mean[at],
        low[at],
        high[at],
        chart.values[-1][at],
        chart.ewma[-1][at],
        chart.ewma_limits[-1][at],
    ]
    zones = "".join(_zone(view, place, run) for run in range(len(view.files)))
    return [escape(place.name), *(place.figure.text(float(value)) for value in values), zones[-_MOST_ZONES:]]


def _zone(view: ChartView, place: _Place, run: int) -> str:
    """Return the letter of the zone in which a run lies: from the mean "C", "B", "A", a third of the limit each.

    It is in lower case below the mean and on it, and "!" outside the limits.
    """
    chart = view.chart
    at = place.gyro, place.state
    if chart.outside[run][at]:
        return _OUTSIDE_ZONE
    mean = float(chart.mean[at])
    half = float(chart.limits[1][at]) - mean
    thirds = (float(chart.values[run][at]) - mean) / (half / 3) if half > 0 else 0.0
    letter = _ZONES[min(int(abs(thirds)), len(_ZONES) - 1)]
    return letter if thirds > 0 else letter.lower()


def _marks(view: ChartView, place: _Place) -> Iterator[str]:
    """Yield a line for each run whose state is outside the limits, or else whose moving average is."""
    at = place.gyro, place.state
    for run, (when, file) in enumerate(zip(view.when, view.files, strict=True)):
        what = ""
        if view.chart.outside[run][at]:
            what = _OUTSIDE
        elif view.chart.ewma_outside[run][at]:
            what = _EWMA_OUTSIDE
        if what:
            yield f"! {place.figure.name} ({place.figure.unit}) of {place.name}, {when}: {what} ({file})"
