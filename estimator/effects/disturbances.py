"""Disturbances: tones, a random walk of the bias, faults of the data."""

import numpy as np

from estimator.effects.conditions import Axes, Conditions
from estimator.effects.dynamics import LATENCY
from estimator.effects.effect import Settings, family
from estimator.types import Floats


def _waves(settings: Settings, conditions: Conditions, axes: Axes) -> Floats:
    """Return the columns (N, 2) of cosine and sine of ``frequency_hz``, from the instant 0 on."""
    turning_rps = 2 * np.pi * float(settings["frequency_hz"])
    phase = turning_rps * conditions.t_s
    return np.column_stack([np.cos(phase), np.sin(phase)])


RECORDS = TONE, BIAS_WALK, SAMPLE_HOLD, SATURATION, STUCK = family(
    "disturbances", tone={"regressors": _waves}, sample_hold={"regressors": LATENCY.regressors}
)
