"""The types of arrays that drivers, twins and the station share."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Stamps = NDArray[np.int64]
"""Instants in ns."""
Flags = NDArray[np.bool_]
Octets = NDArray[np.uint8]
