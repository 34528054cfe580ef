"""Effects of where the table stands: the turning Earth and its gravity."""

import numpy as np

from estimator.effects.conditions import Conditions
from estimator.effects.effect import Axes, Effect, Parameter
from estimator.geometry.kinematics import EARTH_RATE_RPS, GRAVITY_MPS2, into_body
from estimator.types import Floats


def earth_rate() -> Effect:
    """Return Earth rate beyond what the model holds, as three components in the base frame.

    Without a site that is all of it, with one what its latitude and heading are wrong by.
    """

    def columns(conditions: Conditions, axes: Axes) -> Floats:
        turned = [into_body(base, conditions.angle_rad, conditions.gimbals) for base in np.eye(3)]
        return np.column_stack([component @ axes.p for component in turned])

    return Effect(
        "earth_rate",
        tuple(Parameter(f"along base {axis}", "rad/s", EARTH_RATE_RPS) for axis in "xyz"),
        shared=True,
        shown_by="tilts and turns, which change how it lies in the body",
        confused_with=("g_sensitivity", "table_harmonic_1"),
        regressors=columns,
        needs=frozenset({"gimbals"}),
    )


def earth_rate_upward() -> Effect:
    """Return the part of Earth rate along the upward direction: all that rests tell whose headings are not known."""
    return Effect(
        "earth_rate",
        (Parameter("upward", "rad/s", EARTH_RATE_RPS),),
        shared=True,
        shown_by="rests with other sides up",
        confused_with=("g_sensitivity",),
        regressors=lambda conditions, axes: np.asarray(conditions.specific_force_mps2 @ axes.p / GRAVITY_MPS2),
        needs=frozenset({"specific force"}),
    )


def g_sensitivity() -> Effect:
    """Return what specific force along each body axis adds, per g.

    Up to 0.1 deg/s/g for automotive MEMS gyros (Analog Devices ADXRS6xx data sheets), 1 to 10 deg/h/g for tactical ones
    (Sensonor STIM300).
    """
    return Effect(
        "g_sensitivity",
        tuple(Parameter(f"along body {axis}", "rad/s/g", float(np.radians(0.1))) for axis in "xyz"),
        shared=False,
        shown_by="turns about horizontal axes, tilted rests",
        confused_with=("earth_rate", "table_harmonic_1"),
        regressors=lambda conditions, axes: conditions.specific_force_mps2 / GRAVITY_MPS2,
        needs=frozenset({"specific force"}),
    )
