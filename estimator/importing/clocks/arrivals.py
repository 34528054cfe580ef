"""Whether stamps are of samples or of their arrival: the motion decides between two sets of instants."""

from collections.abc import Sequence

import numpy as np

from estimator.geometry.array import SensorArray
from estimator.observations.alignment import following
from estimator.recordings.recording import ImuData
from estimator.recordings.reference import Reference
from estimator.types import Floats, Stamps

_BETTER = 0.05  # natural logarithm by which the residual must be smaller to prefer it to the stamps

Instants = tuple[Stamps, Reference]
"""When the samples of gyros were taken, and a reference."""


def by_motion(array: SensorArray, rate_rps: Floats, tried: Sequence[Instants]) -> int:
    """Return which of some pairs of instants (samples, reference) fits the motion best; the first if in doubt."""
    left = [_left(ImuData(array, t_ns, rate_rps), reference) for t_ns, reference in tried]
    best = int(np.argmin(left))
    return best if left[best] < left[0] - _BETTER else 0


def _left(data: ImuData, reference: Reference) -> float:
    """Return the mean logarithm of the outputs' scatter about the reference, infinite if they do not follow it."""
    line = following(data, reference, None)
    if line is None:
        return np.inf
    return float(np.mean(np.log(line.scatter_rps)))
