"""Parity of a redundant array: comparison of its calibrated gyros with each other, without the table.

With n > 3 gyros there are n - 3 combinations of outputs in which the body rate cancels (the left null space of the
calibrated sense axes). A gyro that fails shows there at once. With four gyros there is one such combination: it tells
that one of the four is wrong, not which; from five on it tells which (Potter and Suman 1977).
"""

from collections.abc import Sequence

import numpy as np

from estimator.calibration.values import GyroParity
from estimator.geometry.array import SensorArray
from estimator.geometry.noise import NoiseModel
from estimator.observations.blocks import Blocks
from estimator.types import Floats

_MOST_BLOCKS, _FINEST_S = 200, 1.0
_SUSPECT = 5.0  # sigmas of a mean over one block: chance gives it in one of a million


def parity(
    arrays: Sequence[SensorArray],
    blocks: Sequence[Blocks],
    states: Floats,
    noise: Sequence[NoiseModel],
    growth_s: float = 0.0,
    sources: Sequence[str] = (),
) -> list[GyroParity]:
    """Return the parity check of each gyro of a device, in the order of ``arrays``.

    ``arrays`` and ``blocks`` are those of its sources, ``states`` (n, 4) and ``noise`` (n) those of all its gyros;
    ``growth_s`` says how the noise grows with the rate (``runs.measured``); ``sources`` (n) names the source of each
    gyro. A gyro is suspect from 5 sigma on in the mean over a second or more. The list is empty for fewer than four
    gyros or no common blocks, and leaves out a gyro that no combination of the others checks.
    """
    names = [name for array in arrays for name in array.names]
    if len(names) < 4 or not all(len(b.index) for b in blocks):
        return []
    p, j, k = (np.vstack([getattr(array, axis) for array in arrays]) for axis in "pjk")
    sense = (1 - states[:, :1]) * (p - states[:, 3:4] * j + states[:, 2:3] * k)
    blocks = _coarse(blocks)
    common = blocks[0].index
    for other in blocks[1:]:
        common = np.intersect1d(common, other.index)
    if not len(common):
        return []
    chosen = [b.select(np.isin(b.index, common)) for b in blocks]
    # Each against the body rate of its own samples, which at the ends of a block are not those of another source.
    own = np.split(p - sense, np.cumsum([len(array) for array in arrays[:-1]]))
    rest = np.hstack([b.z_rps + b.w_rps @ a.T for a, b in zip(own, chosen, strict=True)]) + states[:, 1]
    length_s = chosen[0].length_s
    span_s = length_s * float(common[-1] - common[0] + 1)
    variances = [n.arw**2 / length_s + 2 * n.instability**2 + n.walk**2 * span_s / 3 for n in noise]
    # A fault passes for noise of the gyro that has it: none is taken for much noisier than its neighbours.
    sigma = np.sqrt(np.minimum(variances, 2 * np.median(variances)))
    held_s = np.min([b.held_s for b in chosen], axis=0)
    # Outputs in units of their noise: then the null space weighs gyros as they deserve.
    left, singular, _ = np.linalg.svd(sense / sigma[:, None], full_matrices=True)
    null = left[:, len(singular) :].T
    grown = np.hypot(1, growth_s * np.linalg.norm(chosen[0].w_rps, axis=1))
    residual = (rest / sigma) @ null.T * (np.sqrt(held_s / length_s) / grown)[:, None]
    checks, sizes = [], np.linalg.norm(null, axis=0)
    for name, source, column, size in zip(names, sources or [""] * len(names), null.T, sizes, strict=True):
        if size < 1e-6:
            continue
        fault = np.abs(residual @ column) / size
        worst = int(np.argmax(fault))
        alike = np.abs(column @ null) >= 0.999 * size * sizes  # itself, and those that it cannot be distinguished from
        checks.append(
            GyroParity(
                name=name,
                rms_sigma=float(np.sqrt(np.mean(fault**2))),
                worst_sigma=float(fault[worst]),
                worst_t_s=float((common[worst] + 0.5) * length_s),
                suspect=bool(fault[worst] > _SUSPECT),
                told_apart=bool(alike.sum() == 1),
                source=source,
            )
        )
    return checks


def _coarse(blocks: Sequence[Blocks]) -> list[Blocks]:
    """Return blocks merged to a second or more, at most 200: a fault that lasts shows better in these.

    All sources get the same factor, so that a block number means the same time in all. Blocks less than half full are
    left out.
    """
    span = max(int(own.index[-1] - own.index[0]) + 1 for own in blocks)
    factor = max(round(_FINEST_S / blocks[0].length_s), -(-span // _MOST_BLOCKS), 1)
    merged = [own.merged(factor) for own in blocks]
    return [own.select(2 * own.held_s >= own.length_s) for own in merged]
