"""Runs of one device against each other: do its states scatter by what each run's own sigma says?

What differs between runs beyond that (switch-on bias, remounting) is the device's repeatability; it is estimated by
the method of moments (DerSimonian, Laird 1986). Only noise is compared: what is wrong with the table is wrong in
every run alike.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.calibration.values import GyroCalibration
from estimator.types import Floats

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
    names = [gyro.name for gyro in runs[0] if all(any(g.name == gyro.name for g in run) for run in runs)]
    found = []
    for name in names:
        own = [next(g for g in run if g.name == name) for run in runs]
        states = np.array([g.states for g in own])
        # Another draw in another run; what the table does is the same in all.
        noise = np.array([np.sqrt(np.diag(g.type_a)) for g in own])
        squares, spread = _moments(states, noise)
        found.append(
            Repeatability(
                name,
                len(own),
                states.mean(axis=0),
                states.std(axis=0, ddof=1),
                np.sqrt((noise**2).mean(axis=0)),
                np.sqrt(np.maximum(squares - (len(own) - 1), 0.0) / spread),
                _beyond_chance(squares, len(own) - 1),
            )
        )
    return found


def between_runs(states: Floats, sd: Floats) -> Floats:
    """Return the standard deviation (4,) of what is between runs of a device, from those of its gyros (runs, n, 4).

    Zero where chance would give as much.
    """
    dof = states.shape[1] * (len(states) - 1)
    squares, spread = np.sum(_moments(states, sd), axis=1)
    return np.where(_beyond_chance(squares, dof), np.sqrt(np.maximum(squares - dof, 0.0) / spread), 0.0)


def _moments(states: Floats, sd: Floats) -> tuple[Floats, Floats]:
    """Return squares of states (runs, ...) about their weighted mean over runs, and the spread of the weights."""
    weight = 1 / sd**2
    whole = weight.sum(axis=0)
    mean = (weight * states).sum(axis=0) / whole
    return (weight * (states - mean) ** 2).sum(axis=0), whole - (weight**2).sum(axis=0) / whole


def _beyond_chance(squares: Floats, dof: int) -> NDArray[np.bool_]:
    from scipy.stats import chi2  # 0.8 s of import: only where runs are compared

    return np.asarray(chi2.sf(squares, dof) < _BY_CHANCE)


def same_device(a: Sequence[GyroCalibration], b: Sequence[GyroCalibration]) -> bool:
    """Return whether two runs are of one device as far as they say: the same gyros along the same axes."""
    return [g.name for g in a] == [g.name for g in b] and all(
        np.allclose(x.p, y.p, atol=1e-6) for x, y in zip(a, b, strict=True)
    )
