"""Noise that grows with the rate (scale factor noise): variance s0^2 (1 + (g w)^2), as steady rates show it.

Second differences of block means hold neither bias nor scale factor error nor any effect of a steady rate.
"""

import numpy as np
from numpy.typing import NDArray

from estimator.types import Floats

_STEADY = 0.02  # change of rate over three blocks, as a share of the largest rate, that is still steady
_FEWEST = 40
_SHARED = 1.944  # values that tell as much as one: second differences overlap
_BY_CHANCE = 7.5  # natural logarithm of how much more probable growth must be: once in ten thousand by chance
_LARGEST = np.geomspace(0.1, 300.0, 33)  # growth at the largest rate, over the noise at rest
_LEAST_RPS = 1e-12


def weighed(w_rps: Floats, z_rps: Floats, weight: Floats, stretch: NDArray[np.intp]) -> tuple[Floats, float]:
    """Return the weight (b,) of blocks, 1 at rest, and g in s (over rad).

    Of the blocks come rates (b, 3), outputs (b, m), whether they hold data (b,), the stretch they are in (b,).
    """
    growth_s = _growth_of(w_rps, z_rps, weight, stretch)
    return weight / np.hypot(1, growth_s * np.linalg.norm(w_rps, axis=1)), growth_s


def _growth_of(w_rps: Floats, z_rps: Floats, weight: Floats, stretch: NDArray[np.intp]) -> float:
    """Return g, zero where the steady rates do not tell, or noise does not grow beyond chance."""
    speed = np.linalg.norm(w_rps, axis=1)
    size = float(speed.max(initial=0.0))
    if len(weight) < _FEWEST or size <= 0:
        return 0.0
    parts = slice(None, -2), slice(1, -1), slice(2, None)
    known = np.all([(weight[p] > 0) & (stretch[p] == stretch[1:-1]) for p in parts], axis=0)
    around = np.array([w_rps[p] for p in parts])
    steady = known & (np.ptp(around, axis=0).max(axis=1) <= _STEADY * size)
    if steady.sum() < _FEWEST:
        return 0.0
    squares = (z_rps[:-2] - 2 * z_rps[1:-1] + z_rps[2:])[steady] ** 2 + _LEAST_RPS**2
    rate = speed[1:-1][steady] / size
    grown = 1 + (np.append(0.0, _LARGEST)[:, None] * rate) ** 2
    levels = np.log(np.array([np.mean(squares / one[:, None], axis=0) for one in grown]))
    log = -0.5 * (len(rate) * levels.sum(axis=1) + squares.shape[1] * np.log(grown).sum(axis=1)) / _SHARED
    best = int(np.argmax(log))
    return float(_LARGEST[best - 1] / size) if log[best] - log[0] > _BY_CHANCE else 0.0
