"""The error model undone sample by sample: what every exported form must come to, from the effects' own regressors."""

from __future__ import annotations

import numpy as np

from estimator.arrays import Floats
from estimator.compensation import MOST_ITERATIONS, TOLERANCE_RPS, Acts, Compensation, CompensationError
from estimator.effects.conditions import Conditions


def compensate(
    own: Compensation,
    rate_rps: Floats,
    t_s: Floats,
    temperature_c: Floats | None = None,
    accel_mps2: Floats | None = None,
) -> Floats:
    """Return the rate (N, 3) of the body in rad/s and body axes from outputs (N, n) in rad/s at instants (N,).

    ``temperature_c`` (N,) in degC and ``accel_mps2`` (N, 3), the specific force in body axes, are needed where an
    effect depends on them. A warm-up counts from the first instant. The rate is that at ``t_s - delay_s``. It is
    NaN where effects of the rate cannot be undone, which is far beyond the rates that they were found at.

    Raises CompensationError for gyros that do not span space, and if something is lacking.
    """
    left = less_added(own, rate_rps, t_s, temperature_c, accel_mps2)
    w = _inverted(own, left, t_s, temperature_c, accel_mps2)
    if any(effect.acts is Acts.MOTION for effect in own.effects):
        moved = _conditions(t_s, w, temperature_c, accel_mps2, _slope(w, t_s))
        w = _inverted(own, left - _effects(own, Acts.MOTION, moved), t_s, temperature_c, accel_mps2)
    return w


def less_added(
    own: Compensation,
    rate_rps: Floats,
    t_s: Floats,
    temperature_c: Floats | None = None,
    accel_mps2: Floats | None = None,
) -> Floats:
    """Return outputs (N, n) in rad/s rid of bias and of all effects that do not depend on the rate; as above."""
    given = {"temperature": temperature_c, "specific force": accel_mps2}
    lacking = [what for what, values in given.items() if values is None and what in own.needs]
    if lacking:
        raise CompensationError(f"the effects of these gyros cannot be undone without {' and '.join(lacking)}")
    conditions = _conditions(t_s, np.zeros((len(t_s), 3)), temperature_c, accel_mps2)
    left = np.array(rate_rps, dtype=np.float64)
    lag = own.held("bandwidth")
    if lag is not None:
        left += lag[:, 0] * _slope(left, t_s)
    return left + (own.bias_rps - _effects(own, Acts.ADDED, conditions))


def _inverted(
    own: Compensation, left: Floats, t_s: Floats, temperature_c: Floats | None, accel_mps2: Floats | None
) -> Floats:
    """Return body rates (N, 3) from outputs (N, n) that only the rate has a part in."""
    solution = own.solution.T
    with np.errstate(over="ignore", invalid="ignore"):  # of infinities, and of rows that come to no end
        w = left @ solution
        if not any(effect.acts is Acts.RATE for effect in own.effects):
            return np.asarray(w)
        change = np.full(len(w), np.inf)
        for _ in range(MOST_ITERATIONS):
            before = w
            w = (left - _effects(own, Acts.RATE, _conditions(t_s, w, temperature_c, accel_mps2))) @ solution
            change = np.abs(w - before).sum(axis=1)
            if not (change > TOLERANCE_RPS).any():
                break
    w[~(change <= TOLERANCE_RPS)] = np.nan
    return np.asarray(w)


def _effects(own: Compensation, acts: Acts, conditions: Conditions) -> Floats:
    """Return what effects that act like this add to the outputs (N, n), by their own regressors."""
    added = np.zeros((len(conditions.t_s), len(own.array)))
    for held in own.effects:
        if held.acts is acts:
            effect = held.known.effect(())
            with np.errstate(all="ignore"):  # a law may divide by zero, and samples may be no numbers
                for gyro, values in enumerate(held.values):
                    added[:, gyro] += effect.columns(conditions, own.array, gyro) @ values
    return added


def _conditions(
    t_s: Floats,
    w_rps: Floats,
    temperature_c: Floats | None,
    accel_mps2: Floats | None,
    wdot_rps2: Floats | None = None,
) -> Conditions:
    none = np.empty((len(t_s), 0))
    force = np.full((len(t_s), 3), np.nan) if accel_mps2 is None else accel_mps2
    wdot = np.zeros_like(w_rps) if wdot_rps2 is None else wdot_rps2
    return Conditions(t_s, w_rps, wdot, none, none, none, (), force, temperature_c, causal=True)


def _slope(values: Floats, t_s: Floats) -> Floats:
    """Return the rate of change (N, m) since the sample before.

    It is zero where it is not known: at the first, where no time has passed, and beside what is no number, so that
    such a sample spoils no other.
    """
    step = np.diff(t_s)[:, None]
    slope = np.zeros_like(values)
    with np.errstate(invalid="ignore"):  # of infinities
        change = np.diff(values, axis=0)
    np.divide(change, step, out=slope[1:], where=(step > 0) & np.isfinite(change))
    return slope
