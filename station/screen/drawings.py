"""What the charts show: a run as it goes, the states of a gyro over time and over calibrations, a script's motion."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

from station.run.snapshot import GyroSnapshot
from station.screen.sessions.live_run import LiveRun, Trend
from station.views.figures import STATE_FIGURES, number

STATE_CHARTS = tuple(state.name for state in STATE_FIGURES)
RUN_CHARTS = ("rate", "residual", "NIS", "temperature", *STATE_CHARTS)
_AXIS_STYLES = ("first", "second", "third")
_LIMITS = ("k", "b_rps", "sigma_rad", "sigma_rad")
_RECENT, _LEAST_SIGMAS, _MARGIN = 0.2, 3.0, 1.15
_SHOWN_BY_MOTION = 0.5  # of the sigma that a state begins with
_SIGMAS = 2.0
_DEG, _DAY_S = math.degrees(1), 86400.0
_EVER = (-1e12, 1e12)

Words = list[tuple[str, str]]


class Curve(NamedTuple):
    """Values over time, in a style of the charts; with ``sds`` they are points with bars."""

    times: Sequence[float]
    values: Sequence[float]
    style: str = "line"
    sds: Sequence[float] = ()


class Drawing(NamedTuple):
    """One chart: words of its title with their styles, curves, the range of values (None: that of the curves).

    ``span`` is the range of times, ``marks`` are instants.
    """

    words: Words
    curves: Sequence[Curve]
    low: float | None = None
    high: float | None = None
    span: tuple[float, float] = (0.0, 1.0)
    marks: Sequence[float] = ()


def run_drawing(name: str, run: LiveRun, gyro: GyroSnapshot) -> Drawing:
    """Return a chart of a run, one of ``RUN_CHARTS``, with its steps marked."""
    marks = [float(step["start_s"]) for step in run.hello.get("script", {}).get("steps", [])]
    found = _figures(name, run, gyro)
    return found._replace(marks=marks, span=(0.0, run.seen[-1].elapsed_s))


def _figures(name: str, run: LiveRun, gyro: GyroSnapshot) -> Drawing:
    limits, last, times = run.hello.get("limits") or {}, run.seen[-1], [s.elapsed_s for s in run.seen]
    if name in STATE_CHARTS:
        index = STATE_CHARTS.index(name)
        limit = limits.get(_LIMITS[index])
        return state_drawing(index, run.trends.get(gyro.name) or Trend(), math.inf if limit is None else limit)
    if name == "NIS":
        reach = [_SIGMAS * math.sqrt(2 / s.recent) if s.recent else math.nan for s in run.seen]
        curves = [Curve(times, [1 + sign * r for r in reach], "band") for sign in (1, -1)]
        curves += [_level(limits[key], "limit") for key in ("nis_low", "nis_high") if limits.get(key)]
        words = [("NIS (30 s)", ""), (number(last.nis_recent, 2), "line"), ("95 % band", "band"), ("limits", "limit")]
        return Drawing(words, [*curves, Curve(times, [s.nis_recent for s in run.seen])], 0.5, 1.5)
    if name == "temperature":
        values = [next((u.temperature_c for u in s.sources if u.name == gyro.source), math.nan) for s in run.seen]
        words = [("temperature (degC)", ""), (number(values[-1], 1), "line"), (gyro.source, "")]
        return Drawing(words, [Curve(times, values)])
    of_gyro = [next((g for g in s.gyros if g.name == gyro.name), GyroSnapshot("", "", (), ())) for s in run.seen]
    if name == "residual":
        words = [("residual (sigmas)", ""), (gyro.name, "line"), ("95 % within 2", "band")]
        band = [_level(level, "band") for level in (_SIGMAS, -_SIGMAS)]
        return Drawing(words, [*band, Curve(times, [g.residual for g in of_gyro])], -2 * _SIGMAS, 2 * _SIGMAS)
    words, curves = [("rate (deg/s)", ""), (gyro.name, "line"), ("table", "")], []
    for axis, style in zip(sorted(axis.name for axis in last.axes), _AXIS_STYLES, strict=False):
        curves.append(Curve(times, [_DEG * a.rate_rps for s in run.seen for a in s.axes if a.name == axis], style))
        words.append((axis, style))
    return Drawing(words, [*curves, Curve(times, [g.rate_rps * _DEG for g in of_gyro])])


def state_drawing(index: int, trend: Trend, limit: float) -> Drawing:
    """Return how a state of a gyro narrowed, between one sigma below and above it; ``limit`` in SI.

    Nothing is shown before the motion that shows the state. The range of values is that of the last fifth of the time,
    so that a band which narrows is seen to; a limit is drawn where it is near, and else said.
    """
    state = STATE_FIGURES[index]
    words = [(f"{state.name} ({state.unit})", "")]
    rows = list(zip(trend.times_s, trend.values, trend.sds, strict=True))
    scaled = [(t, value[index] * state.factor, sd[index] * state.factor) for t, value, sd in rows]
    if not scaled or scaled[-1][2] > _SHOWN_BY_MOTION * scaled[0][2]:
        return Drawing([*words, ("no motion has shown it yet", "band")], [])
    start, (end, centre, sd) = scaled[0][0], scaled[-1]
    recent = [abs(value - centre) + s for t, value, s in scaled if t >= end - _RECENT * (end - start)]
    reach = max(*recent, _LEAST_SIGMAS * sd) * _MARGIN or 1.0
    times, values, sds = zip(*(row for row in scaled if row[2] < reach), strict=True)
    edges = [Curve(times, [v + sign * s for v, s in zip(values, sds, strict=True)], "band") for sign in (1, -1)]
    words.append((f"{number(centre, state.digits)} ± {number(sd, state.digits)}", "line"))
    curves = [*edges, Curve(times, values)]
    return _limited(Drawing(words, curves, centre - reach, centre + reach, (start, end)), limit * state.factor)


def trend_drawing(index: int, points: Sequence[tuple[float, GyroSnapshot]], limit: float) -> Drawing:
    """Return a state of a gyro over calibrations, by when each began (s), with its sigma; ``limit`` in SI."""
    state = STATE_FIGURES[index]
    days = [(when_s - points[0][0]) / _DAY_S for when_s, _ in points]
    values = [gyro.values[index] * state.factor for _, gyro in points]
    sds = [gyro.sds[index] * state.factor for _, gyro in points]
    reach = max(abs(v - values[-1]) + sd for v, sd in zip(values, sds, strict=True)) * _MARGIN or 1.0
    words = [(f"{state.name} ({state.unit})", ""), (number(values[-1], state.digits), "line"), ("over days", "")]
    margin = 0.05 * days[-1] or 1.0
    curve, span = Curve(days, values, sds=sds), (-margin, days[-1] + margin)
    return _limited(Drawing(words, [curve], values[-1] - reach, values[-1] + reach, span), limit * state.factor)


def motion_drawing(axes: Sequence[str], t_s: Any, rates_rps: Any) -> Drawing:
    """Return the rates (N, axes) that a script asks of the axes of a table."""
    styled = list(zip(sorted(range(len(axes)), key=axes.__getitem__), _AXIS_STYLES, strict=False))
    words = [("rate (deg/s) that the script asks for", ""), *((axes[at], style) for at, style in styled)]
    return Drawing(words, [Curve(t_s, rates_rps[:, at] * _DEG, style) for at, style in styled], span=(0.0, t_s[-1]))


def _level(value: float, style: str) -> Curve:
    return Curve(_EVER, (value, value), style)


def _limited(drawing: Drawing, limit: float) -> Drawing:
    """Say in the title what the limits are, and draw those that are near."""
    low, high = drawing.low or 0.0, drawing.high or 0.0
    if not math.isfinite(limit):
        return drawing
    near = [at for at in (limit, -limit) if 2 * low - high < at < 2 * high - low]
    drawing.words.append((f"limit ±{limit:g}{'' if near else ', off the chart'}", "limit"))
    curves = [*(_level(at, "limit") for at in near), *drawing.curves]
    return drawing._replace(curves=curves, low=min([low, *near]), high=max([high, *near]))
