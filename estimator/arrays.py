"""The types of arrays that the estimator shares."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Stamps = NDArray[np.int64]
"""Instants in ns."""
Flags = NDArray[np.bool_]
