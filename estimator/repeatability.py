"""Runs of one device against each other: do its states scatter by what each run's own sigma says?

What differs between runs beyond that (switch-on bias, remounting) is the device's repeatability; it is estimated by
the method of moments (DerSimonian, Laird 1986). Only noise is compared: what is wrong with the table is wrong in
every run alike.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Floats
from estimator.budget import TYPE_A
from estimator.calibration import GyroCalibration

_BY_CHANCE = 0.001


@dataclass(frozen=True, slots=True, eq=False)
class Repeatability:
    """States of one gyro over ``runs`` runs, each (4,): mean, scatter, expected scatter, what is between runs.

    ``differs``: scatter that chance gives in less than one of a thousand such sets.
    """

    name: str
    runs: int
    mean: Floats
    scatter: Floats
    expected: Floats
    between: Floats
    differs: NDArray[np.bool_]


def repeatability(runs: Sequence[Sequence[GyroCalibration]]) -> list[Repeatability]:
    """Return how each gyro repeats over two runs or more of one device; gyros that are not in all are left out."""
    from scipy.stats import chi2  # 0.8 s of import: only where runs are compared

    names = [gyro.name for gyro in runs[0] if all(any(g.name == gyro.name for g in run) for run in runs)]
    found = []
    for name in names:
        own = [next(g for g in run if g.name == name) for run in runs]
        states = np.array([g.states for g in own])
        noise = np.array([_type_a(g) for g in own])
        weight = 1 / noise**2
        mean = (weight * states).sum(axis=0) / weight.sum(axis=0)
        squares = (weight * (states - mean) ** 2).sum(axis=0)
        excess = squares - (len(own) - 1)
        spread = weight.sum(axis=0) - (weight**2).sum(axis=0) / weight.sum(axis=0)
        found.append(
            Repeatability(
                name,
                len(own),
                states.mean(axis=0),
                states.std(axis=0, ddof=1),
                np.sqrt((noise**2).mean(axis=0)),
                np.sqrt(np.maximum(excess, 0.0) / spread),
                np.asarray(chi2.sf(squares, len(own) - 1) < _BY_CHANCE),
            )
        )
    return found


def _type_a(gyro: GyroCalibration) -> Floats:
    """Return what of the sigmas (4,) is another draw in another run; what the table does is the same in all."""
    parts = [line.u**2 for line in gyro.budget if line.name in TYPE_A]
    return np.sqrt(np.sum(parts, axis=0)) if parts else gyro.sd


def same_device(a: Sequence[GyroCalibration], b: Sequence[GyroCalibration]) -> bool:
    """Return whether two runs are of one device as far as they say: the same gyros along the same axes."""
    return [g.name for g in a] == [g.name for g in b] and all(
        np.allclose(x.p, y.p, atol=1e-6) for x, y in zip(a, b, strict=True)
    )
