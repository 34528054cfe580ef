"""Biases that change with time by a law."""

import numpy as np

from estimator.effects.conditions import Axes, Conditions
from estimator.effects.effect import Setting, Settings, family
from estimator.types import Floats

_STEPS = 8  # a step at an unknown instant is as good as several that share its variance


def _taus_s(span_s: float, count: int) -> Floats:
    return np.geomspace(8.0, max(span_s / 1.5, 20.0), count)


def _after(settings: Settings, conditions: Conditions, axes: Axes) -> Floats:
    return np.asarray(conditions.t_s >= float(settings["at_s"]), dtype=np.float64)


def _instants(first_s: float, last_s: float) -> list[Settings]:
    return [{"at_s": at_s} for at_s in np.linspace(first_s, last_s, _STEPS + 2)[1:-1].tolist()]


_TIME_CONSTANT = Setting(
    "time_constant_s", "time constant", "s", "{:g} s".format, grid=_taus_s, range_log=float(np.log(3600.0 / 5.0))
)
RECORDS = BIAS_DRIFT, WARM_UP, BIAS_STEP = family(
    "drift",
    warm_up={"settings": (_TIME_CONSTANT,)},
    bias_step={"regressors": _after, "listed": lambda s: ({"at_s": s / 2},), "assumed": _instants},
)
