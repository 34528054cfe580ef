"""What the charts show: a run as it goes, the states of a gyro over time and over calibrations, a script's motion."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from station.run.snapshot import GyroSnapshot
from station.screen.sessions.live_run import LiveRun, Trend
from station.views.figures import STATE_FIGURES, number

STATE_CHARTS = tuple(state.name for state in STATE_FIGURES)
RUN_CHARTS = ("rate", "residual", "NIS", "temperature", *STATE_CHARTS)
AXIS_STYLES = ("first", "second", "third")
"""Styles of curves that are of one axis each."""
_LIMITS = ("k", "b_rps", "sigma_rad", "sigma_rad")
_RECENT, _LEAST_SIGMAS, _MARGIN = 0.2, 3.0, 1.15
_SHOWN_BY_MOTION = 0.5  # of the sigma that a state begins with
_SIGMAS = 2.0
_LEAST_DEGREES = 0.25
_DEG = math.degrees(1)


@dataclass(frozen=True, slots=True, eq=False)
class Curve:
    """Values over time, in a style of the charts; with ``sds`` they are points with bars."""

    times_s: Sequence[float]
    values: Sequence[float]
    style: str = "line"
    sds: Sequence[float] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Drawing:
    """One chart: words and their styles for its title, curves, levels with a style, instants that are marked.

    ``low`` and ``high`` are the range of values, NaN for that of the curves; ``span`` that of times.
    """

    words: Sequence[tuple[str, str]]
    curves: Sequence[Curve] = ()
    levels: Sequence[tuple[float, str]] = ()
    marks: Sequence[float] = ()
    low: float = math.nan
    high: float = math.nan
    span: tuple[float, float] = (0.0, 1.0)
    whole: bool = False
    """Whether times are numbers of calibrations."""


def run_drawing(name: str, run: LiveRun, gyro: GyroSnapshot) -> Drawing:
    """Return a chart of a run; ``name`` is one of ``RUN_CHARTS``."""
    marks = [float(step["start_s"]) for step in run.hello.get("script", {}).get("steps", [])]
    return replace(_of_run(name, run, gyro), marks=marks, span=(0.0, run.seen[-1].elapsed_s))


def _of_run(name: str, run: LiveRun, gyro: GyroSnapshot) -> Drawing:
    if name in STATE_CHARTS:
        index = STATE_CHARTS.index(name)
        limit = (run.hello.get("limits") or {}).get(_LIMITS[index])
        return state_drawing(index, run.trends.get(gyro.name) or Trend(), math.inf if limit is None else limit)
    times_s = [snapshot.elapsed_s for snapshot in run.seen]
    if name == "rate":
        return _rates(run, gyro, times_s)
    if name == "NIS":
        return _nis(run, times_s)
    if name == "temperature":
        values = [source.temperature_c for s in run.seen for source in s.sources if source.name == gyro.source]
        known = [value for value in values if math.isfinite(value)] or [0.0]
        low, high = min(known) - _LEAST_DEGREES, max(known) + _LEAST_DEGREES
        words = [("temperature (degC)", ""), (number(values[-1] if values else None, 1), "line"), (gyro.source, "")]
        return Drawing(words, [Curve(times_s, values)], low=low, high=high)
    values = [found.residual for found in _of(run, gyro)]
    levels = [(_SIGMAS, "band"), (-_SIGMAS, "band")]
    words = [("residual (sigmas)", ""), (gyro.name, "line"), ("95 % within 2", "band")]
    known = [value for value in values if math.isfinite(value)]
    return Drawing(words, [Curve(times_s, values)], levels, low=min([-3, *known]), high=max([3, *known]))


def _of(run: LiveRun, gyro: GyroSnapshot) -> list[GyroSnapshot]:
    """Return one gyro in all snapshots; one that holds nothing where it was not there yet."""
    nothing = GyroSnapshot(gyro.name, gyro.source, (), ())
    return [next((found for found in s.gyros if found.name == gyro.name), nothing) for s in run.seen]


def _rates(run: LiveRun, gyro: GyroSnapshot, times_s: list[float]) -> Drawing:
    words, curves = [("rate (deg/s)", ""), (gyro.name, "line"), ("table", "")], []
    axes = {axis.name: axis for snapshot in run.seen for axis in snapshot.axes}
    for name, style in zip(sorted(axes), AXIS_STYLES, strict=False):
        rates = [next((a.rate_rps * _DEG for a in s.axes if a.name == name), math.nan) for s in run.seen]
        curves.append(Curve(times_s, rates, style))
        words.append((name, style))
    curves.append(Curve(times_s, [found.rate_rps * _DEG for found in _of(run, gyro)]))
    return Drawing(words, curves)


def _nis(run: LiveRun, times_s: list[float]) -> Drawing:
    last, limits = run.seen[-1], run.hello.get("limits") or {}
    reach = [_SIGMAS * math.sqrt(2 / s.recent) if s.recent else math.nan for s in run.seen]
    curves = [Curve(times_s, [1 + sign * r for r in reach], "band") for sign in (1, -1)]
    curves.append(Curve(times_s, [s.nis_recent for s in run.seen]))
    levels = [(float(limits[key]), "limit") for key in ("nis_low", "nis_high") if limits.get(key)]
    words = [("NIS (30 s)", ""), (number(last.nis_recent, 2), "line"), ("95 % band", "band"), ("limits", "limit")]
    edges = [0.5, 1.5, *(level for level, _ in levels)]
    return Drawing(words, curves, levels, low=min(edges), high=max(edges))


def state_drawing(index: int, trend: Trend, limit: float) -> Drawing:
    """Return how a state of a gyro narrowed, between one sigma below and above it; ``limit`` in SI.

    Nothing is shown before the motion that shows the state. The range of values is that of the last fifth of the time,
    so that a band which narrows is seen to; a limit is drawn where it is near, and else said.
    """
    state = STATE_FIGURES[index]
    name = (f"{state.name} ({state.unit})", "")
    times_s, values = trend.times_s, [row[index] * state.factor for row in trend.values]
    sds = [row[index] * state.factor for row in trend.sds]
    span = (times_s[0], times_s[-1]) if times_s else (0.0, 1.0)
    if len(times_s) < 2 or sds[-1] > _SHOWN_BY_MOTION * sds[0]:
        return Drawing([name, ("no motion has shown it yet", "band")], span=span, low=-1, high=1)
    late = times_s[-1] - _RECENT * (times_s[-1] - times_s[0])
    centre, sd = values[-1], sds[-1]
    recent = [abs(v - centre) + s for t, v, s in zip(times_s, values, sds, strict=True) if t >= late]
    reach = max(*recent, _LEAST_SIGMAS * sd) * _MARGIN or 1.0
    known = [at for at, s in enumerate(sds) if s < reach]
    times_s, values, sds = ([series[at] for at in known] for series in (times_s, values, sds))
    curves = [Curve(times_s, [v + sign * s for v, s in zip(values, sds, strict=True)], "band") for sign in (1, -1)]
    words = [name, (f"{number(centre, state.digits)} ± {number(sd, state.digits)}", "line")]
    drawn, low, high = _with_limit(words, limit * state.factor, centre - reach, centre + reach)
    return Drawing(words, [*curves, Curve(times_s, values)], drawn, (), low, high, span)


def trend_drawing(index: int, gyros: Sequence[GyroSnapshot], limit: float) -> Drawing:
    """Return a state of a gyro over calibrations, the oldest first, each with its sigma; ``limit`` in SI."""
    state = STATE_FIGURES[index]
    values, sds = ([part[index] * state.factor for part in parts] for parts in _pairs(gyros))
    low = min(v - sd for v, sd in zip(values, sds, strict=True))
    high = max(v + sd for v, sd in zip(values, sds, strict=True))
    margin = 0.08 * max(high - low, abs(high) * 1e-9, 1e-12)
    words = [(f"{state.name} ({state.unit})", ""), (f"{number(values[-1], state.digits)}", "line")]
    levels, low, high = _with_limit(words, limit * state.factor, low - margin, high + margin)
    numbers = range(1, len(values) + 1)
    span = (0.5, len(values) + 0.5)
    return Drawing(words, [Curve(numbers, values, sds=sds)], levels, (), low, high, span, whole=True)


def motion_drawing(axes: Sequence[str], t_s: Any, rates_rps: Any) -> Drawing:
    """Return the rates (N, axes) that a script asks of the axes of a table."""
    order = sorted(range(len(axes)), key=lambda column: axes[column])
    styled = list(zip(order, AXIS_STYLES, strict=False))
    curves = [Curve(t_s, rates_rps[:, at] * _DEG, style) for at, style in styled]
    words = [("rate (deg/s) that the script asks for", ""), *((axes[at], style) for at, style in styled)]
    most = 1.1 * max(float(abs(rates_rps).max()) * _DEG, 1.0)
    return Drawing(words, curves, low=-most, high=most, span=(0.0, float(t_s[-1])))


def _pairs(gyros: Sequence[GyroSnapshot]) -> tuple[list[tuple[float, ...]], list[tuple[float, ...]]]:
    return [gyro.values for gyro in gyros], [gyro.sds for gyro in gyros]


def _with_limit(
    words: list[tuple[str, str]], limit: float, low: float, high: float
) -> tuple[list[tuple[float, str]], float, float]:
    """Return the limits that are near a range, and the range with them; say in the title what they are."""
    if not math.isfinite(limit):
        return [], low, high
    reach = high - low
    near = [at for at in (limit, -limit) if low - 2 * reach < at < high + 2 * reach]
    words.append((f"limit ±{limit:g}{'' if near else ', off the chart'}", "limit"))
    margin = 0.08 * reach if near else 0.0
    return [(at, "limit") for at in near], min([low, *near]) - margin, max([high, *near]) + margin
