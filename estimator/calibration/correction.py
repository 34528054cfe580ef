"""From outputs of gyros to rates of their body: a ``Compensation`` applied to arrays of samples.

Exports write the same computation as source code, and tests hold them to this one.
"""

import numpy as np

from estimator.calibration.compensation import (
    MOST_ITERATIONS,
    TOLERANCE_RPS,
    Compensation,
    CompensationError,
)
from estimator.effects.conditions import Conditions
from estimator.effects.effect import Acts
from estimator.effects.law import functions_of, variables_of
from estimator.types import Floats

_TIMED = frozenset({"lag", "t", "Tdot", "a", "aj", "ak", "jolt"})


def needs_of(of: Compensation) -> frozenset[str]:
    """Return the data that are needed with the samples: "temperature", "specific force", "time"."""
    needed = set[str]().union(*(effect.known.effect(()).needs for effect in of.effects))
    laws = [held.known.law for held in of.effects if held.known.law]
    told = set[str]().union(*map(functions_of, laws), *map(variables_of, laws))
    if told & _TIMED or any(held.acts is Acts.LAG for held in of.effects):
        needed.add("time")
    return frozenset(needed)


def less_added(of: Compensation, rate_rps: Floats, t_s: Floats, *sensed: Floats | None) -> Floats:
    """Return outputs (N, n) in rad/s without bias and without the effects that do not depend on the rate; lags are
    undone.

    ``sensed`` are temperature and specific force, as for ``compensate``; None, or left out, if unknown.
    CompensationError if an effect needs one that is.
    """
    temperature_c, accel_mps2 = (*sensed, None, None)[:2]
    _check(of, temperature_c, accel_mps2)
    conditions = _conditions(t_s, np.zeros((len(t_s), 3)), temperature_c, accel_mps2)
    left = np.array(rate_rps, dtype=np.float64)
    for lag in (effect.values for effect in of.effects if effect.acts is Acts.LAG):
        left += lag[:, 0] * _slope(left, t_s)
    return left + (of.bias_rps - _effects(of, Acts.ADDED, conditions))


def compensate(
    of: Compensation,
    rate_rps: Floats,
    t_s: Floats,
    temperature_c: Floats | None = None,
    accel_mps2: Floats | None = None,
) -> Floats:
    """Return the body rate (N, 3) in rad/s and body axes, from outputs (N, n) in rad/s at instants (N,).

    ``temperature_c`` (N,) in degC and ``accel_mps2`` (N, 3), the specific force in body axes, are needed if an effect
    depends on them. A warm-up starts at the first instant. The rate is that at ``t_s - delay_s``. It is NaN where
    effects of the rate cannot be undone, far beyond the rates at which they were determined.

    CompensationError for gyros that do not span space, and if data are missing.
    """
    left = less_added(of, rate_rps, t_s, temperature_c, accel_mps2)
    w = _inverted(of, left, t_s, temperature_c, accel_mps2)
    if any(effect.acts is Acts.MOTION for effect in of.effects):
        moved = _conditions(t_s, w, temperature_c, accel_mps2, _slope(w, t_s))
        w = _inverted(of, left - _effects(of, Acts.MOTION, moved), t_s, temperature_c, accel_mps2)
    return w


def _check(of: Compensation, temperature_c: Floats | None, accel_mps2: Floats | None) -> None:
    given = {"temperature": temperature_c, "specific force": accel_mps2}
    lacking = [what for what, values in given.items() if values is None and what in needs_of(of)]
    if lacking:
        raise CompensationError(f"correcting the effects of these gyros needs {' and '.join(lacking)}")


def _inverted(
    of: Compensation, outputs: Floats, t_s: Floats, temperature_c: Floats | None, accel_mps2: Floats | None
) -> Floats:
    """Return body rates (N, 3) from outputs (N, n) that hold the rate and its effects only; NaN where iteration
    diverges.

    Without effects of the rate nothing is iterated. Conditions are as for ``compensate``. CompensationError if the
    gyros do not span space.
    """
    solution = of.solution.T
    with np.errstate(over="ignore", invalid="ignore"):  # of infinities, and of rows that come to no end
        w = outputs @ solution
        if not any(effect.acts is Acts.RATE for effect in of.effects):
            return np.asarray(w)
        change = np.full(len(w), np.inf)
        for _ in range(MOST_ITERATIONS):
            before = w
            w = (outputs - _effects(of, Acts.RATE, _conditions(t_s, w, temperature_c, accel_mps2))) @ solution
            change = np.abs(w - before).sum(axis=1)
            if not (change > TOLERANCE_RPS).any():
                break
    w[~(change <= TOLERANCE_RPS)] = np.nan
    return np.asarray(w)


def _effects(of: Compensation, acts: Acts, conditions: Conditions) -> Floats:
    """Return the sum (N, n) of the effects that act in the way ``acts``."""
    added = np.zeros((len(conditions.t_s), len(of.array)))
    for held in of.effects:
        if held.acts is acts:
            effect = held.known.effect(())
            with np.errstate(all="ignore"):  # a law may divide by zero, and samples may be no numbers
                for gyro, values in enumerate(held.values):
                    added[:, gyro] += effect.columns(conditions, of.array, gyro) @ values
    return added


def _conditions(
    t_s: Floats,
    w_rps: Floats,
    temperature_c: Floats | None,
    accel_mps2: Floats | None,
    wdot_rps2: Floats | None = None,
) -> Conditions:
    """Return the conditions for correcting N samples: causal, without a table.

    ``w_rps`` (N, 3) is the rate of the body, ``wdot_rps2`` (N, 3) its derivative, zero if not given. ``temperature_c``
    (N,) stays None if unknown; the specific force ``accel_mps2`` (N, 3) becomes NaN if it is None.
    """
    none = np.empty((len(t_s), 0))
    force = np.full((len(t_s), 3), np.nan) if accel_mps2 is None else accel_mps2
    wdot = np.zeros_like(w_rps) if wdot_rps2 is None else wdot_rps2
    return Conditions(
        t_s=t_s,
        w_rps=w_rps,
        wdot_rps2=wdot,
        angle_rad=none,
        rate_rps=none,
        acceleration_rps2=none,
        gimbals=(),
        specific_force_mps2=force,
        temperature_c=temperature_c,
        causal=True,
    )


def _slope(values: Floats, t_s: Floats) -> Floats:
    """Return the rate of change (N, m) since the previous sample.

    It is zero where unknown: at the first sample, where no time has passed, and beside values that are not finite, so
    that these spoil no other sample.
    """
    step = np.diff(t_s)[:, None]
    slope = np.zeros_like(values)
    with np.errstate(invalid="ignore"):  # of infinities
        change = np.diff(values, axis=0)
    np.divide(change, step, out=slope[1:], where=(step > 0) & np.isfinite(change))
    return slope
