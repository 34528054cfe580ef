"""The contents of the charts: a run, the states of a gyro over time and over calibrations, a script's motion."""

import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

from drivers.units import split_quantity
from station.run.snapshot import GyroSnapshot, Snapshot
from station.screen.sessions.live_run import LiveRun, Trend
from station.views.figures import STATE_FIGURES, StateUnit, number

STATE_CHARTS = tuple(state.name for state in STATE_FIGURES)
DIALS = ("axes",)
RUN_CHARTS = ("rate", "residual", "NIS", "temperature", *STATE_CHARTS, *DIALS)
_AXIS_STYLES = ("first", "second", "third")
_RECENT, _LEAST_SIGMAS, _MARGIN = 0.2, 3.0, 1.15
_SHOWN_BY_MOTION = 0.5  # of the sigma that a state begins with
_SIGMAS = 2.0
_DEG = math.degrees(1)
_EXPECTED = "by the table"
_SERIES = "series"  # how the names of charts of series begin
_EVER = (-1e12, 1e12)
_ARC_PARTS, _GIMBALS_APART = 24, 0.3


class Curve(NamedTuple):
    """Values over time in one of the charts' styles; with ``sds`` points with error bars."""

    times: Sequence[float]
    values: Sequence[float]
    style: str = "line"
    sds: Sequence[float] = ()


class StateLimit(NamedTuple):
    """The largest size of a state in SI, infinite for none; ``written`` is the text in the bench file, if known."""

    size: float = math.inf
    written: str = ""

    def text(self, state: StateUnit) -> str:
        """Return the limit as it was written; without its unit if that is the one the state is shown in."""
        number, unit = split_quantity(self.written) or (self.size * state.factor, state.unit)
        return f"{number:.5g}" if unit == state.unit else self.written


class Drawing(NamedTuple):
    """One chart: title words with styles, curves, the range of values (None: that of the curves).

    ``span`` is the range of times in the unit ``over``, ``marks`` are instants. A ``dial`` is round, with a radius of
    1.
    """

    words: Sequence[tuple[str, str]]
    curves: Sequence[Curve]
    range: tuple[float, float] | None = None
    span: tuple[float, float] = (0.0, 1.0)
    marks: Sequence[float] = ()
    over: str = "s"
    dial: bool = False
    began_utc_s: float | None = None
    """Instant of time 0 if the axis shows dates; times are then days."""


def run_drawing(name: str, run: LiveRun, gyro: GyroSnapshot) -> Drawing | None:
    """Return a chart of a run, one of ``RUN_CHARTS`` or ``series_charts``, with its steps marked.

    None for a series of a device that this run does not have. The run must have been seen.
    """
    if name == "axes" and run.snapshot is not None:
        return _axes_drawing(run, run.snapshot)
    limits = run.limits
    if name in series_charts(run.seen[-1]):
        found = _series_drawing(series_charts(run.seen[-1]).index(name), run.seen)
    elif name.startswith(_SERIES):
        return None
    elif name in STATE_CHARTS:
        index = STATE_CHARTS.index(name)
        trend = run.trends.get(gyro.name) or Trend()
        limit = StateLimit(limits.sizes[index], limits.written[index])
        found = state_drawing(index, trend, limit, figures=limits.figures)
    else:
        found = _seen(name, run, gyro, limits.nis)
    return found._replace(marks=run.steps_begin_s, span=(0.0, run.seen[-1].elapsed_s))


def series_charts(snapshot: Snapshot) -> list[str]:
    """Return the names of the charts of devices' series, one for each column."""
    return [f"{_SERIES}{at}" for at in range(len(snapshot.series))]


def _series_drawing(at: int, seen: Sequence[Snapshot]) -> Drawing:
    """Return a column of a device's series over time."""
    newest = seen[-1].series[at]
    values = [s.series[at].value if at < len(s.series) else math.nan for s in seen]
    words = [(f"{newest.column} ({newest.unit})", ""), (number(newest.value, 2), "line"), (newest.device, "")]
    return Drawing(words, [Curve([s.elapsed_s for s in seen], values)])


def _seen(name: str, run: LiveRun, gyro: GyroSnapshot, nis_limits: Sequence[float]) -> Drawing:
    """Return a chart of the run's snapshots: NIS, temperature, residual, or else the rate of a gyro beside the expected
    one.
    """
    times, last = [s.elapsed_s for s in run.seen], run.seen[-1]
    if name == "NIS":
        reach = [_SIGMAS * math.sqrt(2 / s.recent) if s.recent else math.nan for s in run.seen]
        curves = [Curve(times, [1 + sign * r for r in reach], "band") for sign in (1, -1)]
        curves += [*_levels(nis_limits, "limit"), Curve(times, [s.nis_recent for s in run.seen])]
        words = [("NIS (30 s)", ""), (number(last.nis_recent, 2), "line"), ("95 %", "band"), ("limits", "limit")]
        return Drawing(words[: 3 + bool(nis_limits)], curves, (0.5, 1.5))
    if name == "temperature":
        degc = [next((u.temperature_c for u in s.sources if u.name == gyro.source), math.nan) for s in run.seen]
        return Drawing(
            [("temperature (degC)", ""), (number(degc[-1], 1), "line"), (gyro.source, "")], [Curve(times, degc)]
        )
    of_gyro = [next((g for g in s.gyros if g.name == gyro.name), GyroSnapshot("", "", (), ())) for s in run.seen]
    if name == "residual":
        curves = [*_levels((_SIGMAS, -_SIGMAS), "band"), Curve(times, [g.residual for g in of_gyro])]
        words = [("residual (sigmas)", ""), (gyro.name, "line"), ("95 %", "band")]
        return Drawing(words, curves, (-2 * _SIGMAS, 2 * _SIGMAS))
    words, curves = [("rate (deg/s)", ""), (gyro.name, "line")], [Curve(times, [g.rate_rps * _DEG for g in of_gyro])]
    expected = [g.expected_rps * _DEG for g in of_gyro]
    if any(map(math.isfinite, expected)):
        words.append((_EXPECTED, "first"))
        curves.insert(0, Curve(times, expected, "first"))
    return Drawing(words, curves)


