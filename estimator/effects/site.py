"""Effects of where the table stands: the turning Earth and its gravity."""

from dataclasses import replace

import numpy as np

from estimator.effects.conditions import Axes, Conditions
from estimator.effects.effect import Parameter, Record, Regressors, Settings
from estimator.geometry.kinematics import EARTH_RATE_RPS, into_body
from estimator.types import Floats

_MISSED = 0.3  # by which the length of Earth rate may come out larger than it is


def _of_the_base(settings: Settings) -> Regressors:
    """Return Earth rate beyond what the model holds, as three components in the base frame.

    Without a site that is all of it, with one what its latitude and heading are wrong by.
    """

    def columns(conditions: Conditions, axes: Axes) -> Floats:
        turned = [into_body(base, conditions.angle_rad, conditions.gimbals) for base in np.eye(3)]
        return np.column_stack([component @ axes.p for component in turned])

    return columns


RECORDS = (
    EARTH_RATE := Record(
        name="earth_rate",
        parameters=tuple(Parameter(f"along base {axis}", "rad/s", EARTH_RATE_RPS) for axis in "xyz"),
        regressors=_of_the_base,
        formula="component of Earth rate along the sense axis",
        shared=True,
        shown_by="tilts and turns, which change how it lies in the body",
        confused_with=("g_sensitivity", "table_harmonic_1"),
        depends_on="angle",
        suspected_of=("gravity",),
        needs=frozenset({"gimbals"}),
        plausible=lambda sizes: bool(np.linalg.norm(sizes[0]) < 1 + _MISSED),  # it is as long as it is
        left_out="it is Earth rate that the site of the table lacked: the gyros sense it rightly",
    ),
    # Up to 0.1 deg/s/g for automotive MEMS gyros (Analog Devices ADXRS6xx data sheets), 1 to 10 deg/h/g for tactical
    # ones (Sensonor STIM300).
    G_SENSITIVITY := Record(
        name="g_sensitivity",
        parameters=tuple(Parameter(f"along body {axis}", "rad/s/g", float(np.radians(0.1))) for axis in "xyz"),
        law="gx; gy; gz",
        shown_by="turns about horizontal axes, tilted rests",
        confused_with=("earth_rate", "table_harmonic_1"),
        depends_on="gravity",
        suspected_of=("gravity", "angle"),
    ),
)
EARTH_RATE_UPWARD = replace(
    EARTH_RATE,
    parameters=(Parameter("upward", "rad/s", EARTH_RATE_RPS),),
    law="gs",
    regressors=None,
    shown_by="rests with other sides up",
    confused_with=("g_sensitivity",),
    needs=frozenset(),
)
"""All that rests tell of Earth rate whose headings are not known: its part along the upward direction."""
