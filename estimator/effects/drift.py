"""Biases that change with time by a law."""

import numpy as np

from estimator.effects.conditions import Axes, Conditions
from estimator.effects.effect import Odds, Parameter, Record, Regressors, Setting, Settings
from estimator.types import Floats

_LARGEST_RPS = float(np.radians(0.5))  # turn-on transients of consumer MEMS gyros
_STEPS = 8  # a step at an unknown instant is as good as several that share its variance


def _taus_s(span_s: float, count: int) -> Floats:
    return np.geomspace(8.0, max(span_s / 1.5, 20.0), count)


def _after(settings: Settings) -> Regressors:
    def columns(conditions: Conditions, axes: Axes) -> Floats:
        return np.asarray(conditions.t_s >= float(settings["at_s"]), dtype=np.float64)

    return columns


RECORDS = (
    BIAS_DRIFT := Record(  # up to 1 deg/s an hour, since the start
        name="bias_drift",
        parameters=(Parameter("slope", "rad/s2", float(np.radians(1 / 3600))),),
        law="t",
        shown_by="rests at the start, in the middle and at the end",
        confused_with=("thermal_bias", "warm_up", "bias_step"),
        depends_on="time",
        suspected_of=("time",),
        left_out="it counts from the start of that run, and says nothing of another",
    ),
    WARM_UP := Record(  # settles with a time constant after the start
        name="warm_up",
        parameters=(Parameter("with {time_constant_s:g} s", "rad/s", _LARGEST_RPS),),
        law="-expm1(-t/{time_constant_s})",
        shown_by="rests at the start, in the middle and at the end",
        confused_with=("thermal_bias", "bias_drift"),
        settings=(
            Setting(
                "time_constant_s",
                "time constant",
                "s",
                "{:g} s".format,
                grid=_taus_s,
                range_log=float(np.log(3600.0 / 5.0)),  # from a chip's to a housing's
            ),
        ),
        suspected_of=("time",),
        # Where a temperature is measured, a law of time with a free time constant stands behind it.
        odds=Odds(warm=-1.5),
        listed=lambda duration_s: ({"time_constant_s": 120.0},),
        assumed=lambda first_s, last_s: [{"time_constant_s": tau_s} for tau_s in (20.0, 90.0, 400.0)],
    ),
    BIAS_STEP := Record(
        name="bias_step",
        parameters=(Parameter("at {at_s:g} s", "rad/s", _LARGEST_RPS),),
        regressors=_after,
        formula="1 from an instant on",
        shown_by="the same rate or rest before and after",
        confused_with=("bias_drift", "warm_up"),
        settings=(Setting("at_s", "instant", "s"),),
        odds=Odds(-1.5),
        searched=False,
        listed=lambda duration_s: ({"at_s": duration_s / 2},),
        assumed=lambda first_s, last_s: [
            {"at_s": at} for at in np.linspace(first_s, last_s, _STEPS + 2)[1:-1].tolist()
        ],
        not_kept="it happened once, in one recording",
        alike=True,
    ),
)
