"""When samples were taken against when the table was read: the offset between the two, from a run's own ramps."""

from dataclasses import dataclass

import numpy as np

from estimator.array import SensorArray
from estimator.arrays import Floats
from estimator.blocks import Blocks
from estimator.model import Prior, regressor_maps

_EXPECTED_S = 0.1  # no offset is expected beyond this
_WORST_SD_S = 0.01  # a run that tells no better has no ramps to tell by


@dataclass(frozen=True, slots=True)
class TimeOffset:
    """By how much samples lie later than the readings of the table, in s, with its standard uncertainty."""

    offset_s: float
    sd_s: float


def time_offset(blocks: Blocks, array: SensorArray, prior: Prior) -> TimeOffset | None:
    """Return the offset of a source against the table, beside the states; None where a run has no ramps to tell.

    Least squares of the output error on the columns of the states, of each gyro its own, and on the angular
    acceleration along the sense axes, which all gyros share: a sample that is stamped late shows the rate of before.
    A delay within the gyros is part of the offset.
    """
    t_s, rows = blocks.t_s, blocks.rows.astype(np.float64)
    if len(t_s) < 20:
        return None
    acceleration = np.gradient(blocks.w_rps, t_s, axis=0)
    near = np.append(np.diff(t_s) < 1.5 * blocks.length_s, False)
    near &= np.append(False, near[:-1])  # a gap has no slope
    one = np.column_stack([np.ones(len(t_s)), blocks.w_rps])
    precision = np.diag(1 / prior.variances())
    square, product, rest = 1 / _EXPECTED_S**2, 0.0, list[Floats]()
    for gyro, regressor in enumerate(regressor_maps(array)):
        z = blocks.z_rps[near, gyro]
        white = float(np.median(np.abs(np.diff(z)))) / (0.6745 * np.sqrt(2))
        if not white > 0:
            return None
        scale = np.sqrt(rows[near] / np.median(rows)) / white
        h = (one @ regressor.T)[near] * scale[:, None]
        both = np.column_stack([-(acceleration @ array.p[gyro])[near], z]) * scale[:, None]
        both -= h @ np.linalg.solve(h.T @ h + precision, h.T @ both)
        square += float(both[:, 0] @ both[:, 0])
        product += float(both[:, 0] @ both[:, 1])
        rest.append(both)
    offset, sd = product / square, square**-0.5
    if not sd < _WORST_SD_S:
        return None
    left = sum(float(np.sum((both[:, 1] - offset * both[:, 0]) ** 2)) for both in rest)
    count = sum(len(both) for both in rest)
    return TimeOffset(offset, sd * float(np.sqrt(max(left / count, 1.0))))
