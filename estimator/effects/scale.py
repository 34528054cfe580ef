"""Scale factors that depend on the rate itself; u is the rate about the sense axis."""

import numpy as np

from estimator.effects.conditions import Axes, Conditions
from estimator.effects.effect import Setting, Settings, family
from estimator.types import Floats

_LOST = 0.3  # share of the rate within a dead band that may be missing to all of it
_WIDTH = Setting(
    "width_rps",
    "width",
    "rad/s",
    lambda width_rps: f"{np.degrees(width_rps):.3g} deg/s",
    grid=lambda span_s, count: np.radians(np.geomspace(0.01, 3.0, 12)),
    begin=6,
    range_log=5.0,
)


def _within(settings: Settings, conditions: Conditions, axes: Axes) -> Floats:
    """Return the columns of a gyro that does not answer rates within a band."""
    u = conditions.w_rps @ axes.p
    return np.asarray(np.where(np.abs(u) <= float(settings["width_rps"]), -u, 0.0))


def _all_of_it(sizes: Floats) -> bool:
    """Return whether shares of the rate (gyros, 1) are lost to a dead band: within one a gyro loses all rates."""
    return bool(np.any(np.abs(sizes - 1) < _LOST)) and bool(np.all(sizes > -_LOST))


RECORDS = SCALE_ASYMMETRY, SCALE_QUADRATIC, SCALE_CUBIC, DEAD_BAND = family(
    "scale", dead_band={"regressors": _within, "settings": (_WIDTH,), "plausible": _all_of_it}
)
