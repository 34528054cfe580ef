"""Scale factors that depend on the rate itself; u = p . w is the rate about the sense axis."""

import numpy as np

from estimator.effects.conditions import Conditions
from estimator.effects.effect import Axes, Effect, Parameter
from estimator.types import Floats


def scale_asymmetry() -> Effect:
    """Return a scale factor that differs between the directions by twice the parameter: abs(u).

    Some 100 ppm in tactical, some 1000 ppm in automotive MEMS gyros.
    """
    return Effect(
        "scale_asymmetry",
        (Parameter("each direction", "1", 5e-3),),
        shared=False,
        shown_by="turns in both directions about each axis",
        confused_with=("scale_quadratic",),
        regressors=lambda conditions, axes: np.abs(conditions.w_rps @ axes.p),
    )


def scale_quadratic() -> Effect:
    """Return what grows with the square of the rate: u^2, up to 1 % of full scale at 30 deg/s."""
    return Effect(
        "scale_quadratic",
        (Parameter("u^2", "1/(rad/s)", 2e-2),),
        shared=False,
        shown_by="three rates and more in each direction",
        confused_with=("scale_asymmetry", "scale_cubic"),
        regressors=lambda conditions, axes: np.asarray((conditions.w_rps @ axes.p) ** 2),
    )


def scale_cubic() -> Effect:
    """Return what grows with the cube of the rate: u^3, up to 1 % of full scale at 30 deg/s."""
    return Effect(
        "scale_cubic",
        (Parameter("u^3", "1/(rad/s)2", 3e-2),),
        shared=False,
        shown_by="three rates and more in each direction",
        confused_with=("scale_quadratic",),
        regressors=lambda conditions, axes: np.asarray((conditions.w_rps @ axes.p) ** 3),
    )


def dead_band(width_rps: float) -> Effect:
    """Return a gyro that does not answer rates within a band: -u where abs(u) is at most ``width_rps``."""

    def columns(conditions: Conditions, axes: Axes) -> Floats:
        u = conditions.w_rps @ axes.p
        return np.asarray(np.where(np.abs(u) <= width_rps, -u, 0.0))

    return Effect(
        "dead_band",
        (Parameter("share of the rate that is lost", "1", 1.0),),
        shared=False,
        shown_by="slow turns and ramps through zero",
        confused_with=("scale_asymmetry",),
        regressors=columns,
        needs=frozenset({"gimbals"}),  # a rate measured by another gyro or encoder has steps of its own about zero
    )
