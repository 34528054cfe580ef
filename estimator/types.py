"""The types of arrays that the estimator shares, and where flags are true."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Stamps = NDArray[np.int64]
"""Instants in ns."""
Flags = NDArray[np.bool_]


def runs_of(flags: Flags) -> list[tuple[int, int]]:
    """Return where each run of true values starts and ends."""
    edges = np.flatnonzero(np.diff(flags.astype(np.int8), prepend=0, append=0))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))
