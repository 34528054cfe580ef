"""Effects of temperature. Without a temperature they are nothing: their columns are zero."""

from estimator.effects.effect import family

RECORDS = THERMAL_BIAS, THERMAL_BIAS_QUADRATIC, THERMAL_SCALE, THERMAL_GRADIENT = family("thermal")
