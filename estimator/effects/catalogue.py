"""The catalogue: every effect that is looked for, with nominal values of what is not linear."""

from collections.abc import Sequence

from estimator.effects.drift import bias_drift, bias_step, warm_up
from estimator.effects.dynamics import acceleration_sensitivity, bandwidth, latency, tone
from estimator.effects.effect import Effect
from estimator.effects.scale import scale_asymmetry, scale_cubic, scale_quadratic
from estimator.effects.site import earth_rate, g_sensitivity
from estimator.effects.table import table_axes, table_harmonic, table_rate
from estimator.effects.thermal import thermal_bias, thermal_bias_quadratic, thermal_gradient, thermal_scale

HARMONICS = (1, 2, 4)
"""Orders of the table's angles that bearings, balance and magnets make."""
TONE_HZ = 2.3
"""Nominal frequency of a tone: below half the rate of every source, and no multiple of a script's steps."""


def catalogue(gimbals: Sequence[str], duration_s: float) -> tuple[Effect, ...]:
    """Return all effects for a table with these gimbals; a bias step is put into the middle of the run."""
    return (
        earth_rate(),
        g_sensitivity(),
        thermal_bias(),
        thermal_bias_quadratic(),
        thermal_scale(),
        thermal_gradient(),
        bias_drift(),
        warm_up(),
        bias_step(duration_s / 2),
        scale_asymmetry(),
        scale_quadratic(),
        scale_cubic(),
        latency(),
        bandwidth(),
        acceleration_sensitivity(),
        *(table_harmonic(gimbals, order) for order in HARMONICS),
        table_axes(gimbals),
        table_rate(gimbals),
        tone(TONE_HZ),
    )
