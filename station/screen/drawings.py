"""The contents of charts: a state of a gyro over time and over calibrations, the motion of a script."""

import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

from drivers.units import split_quantity
from station.screen.sessions.live_run import Trend
from station.views.figures import STATE_FIGURES, StateUnit

STATE_CHARTS = tuple(state.name for state in STATE_FIGURES)
_AXIS_STYLES = ("first", "second", "third")
_RECENT, _LEAST_SIGMAS, _MARGIN = 0.2, 3.0, 1.15
_SHOWN_BY_MOTION = 0.5  # of the sigma that a state begins with
_DEG = math.degrees(1)
_EVER = (-1e12, 1e12)


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


def state_drawing(
    index: int,
    trend: Trend,
    limit: StateLimit,
    over: str = "s",
    figures: Sequence[StateUnit] = STATE_FIGURES,
    began_utc_s: float | None = None,
) -> Drawing:
    """Return a chart of the estimate of state number ``index`` over time, as a band of one sigma.

    ``figures`` are the states in the units of the bench. If ``over`` is not "s" but "days", points with error bars show
    successive calibrations, with dates from ``began_utc_s`` on. The title has the last figure, and says if the motion
    so far has not narrowed the prior; without an estimate there is only a title. The range, round the last estimate,
    is that of the last fifth of the time, of calibrations that of all; estimates with a wider sigma are left out. A
    finite limit is named, and drawn if near.
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
        [*levels(near, "limit"), *curves],
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


def levels(values: Iterable[float], style: str) -> list[Curve]:
    """Return horizontal lines over all of the time."""
    return [Curve(_EVER, (value, value), style) for value in values]
