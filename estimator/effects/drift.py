"""Biases that change with time by a law."""

import numpy as np

from estimator.effects.effect import Effect, Parameter

_LARGEST_RPS = float(np.radians(0.5))  # turn-on transients of consumer MEMS gyros


def bias_drift() -> Effect:
    """Return a bias that grows in proportion to time since the start: up to 1 deg/s an hour."""
    return Effect(
        "bias_drift",
        (Parameter("slope", "rad/s2", float(np.radians(1 / 3600))),),
        shared=False,
        shown_by="rests at the start, in the middle and at the end",
        confused_with=("thermal_bias", "warm_up", "bias_step"),
        regressors=lambda conditions, axes: np.asarray(conditions.t_s - conditions.t_s[0]),
    )


def warm_up(tau_s: float = 120.0) -> Effect:
    """Return a bias that settles with time constant ``tau_s`` after the start: 1 - exp(-t / tau)."""
    return Effect(
        "warm_up",
        (Parameter(f"with {tau_s:g} s", "rad/s", _LARGEST_RPS),),
        shared=False,
        shown_by="rests at the start, in the middle and at the end",
        confused_with=("thermal_bias", "bias_drift"),
        regressors=lambda conditions, axes: np.asarray(-np.expm1(-(conditions.t_s - conditions.t_s[0]) / tau_s)),
    )


def bias_step(at_s: float) -> Effect:
    """Return a bias that jumps at an instant."""
    return Effect(
        "bias_step",
        (Parameter(f"at {at_s:g} s", "rad/s", _LARGEST_RPS),),
        shared=False,
        shown_by="the same rate or rest before and after",
        confused_with=("bias_drift", "warm_up"),
        regressors=lambda conditions, axes: np.asarray(conditions.t_s >= at_s, dtype=np.float64),
    )
