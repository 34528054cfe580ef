"""The error of a model that its own covariance says: what a verification run is compared with."""

from collections.abc import Sequence

import numpy as np

from estimator.estimation.runs.run import Run, with_gyro
from estimator.tracing.augmented import Augmented
from estimator.types import Floats


def expected_squares(runs: Sequence[Run], first: int, model: Augmented, *, forms_known: bool = False) -> float:
    """Return the squared error, (rad/s)^2, that a model's covariance lets expect on runs, summed over blocks and gyros.

    Blocks with any weight count alike, those without weight do not count; nor do gyros that a run lacks. Noise is not
    included. ``first`` is the number of the first of the runs among all. ``forms_known``: as if the laws without a
    name, all together, were of known form, that which was found, so that only their size is open. 0 without runs.
    """
    total = 0.0
    for g, name in enumerate(model.names):
        covariance = _with_forms_known(model, g) if forms_known else model.covariance[g]
        for number, run, i in with_gyro(runs, name):
            columns = model.columns(run, first + number, i)[run.weight > 0]
            total += float(np.einsum("bi,ij,bj->", columns, covariance, columns))
    return total


def _with_forms_known(model: Augmented, gyro: int) -> Floats:
    """Return the covariance (c, c) of the parameters of a gyro if its laws are of known form."""
    directions = _open_directions(model, gyro)
    precision = np.linalg.inv(model.covariance[gyro])
    return np.asarray(directions @ np.linalg.inv(directions.T @ precision @ directions) @ directions.T)


def _open_directions(model: Augmented, gyro: int) -> Floats:
    """Return the directions (c, k) of a gyro's c parameters that are open if its laws are of known form.

    These are each parameter of anything but laws, and the estimate of all laws together, unless that is zero.
    """
    of_laws = np.zeros(len(model.mean[gyro]), dtype=np.bool_)
    sizes = np.zeros(len(of_laws), dtype=np.bool_)
    for part in model.parts:
        if part.candidate.law:
            of_laws[model.slice_of(part.candidate.name)] = True
            sizes[model.slice_of(part.candidate.name)] = not part.term.part_of
    form = np.where(sizes, model.mean[gyro], 0.0)
    others = np.eye(len(of_laws))[:, ~of_laws]
    return np.column_stack([others, form]) if form.any() else others  # a gyro whose columns are zero has no form
