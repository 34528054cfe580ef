"""Effects of temperature. Without a temperature they are nothing: their columns are zero."""

import numpy as np

from estimator.effects.conditions import Conditions
from estimator.effects.effect import Axes, Effect, Parameter
from estimator.types import Floats

_NEEDS = frozenset({"temperature"})
REFERENCE_C = 25.0
"""Temperature at which data sheets state bias and scale factor."""


def thermal_bias(reference_c: float = REFERENCE_C) -> Effect:
    """Return a bias in proportion to temperature: up to 20 deg/s over 125 K (InvenSense MPU-6050)."""
    return Effect(
        "thermal_bias",
        (Parameter("linear", "rad/s/K", float(np.radians(0.16))),),
        shared=False,
        shown_by="a temperature that rises and falls",
        confused_with=("warm_up", "bias_drift", "thermal_gradient"),
        regressors=lambda conditions, axes: _above(conditions, reference_c),
        needs=_NEEDS,
    )


def thermal_bias_quadratic(reference_c: float = REFERENCE_C) -> Effect:
    """Return what the bias grows by with the square of temperature: up to 8 deg/s at 65 K from the reference."""
    return Effect(
        "thermal_bias_quadratic",
        (Parameter("quadratic", "rad/s/K2", float(np.radians(0.002))),),
        shared=False,
        shown_by="three temperatures and more, far apart",
        confused_with=("thermal_bias", "warm_up"),
        regressors=lambda conditions, axes: np.asarray(_above(conditions, reference_c) ** 2),
        needs=_NEEDS,
    )


def thermal_scale(reference_c: float = REFERENCE_C) -> Effect:
    """Return the scale factor over temperature: up to 500 ppm/K for uncompensated MEMS gyros."""
    return Effect(
        "thermal_scale",
        (Parameter("linear", "1/K", 5e-4),),
        shared=False,
        shown_by="one rate at several temperatures",
        confused_with=("scale_asymmetry",),
        regressors=lambda conditions, axes: _above(conditions, reference_c) * (conditions.w_rps @ axes.p),
        needs=_NEEDS,
    )


def thermal_gradient() -> Effect:
    """Return what a changing temperature adds: up to 1 deg/s per K/min before the parts are evenly warm."""

    def columns(conditions: Conditions, axes: Axes) -> Floats:
        return conditions.warming_kps

    return Effect(
        "thermal_gradient",
        (Parameter("per rate of change", "rad/s/(K/s)", float(np.radians(60.0))),),
        shared=False,
        shown_by="a temperature that changes at different rates",
        confused_with=("warm_up", "bias_drift", "thermal_bias"),
        regressors=columns,
        needs=_NEEDS,
    )


def _above(conditions: Conditions, reference_c: float) -> Floats:
    if conditions.temperature_c is None:
        return np.zeros(len(conditions.t_s))
    return conditions.temperature_c - reference_c