def _axes_drawing(run: LiveRun, snapshot: Snapshot) -> Drawing:
    """Return a dial of the gimbals, outermost outside, each with a hand at its angle, zero on top, and an arc to its
    target.
    """
    styles, curves = dict(zip(sorted(a.name for a in snapshot.axes), _AXIS_STYLES, strict=False)), []
    words: list[tuple[str, str]] = []
    for place, axis in enumerate(snapshot.axes):
        radius, at, style = 1.0 - place * _GIMBALS_APART, axis.angle_rad, styles[axis.name]
        turns, position = axis.state == "turning" and not run.at_rest, [(f"{axis.name} {number(at * _DEG, 1)}°", style)]
        curves.append(_arc(radius, 0.0, 2 * math.pi, style if turns else "mark"))
        goal = axis.target_rad
        if turns and math.isfinite(goal):
            curves.append(_arc(radius, at, min(max(goal, at - 2 * math.pi), at + 2 * math.pi), "line"))
            position += [(f"to {number(goal * _DEG, 0)}°", "line"), (f"{number(axis.rate_rps * _DEG, 1)}°/s", style)]
        hand = radius, radius - _GIMBALS_APART
        curves.append(Curve([-r * math.sin(at) for r in hand], [r * math.cos(at) for r in hand], style))
        words = [*position, *words] if turns else [*words, *position]
    return Drawing([("axes", ""), *words], curves, dial=True)


def _arc(radius: float, begin_rad: float, end_rad: float, style: str) -> Curve:
    angles = [begin_rad + (end_rad - begin_rad) * n / _ARC_PARTS for n in range(_ARC_PARTS + 1)]
    return Curve([-radius * math.sin(a) for a in angles], [radius * math.cos(a) for a in angles], style)


def state_drawing(
    index: int,
    trend: Trend,
    limit: StateLimit,
    over: str = "s",
    figures: Sequence[StateUnit] = STATE_FIGURES,
    began_utc_s: float | None = None,
) -> Drawing:
    """Return a chart of a state's estimate over time, as a band of one sigma.

    ``figures`` are the states in the units of the bench. If ``over`` is not "s", points with error bars show successive
    calibrations instead. Before the motion that shows the state, the band is as wide as the prior, and the title says
    so. The values' range is that of the last fifth of the time, so that the narrowing can be seen; a limit is drawn if
    it is near, and otherwise only named.
    """
    state, days = figures[index], over != "s"
    words = [(f"{state.name} ({state.unit})", "")]
    rows = list(zip(trend.times_s, trend.values, trend.sds, strict=True))
    scaled = [(t, value[index] * state.factor, sd[index] * state.factor) for t, value, sd in rows]
    if not scaled:
        return Drawing([*words, ("not estimated yet", "band")], [])
    start, (end, centre, sd) = scaled[0][0], scaled[-1]
    since = -math.inf if days else end - _RECENT * (end - start)
    reach = max(_LEAST_SIGMAS * sd, *(abs(value - centre) + s for t, value, s in scaled if t >= since)) * _MARGIN or 1.0
    times, values, sds = zip(*(row for row in scaled if row[2] < reach), strict=True)
    words.append((state.figure(trend.values[-1][index], trend.sds[-1][index]), "line"))
    if sd > _SHOWN_BY_MOTION * scaled[0][2] and not days:
        words.append(("not determined by the motion so far", "band"))
    edges = [Curve(times, [v + sign * s for v, s in zip(values, sds, strict=True)], "band") for sign in (1, -1)]
    curves = [Curve(times, values, sds=sds)] if days else [*edges, Curve(times, values)]
    margin = (0.05 * (end - start) or 1.0) if days else 0.0
    near: list[float] = []
    if math.isfinite(limit.size):
        size = limit.size * state.factor
        near = [at for at in (size, -size) if abs(at - centre) < 3 * reach]
        words.append((f"limit ±{limit.text(state)}", "limit"))
    values_range = min([centre - reach, *near]), max([centre + reach, *near])
    return Drawing(
        words,
        [*_levels(near, "limit"), *curves],
        values_range,
        (start - margin, end + margin),
        over=over,
        began_utc_s=began_utc_s,
    )


def motion_drawing(axes: Sequence[str], t_s: Any, rates_rps: Any) -> Drawing:
    """Return the rates (N, axes) that a script asks of the axes of a table."""
    styled = list(zip(sorted(range(len(axes)), key=axes.__getitem__), _AXIS_STYLES, strict=False))
    words = [("commanded rate (deg/s)", ""), *((axes[at], style) for at, style in styled)]
    return Drawing(words, [Curve(t_s, rates_rps[:, at] * _DEG, style) for at, style in styled], span=(0.0, t_s[-1]))


def _levels(values: Iterable[float], style: str) -> list[Curve]:
    return [Curve(_EVER, (value, value), style) for value in values]
