"""The motion that a script asks for: angle, rate and acceleration of every axis, before anything moves."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drivers.types import Floats
from estimator.effects.conditions import Conditions
from estimator.geometry.kinematics import Site
from estimator.recordings.reference import TableReadings, TableUncertainty
from station.scripts.script import Script
from station.scripts.steps.kind import Turn


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class PlannedMotion:
    """Instants ``t_s`` (N,); angles, rates and accelerations (N, g) of the ``gimbals``, outermost first.

    ``open_s`` has beginning and end of each step that may take longer than here.
    """

    t_s: Floats
    angle_rad: Floats
    rate_rps: Floats
    acceleration_rps2: Floats
    gimbals: tuple[str, ...]
    open_s: tuple[tuple[float, float], ...] = ()

    def conditions(self, temperature_c: Floats | None, site: Site | None) -> Conditions:
        """Return the conditions of gyros on the innermost axis at this temperature (N,), None if it is not known."""
        return Conditions.on_table(
            self.t_s,
            self.angle_rad,
            self.rate_rps,
            self.acceleration_rps2,
            self.gimbals,
            temperature_c=temperature_c,
            site=site,
        )

    def readings(self, uncertainty: TableUncertainty | None) -> TableReadings:
        """Return the planned readings of a table with this uncertainty."""
        t_ns = np.round(self.t_s * 1e9).astype(np.int64)
        return TableReadings(
            t_ns=t_ns, angle_rad=self.angle_rad, rate_rps=self.rate_rps, gimbals=self.gimbals, uncertainty=uncertainty
        )


def planned_motion(script: Script, gimbals: Sequence[str], period_s: float = 0.05) -> PlannedMotion:
    """Return the motion when a table at home carries out the script, at the middle of each period.

    There are at least two instants. Steps of open duration take their least. The script must be one that the table can
    do (``script.check``).
    """
    axes = tuple(gimbals)
    count = max(math.ceil(script.least_s / period_s - 1e-9), 2)
    t_s = np.asarray((np.arange(count) + 0.5) * period_s, dtype=np.float64)
    angle, rate, acceleration = np.zeros((3, count, len(axes)))
    timeline = script.timeline()
    for start_s, turn in (turn for timed in timeline for turn in timed.turns()):
        column = axes.index(turn.axis)
        way, speed, push = _trapezoid(t_s - start_s, turn)
        angle[:, column] += way
        rate[:, column] += speed
        acceleration[:, column] += push
    open_s = [(timed.start_s, timed.start_s + timed.span.least_s) for timed in timeline if not timed.span.is_exact]
    return PlannedMotion(
        t_s=t_s, angle_rad=angle, rate_rps=rate, acceleration_rps2=acceleration, gimbals=axes, open_s=tuple(open_s)
    )


def _trapezoid(since_s: Floats, turn: Turn) -> tuple[Floats, Floats, Floats]:
    """Return angle since its beginning, rate and acceleration (N,) of a turn, at times ``since_s`` (N,) since it began.

    They have the sign of the turn. Before it all are 0; after it the angle stays.
    """
    limit = turn.acceleration_rps2
    way_rad = turn.way_rad
    peak = min(abs(turn.rate_rps), math.sqrt(abs(way_rad) * limit))
    if peak == 0.0:
        return np.zeros_like(since_s), np.zeros_like(since_s), np.zeros_like(since_s)
    ramp_s = peak / limit
    end_s = abs(way_rad) / peak + ramp_s
    since, left = np.maximum(since_s, 0.0), np.maximum(end_s - since_s, 0.0)
    up, down = since < np.minimum(ramp_s, end_s / 2), left < np.minimum(ramp_s, end_s / 2)
    sign = math.copysign(1.0, way_rad)
    # From the nearer end: the last ramp then ends on the target, in spite of rounding.
    way = np.where(
        up, 0.5 * limit * since**2, np.where(down, abs(way_rad) - 0.5 * limit * left**2, peak * (since - 0.5 * ramp_s))
    )
    rate = np.where(up, limit * since, np.where(down, limit * left, peak))
    push = np.where(up & (since > 0), limit, np.where(down & (left > 0), -limit, 0.0))
    return sign * way, sign * rate, sign * push
