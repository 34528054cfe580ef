"""Runs of one device compared: whether its states scatter as each run's own sigma predicts.

What differs between runs beyond that (switch-on bias, remounting) is the device's repeatability; it is estimated by the
method of moments (DerSimonian, Laird 1986). Only noise is compared: what is wrong with the table is wrong in every run
alike. ``gauge_study`` asks the same of the station, over its runs of many devices.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.calibration.gyro import GyroCalibration
from estimator.types import Floats

_BY_CHANCE = 0.001
_OUTSIDE = 0.05  # of the interval of a ratio


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class Repeatability:
    """States of one gyro over ``runs`` runs, each (4,): mean, scatter, expected scatter, scatter between runs.

    ``differs`` marks a scatter that chance gives in less than one of a thousand such sets.
    """

    name: str
    runs: int
    mean: Floats
    scatter: Floats
    expected: Floats
    between: Floats
    differs: NDArray[np.bool_]


def repeatability(runs: Sequence[Sequence[GyroCalibration]]) -> list[Repeatability]:
    """Return how well each gyro repeats over two or more runs of one device; gyros that are not in all runs are left
    out.

    The order is that of the first run. The expected scatter is that of the noise alone (type A): the errors of a table
    are the same in all runs.
    """
    names = [gyro.name for gyro in runs[0] if all(any(g.name == gyro.name for g in run) for run in runs)]
    found = []
    for name in names:
        own = [next(g for g in run if g.name == name) for run in runs]
        states = np.array([g.states for g in own])
        # Noise is drawn anew in each run; the table's errors are the same in all.
        noise = np.array([np.sqrt(np.diag(g.type_a)) for g in own])
        squares, spread = _moments(states, noise)
        found.append(
            Repeatability(
                name=name,
                runs=len(own),
                mean=states.mean(axis=0),
                scatter=states.std(axis=0, ddof=1),
                expected=np.sqrt((noise**2).mean(axis=0)),
                between=np.sqrt(np.maximum(squares - (len(own) - 1), 0.0) / spread),
                differs=_beyond_chance(squares, len(own) - 1),
            )
        )
    return found


def between_runs(states: Floats, sd: Floats) -> Floats:
    """Return the standard deviation (4,) between the runs of a device, from states and sigmas of its gyros (runs, n,
    4).

    It is one for all gyros, from two runs or more. Zero where chance gives as much scatter.
    """
    dof = states.shape[1] * (len(states) - 1)
    squares, spread = np.sum(_moments(states, sd), axis=1)
    return np.where(_beyond_chance(squares, dof), np.sqrt(np.maximum(squares - dof, 0.0) / spread), 0.0)


@np.errstate(all="ignore")  # of values that are none come figures that are none
def gauge_study(values: Floats, sd: Floats, parts: Sequence[str], conditions: Sequence[str]) -> dict[str, Floats]:
    """Return standard deviations (states,) from values and their stated sigmas (runs, states), some runs repeated.

    ``parts`` and ``conditions`` label the runs. Keys of the result:

    - ``repeatability``: within one part and condition, with ``dof`` degrees of freedom
    - ``reproducibility``: between conditions
    - ``parts``: between parts
    - ``grr``: share of the first two in the total
    - ``ratio``: repeatability over the rms sigma; ``ratio_low``, ``ratio_high``: its 95 % interval (chi-square;
      Satterthwaite)

    A value is NaN where the runs do not tell it. Random effects by the method of moments (Henderson 1953, method 1);
    with equal counts this is the two-way ANOVA of AIAG, Measurement Systems Analysis, 4th ed., III.B. An interaction
    that is not above zero counts as repeatability.
    """
    from scipy.stats import chi2

    x = values - values.mean(axis=0)
    index = tuple(np.unique(labels, return_inverse=True)[1] for labels in (parts, conditions))
    n = np.zeros([at.max() + 1 for at in index])
    sums = np.zeros((*n.shape, x.shape[1]))
    np.add.at(n, index, 1)
    np.add.at(sums, index, x)
    if np.count_nonzero(n) == len(n):  # each part met one condition: they cannot be distinguished
        n, sums = n.sum(axis=1, keepdims=True), sums.sum(axis=1, keepdims=True)
    rows, squares = [], []
    factors = ((1,), (0,), ())  # parts, conditions, both: the axes that their groups are summed over
    for group in (*factors, (0, 1)):
        size = np.maximum(n.sum(axis=group, keepdims=True), 1)
        shared = [n.sum(axis=tuple({*group} & {*factor}), keepdims=True) for factor in factors]
        rows.append([*(np.sum(m**2 / size) for m in shared), np.count_nonzero(n.sum(axis=group))])
        squares.append((sums.sum(axis=group, keepdims=True) ** 2 / size[..., None]).sum(axis=(0, 1)))
    # Contribution of the variances of parts, conditions, both and runs to the squares of each, and these squares.
    a, b = np.array([*rows[:3], [len(x)] * 4]) - rows[3], np.array([*squares[:3], (x**2).sum(axis=0)])
    of_parts, of_conditions, of_both = (row[3] for row in rows[:3])
    kept = [0, 1, 3] if of_conditions > 1 else [0, 3]
    found, dof = np.zeros_like(b), len(x) - of_parts - of_conditions + 1
    found[kept] = np.linalg.pinv(a[np.ix_(kept, kept)]) @ b[kept]
    full = np.linalg.pinv(a) @ b
    mixed = (full[2] > 0) & (of_conditions > 1)
    variances, dofs = np.maximum(np.where(mixed, full, found), 0.0), np.where(mixed, len(x) - of_both, dof)
    if of_both == of_conditions > 1:  # each condition met one part
        variances[:3] = np.nan
    of_part, ours, e = variances[0], variances[1:].sum(axis=0), variances[3]
    between = ours - e if of_conditions > 1 else np.full_like(e, np.nan)
    ratio = np.sqrt(e / (sd**2).mean(axis=0))
    alike = dofs * (sd**2).mean(axis=0) ** 2 / (sd**4).mean(axis=0)
    low, high = (ratio * np.sqrt(alike / chi2.isf(tail, alike)) for tail in (_OUTSIDE / 2, 1 - _OUTSIDE / 2))
    roots = {"repeatability": e, "reproducibility": between, "parts": of_part, "grr": ours / (ours + of_part)}
    told = {key: np.sqrt(value) for key, value in roots.items()}
    return {**told, "dof": dofs, "ratio": ratio, "ratio_low": low, "ratio_high": high}


def _moments(states: Floats, sd: Floats) -> tuple[Floats, Floats]:
    """Return the weighted squares (...) of states (runs, ...) about their weighted mean over runs, and the spread of
    the weights: by so much the squares grow per unit of variance between runs.
    """
    weight = 1 / sd**2
    whole = weight.sum(axis=0)
    mean = (weight * states).sum(axis=0) / whole
    return (weight * (states - mean) ** 2).sum(axis=0), whole - (weight**2).sum(axis=0) / whole


def _beyond_chance(squares: Floats, dof: int) -> NDArray[np.bool_]:
    from scipy.special import chdtrc  # of the chi-square; scipy.stats takes a second to import

    return np.asarray(chdtrc(dof, squares) < _BY_CHANCE)
