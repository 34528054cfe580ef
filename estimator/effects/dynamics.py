"""Effects of changing rates: delay, limited bandwidth, angular acceleration."""

import numpy as np

from estimator.effects.conditions import Axes, Conditions
from estimator.effects.effect import Effect, Settings, family
from estimator.types import Floats

LAG_S = 0.004
"""Where the time constant of a gyro's own low pass is looked for first."""
_LAGUERRE = np.polynomial.laguerre.laggauss(4)


def _delay_column(settings: Settings, conditions: Conditions, axes: Axes) -> Floats:
    """Return the column (N,) of a delay: p . (w that long before - w), per second of its size.

    It is exact for the setting ``delay_s`` (s). If that is 0, or the rate before is unknown, it is the limit -p . wdot.
    """
    delay_s = float(settings.get("delay_s", 0.0))
    if not delay_s or conditions.delayed_rps is None:
        return -conditions.wdot_rps2 @ axes.p
    return (conditions.delayed_rps(delay_s) - conditions.delayed_rps(0.0)) @ axes.p / abs(delay_s)


def _lag_column(settings: Settings, conditions: Conditions, axes: Axes) -> Floats:
    """Return the column (N,) of a first-order lag per second of its time constant; exact for the setting ``tau_s`` (s).

    A lag of time constant T is the mean of all delays, weighted by exp(-delay / T) / T (four points of Gauss and
    Laguerre). If the rate before is unknown, it is -u' + tau u'', u = p . w. Only the second derivative differs from a
    delay, so the two look alike on ramps.
    """
    tau_s = float(settings.get("tau_s", LAG_S))
    if conditions.delayed_rps is None:
        slope = conditions.wdot_rps2 @ axes.p
        return np.asarray(-slope + tau_s * np.gradient(slope, conditions.period_s))
    lagged = sum(weight * conditions.delayed_rps(tau_s * node) for node, weight in zip(*_LAGUERRE, strict=True))
    return np.asarray((lagged - conditions.delayed_rps(0.0)) @ axes.p / tau_s)


RECORDS = LATENCY, BANDWIDTH, ACCELERATION_SENSITIVITY, REFERENCE_LAG = family(
    "dynamics",
    latency={"regressors": _delay_column},
    bandwidth={"regressors": _lag_column},
    reference_lag={"regressors": _delay_column},
)


def late(delay_s: float) -> Effect:
    """Return a delay of the gyros; those that seem to be early are not: then it is the reference that lags."""
    return (LATENCY if delay_s >= 0 else REFERENCE_LAG).effect(delay_s=delay_s)
