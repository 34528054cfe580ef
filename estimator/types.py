"""The types of arrays that the estimator shares, where flags are true, and in which steps values come."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Stamps = NDArray[np.int64]
"""Instants in ns."""
Flags = NDArray[np.bool_]


def least_steps(steps: Floats, above: float = 1e-9) -> Floats:
    """Return the smallest step of each column (m,) of absolute steps (k, m) above rounding; infinite without one."""
    return np.array([float(column[column > above].min(initial=np.inf)) for column in steps.T])


def runs_of(flags: Flags) -> list[tuple[int, int]]:
    """Return (first, one past the last) of each run of true values in flags (n,), in order."""
    edges = np.flatnonzero(np.diff(flags.astype(np.int8), prepend=0, append=0))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))
