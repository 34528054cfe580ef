"""Effects of where the table stands: the turning Earth and its gravity."""

from dataclasses import replace

import numpy as np

from estimator.effects.conditions import Axes, Conditions
from estimator.effects.effect import Parameter, Settings, family
from estimator.geometry.kinematics import EARTH_RATE_RPS, into_body
from estimator.types import Floats

_MISSED = 0.3  # by which the length of Earth rate may come out larger than it is


def _of_the_base(settings: Settings, conditions: Conditions, axes: Axes) -> Floats:
    """Return the columns (N, 3) of Earth rate as three components along x, y, z of the base."""
    return conditions.once("axes of the base", lambda: _base_in_body(conditions)) @ axes.p


def _base_in_body(conditions: Conditions) -> Floats:
    """Return the three axes of the base in body axes (N, 3, 3): instant, axis of the base, component."""
    turned = [into_body(base, conditions.angle_rad, conditions.gimbals) for base in np.eye(3)]
    return np.stack(turned, axis=1)


RECORDS = EARTH_RATE, G_SENSITIVITY = family(
    "site",
    earth_rate={
        "parameters": tuple(Parameter(f"along base {axis}", "rad/s", EARTH_RATE_RPS) for axis in "xyz"),
        "regressors": _of_the_base,
        "plausible": lambda sizes: bool(np.linalg.norm(sizes[0]) < 1 + _MISSED),  # its length is fixed
    },
)
_UPWARD = (Parameter("upward", "rad/s", EARTH_RATE_RPS),)
EARTH_RATE_UPWARD = replace(EARTH_RATE, parameters=_UPWARD, law="gs", regressors=None, needs=frozenset())
"""All that rests tell of Earth rate whose headings are not known: its part along the upward direction."""
