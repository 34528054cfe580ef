"""Effects of changing rates: delay, limited bandwidth, angular acceleration; and tones."""

import numpy as np

from estimator.effects.conditions import Conditions
from estimator.effects.effect import Axes, Effect, Parameter
from estimator.types import Floats

_LAGUERRE = np.polynomial.laguerre.laggauss(4)


def latency(delay_s: float = 0.0) -> Effect:
    """Return a delay of the gyros' stamps against the table's: p . (w that long ago - w), per second of the delay.

    It is exact for ``delay_s``; for 0, or where it is not known what was before, its limit -p . wdot. Gyros that seem
    to be early are not: then it is the reference that lags.
    """

    def columns(conditions: Conditions, axes: Axes) -> Floats:
        if not delay_s or conditions.delayed_rps is None:
            return -conditions.wdot_rps2 @ axes.p
        return (conditions.delayed_rps(delay_s) - conditions.delayed_rps(0.0)) @ axes.p / abs(delay_s)

    return Effect(
        "latency" if delay_s >= 0 else "reference_lag",
        (Parameter("delay", "s", 0.02),),
        shared=True,
        shown_by="ramps",
        confused_with=("acceleration_sensitivity", "bandwidth"),
        regressors=columns,
    )


def bandwidth(tau_s: float = 0.004) -> Effect:
    """Return a first-order lag, each gyro its own, per second of its time constant; exact for ``tau_s``.

    A lag of time constant T is the mean of all delays, exp(-delay / T) / T each (four points of Gauss and Laguerre);
    where it is not known what was before, -u' + tau u'', u = p . w. Beside a delay only the second derivative differs,
    so the two look alike on ramps. Largest: 10 Hz, 16 ms.
    """

    def columns(conditions: Conditions, axes: Axes) -> Floats:
        if conditions.delayed_rps is None:
            slope = conditions.wdot_rps2 @ axes.p
            return np.asarray(-slope + tau_s * np.gradient(slope, conditions.period_s))
        lagged = sum(weight * conditions.delayed_rps(tau_s * node) for node, weight in zip(*_LAGUERRE, strict=True))
        return np.asarray((lagged - conditions.delayed_rps(0.0)) @ axes.p / tau_s)

    return Effect(
        "bandwidth",
        (Parameter("time constant", "s", 1 / (2 * np.pi * 10.0)),),
        shared=False,
        shown_by="steep ramps, sines",
        confused_with=("latency", "acceleration_sensitivity"),
        regressors=columns,
    )


def acceleration_sensitivity() -> Effect:
    """Return what angular acceleration about the tilt axes adds: wdot along j and k. About p it looks like latency."""
    return Effect(
        "acceleration_sensitivity",
        (Parameter("about j", "s", 2e-3), Parameter("about k", "s", 2e-3)),
        shared=False,
        shown_by="ramps about axes across the sense axis",
        confused_with=("latency",),
        regressors=lambda conditions, axes: np.column_stack(
            [conditions.wdot_rps2 @ axes.j, conditions.wdot_rps2 @ axes.k]
        ),
    )


def tone(frequency_hz: float) -> Effect:
    """Return a vibration or an alias of the mains at a frequency: cosine and sine, up to 0.5 deg/s."""

    def columns(conditions: Conditions, axes: Axes) -> Floats:
        phase = 2 * np.pi * frequency_hz * conditions.t_s
        return np.column_stack([np.cos(phase), np.sin(phase)])

    largest = float(np.radians(0.5))
    return Effect(
        "tone",
        tuple(Parameter(f"{part} at {frequency_hz:g} Hz", "rad/s", largest) for part in ("cosine", "sine")),
        shared=False,
        shown_by="samples faster than twice its frequency",
        confused_with=(),
        regressors=columns,
    )
