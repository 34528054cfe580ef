"""The charts of a run, each a record: a new one is a line in ``_CHARTS``."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

from station.run.snapshot import AccelerometerSnapshot, AxisSnapshot, GyroSnapshot, Snapshot
from station.screen.drawings import STATE_CHARTS, Curve, Drawing, StateLimit, levels, state_drawing
from station.screen.sessions.live_run import LiveRun, Trend
from station.views.accelerometers.result import LIVE_FORCE_FIGURES
from station.views.figures import number

Sensor = GyroSnapshot | AccelerometerSnapshot

_SIGMAS = 2.0
_DEG = math.degrees(1)
_SERIES = "series"  # how the names of charts of series begin
_AXIS_STYLES = ("first", "second", "third")
_ARC_PARTS, _GIMBALS_APART = 24, 0.3
_UNSEEN = GyroSnapshot("", "", (), ())


@dataclass(kw_only=True, frozen=True, slots=True)
class RunChart:
    """A chart of a run: its name, and what draws it for a sensor; a ``dial`` shows the present, not a course."""

    name: str
    draw: Callable[[LiveRun, Sensor], Drawing]
    dial: bool = False


def run_drawing(name: str, run: LiveRun, sensor: Sensor) -> Drawing | None:
    """Return a chart of a run, one of ``RUN_CHARTS`` or ``series_charts``, with its steps marked except on a dial.

    None for a series of a device that this run does not have. ``run.seen`` must not be empty.
    """
    chart = _BY_NAME.get(name)
    if chart is not None and chart.dial:
        return chart.draw(run, sensor)
    found = _series_drawing(name, run) if chart is None else chart.draw(run, sensor)
    return None if found is None else found._replace(marks=run.steps_begin_s, span=(0.0, run.seen[-1].elapsed_s))


def series_charts(snapshot: Snapshot) -> list[str]:
    """Return the names of the charts of devices' series, one for each column."""
    return [f"{_SERIES}{at}" for at in range(len(snapshot.series))]


def _series_drawing(name: str, run: LiveRun) -> Drawing | None:
    """Return a column of a device's series over time, NaN in snapshots without it; None if the newest has none.

    ``name`` is one of ``series_charts``.
    """
    seen = run.seen
    names = series_charts(seen[-1])
    if name not in names:
        return None
    at = names.index(name)
    newest = seen[-1].series[at]
    values = [s.series[at].value if at < len(s.series) else math.nan for s in seen]
    words = [(f"{newest.column} ({newest.unit})", ""), (number(newest.value, 2), "line"), (newest.device, "")]
    return Drawing(words, [Curve(_times_s(run), values)])


def _times_s(run: LiveRun) -> list[float]:
    return [snapshot.elapsed_s for snapshot in run.seen]


def _courses(run: LiveRun, sensor: Sensor) -> list[Sensor]:
    """Return a sensor in each snapshot, without figures where it is missing."""
    names = sensor.full_name
    return [next((each for each in s.sensors if each.full_name == names), _UNSEEN) for s in run.seen]


def _name(run: LiveRun, sensor: Sensor) -> str:
    return run.seen[-1].called(sensor)


def _output(run: LiveRun, sensor: Sensor) -> Drawing:
    """Return the output of a sensor over time, beside the one expected of it by the table, if that is ever known.

    Rates are in deg/s, forces in m/s2; NaN in snapshots without the sensor.
    """
    times = _times_s(run)
    courses = _courses(run, sensor)
    what, factor = ("rate (deg/s)", _DEG) if isinstance(sensor, GyroSnapshot) else ("specific force (m/s2)", 1.0)
    words = [(what, ""), (_name(run, sensor), "line")]
    curves = [Curve(times, [each.output * factor for each in courses])]
    expected = [each.expected * factor for each in courses]
    if any(map(math.isfinite, expected)):
        words.append(("by the table", "first"))
        curves.insert(0, Curve(times, expected, "first"))
    return Drawing(words, curves)


def _residual(run: LiveRun, sensor: Sensor) -> Drawing:
    residual = Curve(_times_s(run), [each.residual for each in _courses(run, sensor)])
    words = [("residual (sigmas)", ""), (_name(run, sensor), "line"), ("95 %", "band")]
    return Drawing(words, [*levels((_SIGMAS, -_SIGMAS), "band"), residual], (-2 * _SIGMAS, 2 * _SIGMAS))


def _nis(run: LiveRun, sensor: Sensor) -> Drawing:
    """Return the mean NIS of the last half minute over time, with the 95 % band in which it stays by chance.

    For a gyro it is that of all gyros, with the limits of the bench if there are any; for an accelerometer that of the
    accelerometers of its source, without limits. NaN where it is not known.
    """
    times = _times_s(run)
    of_gyros = isinstance(sensor, GyroSnapshot)
    values = [(s.nis_recent, s.recent) if of_gyros else _nis_of_forces(s, sensor.source) for s in run.seen]
    reach = [_SIGMAS * math.sqrt(2 / count) if count else math.nan for _, count in values]
    band = [Curve(times, [1 + sign * r for r in reach], "band") for sign in (1, -1)]
    limits = run.limits.nis if of_gyros else ()
    nis = Curve(times, [value for value, _ in values])
    words = [("NIS (30 s)", ""), (number(values[-1][0], 2), "line"), ("95 %", "band")]
    if limits:
        words.append(("limits", "limit"))
    if not of_gyros:
        words.append(("accelerometers", ""))
    return Drawing(words, [*band, *levels(limits, "limit"), nis], (0.5, 1.5))


