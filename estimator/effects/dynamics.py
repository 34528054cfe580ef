"""Effects of changing rates: delay, limited bandwidth, angular acceleration."""

from dataclasses import replace

import numpy as np

from estimator.effects.conditions import Axes, Conditions
from estimator.effects.effect import Acts, Effect, Odds, Parameter, Record, Regressors, Settings
from estimator.types import Floats

LAG_S = 0.004
"""Where the time constant of a gyro's own low pass is looked for first."""
_LAGUERRE = np.polynomial.laguerre.laggauss(4)


def _late(settings: Settings) -> Regressors:
    """Return the columns of a delay: p . (w that long ago - w), per second of the delay.

    They are exact for ``delay_s``; for 0, or where it is not known what was before, their limit -p . wdot.
    """
    delay_s = float(settings.get("delay_s", 0.0))

    def columns(conditions: Conditions, axes: Axes) -> Floats:
        if not delay_s or conditions.delayed_rps is None:
            return -conditions.wdot_rps2 @ axes.p
        return (conditions.delayed_rps(delay_s) - conditions.delayed_rps(0.0)) @ axes.p / abs(delay_s)

    return columns


def _lagging(settings: Settings) -> Regressors:
    """Return the column of a first-order lag per second of its time constant; exact for ``tau_s``.

    A lag of time constant T is the mean of all delays, exp(-delay / T) / T each (four points of Gauss and Laguerre);
    where it is not known what was before, -u' + tau u'', u = p . w. Beside a delay only the second derivative differs,
    so the two look alike on ramps.
    """
    tau_s = float(settings.get("tau_s", LAG_S))

    def columns(conditions: Conditions, axes: Axes) -> Floats:
        if conditions.delayed_rps is None:
            slope = conditions.wdot_rps2 @ axes.p
            return np.asarray(-slope + tau_s * np.gradient(slope, conditions.period_s))
        lagged = sum(weight * conditions.delayed_rps(tau_s * node) for node, weight in zip(*_LAGUERRE, strict=True))
        return np.asarray((lagged - conditions.delayed_rps(0.0)) @ axes.p / tau_s)

    return columns


RECORDS = (
    LATENCY := Record(  # a delay of the gyros' stamps against the table's
        name="latency",
        parameters=(Parameter("delay", "s", 0.02),),
        regressors=_late,
        formula="-delay*a",
        shared=True,
        shown_by="ramps",
        confused_with=("acceleration_sensitivity", "bandwidth"),
        depends_on="acceleration",
        suspected_of=("acceleration",),
        searched=False,
        acts=Acts.STAMPS,
        within_turns=True,
    ),
    BANDWIDTH := Record(  # each gyro its own; largest: 10 Hz, 16 ms
        name="bandwidth",
        parameters=(Parameter("time constant", "s", 1 / (2 * np.pi * 10.0)),),
        regressors=_lagging,
        formula="-dy/dt",
        shown_by="steep ramps, sines",
        confused_with=("latency", "acceleration_sensitivity"),
        suspected_of=("acceleration",),
        odds=Odds(-1.5),
        searched=False,
        acts=Acts.LAG,
        not_live="needs the second derivative of the rate",
        within_turns=True,
    ),
    ACCELERATION_SENSITIVITY := Record(  # about the tilt axes; about the sense axis it looks like latency
        name="acceleration_sensitivity",
        parameters=(Parameter("about j", "s", 2e-3), Parameter("about k", "s", 2e-3)),
        law="aj; ak",
        shown_by="ramps about axes across the sense axis",
        confused_with=("latency",),
        depends_on="acceleration",
        suspected_of=("acceleration",),
        within_turns=True,
    ),
    REFERENCE_LAG := replace(
        LATENCY,
        name="reference_lag",
        listed=lambda duration_s: (),
        depends_on="",
        suspected_of=(),
        not_kept="it is the reference that lags, not the gyros",
    ),
)


def late(delay_s: float) -> Effect:
    """Return a delay of the gyros; those that seem to be early are not: then it is the reference that lags."""
    return (LATENCY if delay_s >= 0 else REFERENCE_LAG).effect(delay_s=delay_s)