def _nis_of_forces(snapshot: Snapshot, source: str) -> tuple[float, int]:
    """Return the mean NIS of the accelerometers of a source over the last half minute, and of how many innovations."""
    return next(((arm.nis_recent, arm.recent) for arm in snapshot.arms if arm.source == source), (math.nan, 0))


def _temperature(run: LiveRun, sensor: Sensor) -> Drawing:
    """Return the temperature of the source of a sensor."""
    degc = [next((u.temperature_c for u in s.sources if u.name == sensor.source), math.nan) for s in run.seen]
    words = [("temperature (degC)", ""), (number(degc[-1], 1), "line"), (sensor.source, "")]
    return Drawing(words, [Curve(_times_s(run), degc)])


def _state(index: int, run: LiveRun, sensor: Sensor) -> Drawing:
    """Return the chart of the live estimate of state number ``index`` of a gyro or accelerometer, with its limit.

    Without an estimate there is only a title, which has the name of an accelerometer.
    """
    limits = run.limits
    trend = run.trends.get(sensor.full_name) or Trend()
    if not isinstance(sensor, GyroSnapshot):
        limit = StateLimit(limits.force_sizes[index], limits.force_written[index])
        drawing = state_drawing(index, trend, limit, figures=LIVE_FORCE_FIGURES)
        return drawing._replace(words=[drawing.words[0], (_name(run, sensor), ""), *drawing.words[1:]])
    limit = StateLimit(limits.sizes[index], limits.written[index])
    return state_drawing(index, trend, limit, figures=limits.figures)


def _axes(run: LiveRun, sensor: Sensor) -> Drawing:
    """Return a dial of the gimbals, outermost outside, each with a hand at its angle, zero on top.

    One that turns has an arc to its target, if that is known, and is named first.
    """
    snapshot = run.snapshot or run.seen[-1]
    styles = dict(zip(sorted(axis.name for axis in snapshot.axes), _AXIS_STYLES, strict=False))
    curves: list[Curve] = []
    words: list[tuple[str, str]] = []
    for place, axis in enumerate(snapshot.axes):
        turns = axis.state == "turning" and not run.at_rest
        curves += _axis_curves(axis, 1.0 - place * _GIMBALS_APART, styles[axis.name], turns=turns)
        position = _axis_words(axis, styles[axis.name], turns=turns)
        words = [*position, *words] if turns else [*words, *position]
    return Drawing([("axes", ""), *words], curves, dial=True)


def _axis_words(axis: AxisSnapshot, style: str, *, turns: bool) -> list[tuple[str, str]]:
    """Return the angle of an axis and, if it turns to a target, that and its rate."""
    words = [(f"{axis.name} {number(axis.angle_rad * _DEG, 1)}°", style)]
    if turns and math.isfinite(axis.target_rad):
        words.append((f"to {number(axis.target_rad * _DEG, 0)}°", "line"))
        words.append((f"{number(axis.rate_rps * _DEG, 1)}°/s", style))
    return words


def _axis_curves(axis: AxisSnapshot, radius: float, style: str, *, turns: bool) -> list[Curve]:
    """Return the circle of a gimbal with ``radius``, an arc to the target of one that ``turns``, and its hand.

    The hand is in ``style``, the circle too if it turns. The arc is at most one turn long, and missing if the target is
    not known.
    """
    at = axis.angle_rad
    curves = [_arc(radius, 0.0, 2 * math.pi, style if turns else "mark")]
    if turns and math.isfinite(axis.target_rad):
        end_rad = min(max(axis.target_rad, at - 2 * math.pi), at + 2 * math.pi)
        curves.append(_arc(radius, at, end_rad, "line"))
    hand = radius, radius - _GIMBALS_APART
    curves.append(Curve([-r * math.sin(at) for r in hand], [r * math.cos(at) for r in hand], style))
    return curves


def _arc(radius: float, begin_rad: float, end_rad: float, style: str) -> Curve:
    angles = [begin_rad + (end_rad - begin_rad) * n / _ARC_PARTS for n in range(_ARC_PARTS + 1)]
    return Curve([-radius * math.sin(a) for a in angles], [radius * math.cos(a) for a in angles], style)


_CHARTS: Sequence[RunChart] = (
    RunChart(name="rate", draw=_output),
    RunChart(name="residual", draw=_residual),
    RunChart(name="NIS", draw=_nis),
    RunChart(name="temperature", draw=_temperature),
    *(RunChart(name=name, draw=partial(_state, index)) for index, name in enumerate(STATE_CHARTS)),
    RunChart(name="axes", draw=_axes, dial=True),
)
_BY_NAME = {chart.name: chart for chart in _CHARTS}
RUN_CHARTS = tuple(_BY_NAME)
DIALS = tuple(chart.name for chart in _CHARTS if chart.dial)
