"""Errors that the gyros of a device share: noise and wandering biases of different gyros are independent.

A model that lacks an effect leaves an error that noise and a wandering bias can imitate in one gyro, but not in the
same way in several at once. The test assumes nothing about sizes or spectra: if errors are independent and as likely
positive as negative, a change of sign of any of them is as likely as what was measured (a randomisation test: E. J. G.
Pitman, Significance tests which may be applied to samples from any populations, 1937).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from estimator.estimation.runs.run import Run
from estimator.estimation.spectra import cosines
from estimator.tracing.augmented import Augmented
from estimator.tracing.residuals.origin import common_stretches
from estimator.types import Floats

_BANDS = ((1, 7), (7, 37))
"""Numbers of cosines in a stretch, from slow to faster: beyond these the noise of the table's readings is shared."""
_CHANGES = 3999
"""Random changes of sign that the measured errors are compared with."""
_MOST_PRODUCTS = 4_000_000  # that are held in memory at once
_BY_CHANCE = 2e-3
_INDEPENDENT = 1e-9  # share of a column's size that must remain beside the others


@dataclass(kw_only=True, frozen=True, slots=True)
class Sharing:
    """What the slow errors of several gyros have in common.

    ``share`` of them is alike, or opposite, in different gyros; ``by_chance`` is the probability that independent
    errors show as much.
    """

    share: float
    by_chance: float

    @property
    def certain(self) -> bool:
        """Whether chance does not explain it."""
        return self.by_chance < _BY_CHANCE


NOTHING_SHARED = Sharing(share=0.0, by_chance=1.0)


def sharing(runs: Sequence[Run], model: Augmented) -> Sharing:
    """Return what gyros have in common in the residuals of ``runs`` beside a model, in the band that shows it most.

    ``runs`` are those that ``model`` was fitted to, in order, with those that were held back behind them. What the
    columns of the model could still explain in a run is removed from it, since a column acts alike in all gyros.
    Nothing is shared unless every run is of a table and at least two gyros measure together: the errors of other
    references are shared by all gyros.
    """
    names = [name for name in model.names if any(name in run.array.names for run in runs)]
    if len(names) < 2 or not all(run.grid.gimbals for run in runs):
        return NOTHING_SHARED
    rests = [_beside_columns(run, number, model) for number, run in enumerate(runs)]
    stretches = [cosines(values) for _, values in common_stretches(runs, rests, names)]
    bands = [_alike(np.vstack([part[low:high] for part in stretches])) for low, high in _BANDS if stretches]
    most = min(bands, key=lambda band: band.by_chance, default=NOTHING_SHARED)
    return replace(most, by_chance=min(1.0, len(_BANDS) * most.by_chance))


def _beside_columns(run: Run, number: int, model: Augmented) -> Floats:
    """Return the residual (b, m) of a run's gyros in rad/s, without anything that the columns of ``model`` can give.

    Blocks without weight are 0. ``number`` is that of the run among those that the model was fitted to.
    """
    held = run.weight > 0
    rest = np.zeros(run.z_rps.shape)
    for gyro in range(len(run.array)):
        columns = model.columns(run, number, gyro)[held]
        sizes = np.abs(columns).max(axis=0, initial=0.0)
        directions, singular, _ = np.linalg.svd(columns[:, sizes > 0] / sizes[sizes > 0], full_matrices=False)
        directions = directions[:, singular > _INDEPENDENT * singular.max(initial=0.0)]
        output_rps = run.z_rps[held, gyro]
        rest[held, gyro] = output_rps - directions @ (directions.T @ output_rps)
    return rest


def _alike(errors: Floats) -> Sharing:
    """Return what errors (n, m) of m gyros have in common; each of the n rows counts alike, whatever its size."""
    sizes = np.sqrt(np.mean(errors**2, axis=0))
    scaled = errors[:, sizes > 0] / sizes[sizes > 0]
    count, gyros = scaled.shape
    one, other = np.triu_indices(gyros, 1)
    products = scaled[:, one] * scaled[:, other] / np.maximum(np.sum(scaled**2, axis=1), 1e-300)[:, None]
    squares = np.sum(products**2, axis=0)
    if not squares.size or not squares.all():
        return NOTHING_SHARED
    sums = products.sum(axis=0)
    measured = np.sum(sums**2 / squares)
    random = np.random.default_rng(0)
    at_once = max(_MOST_PRODUCTS // products.size, 1)
    as_much = 0
    for first in range(0, _CHANGES, at_once):
        signs = random.choice(np.array([-1, 1], dtype=np.int8), (min(at_once, _CHANGES - first), *scaled.shape))
        changed = np.einsum("cnp,np->cp", signs[:, :, one] * signs[:, :, other], products)
        as_much += int(np.sum(np.sum(changed**2 / squares, axis=1) >= measured))
    # Rows that are all shared have products of +-1/m in each pair; by chance their sums have the variance ``squares``.
    beyond_chance = max(float(np.mean(sums**2 - squares)), 0.0)
    share = min(gyros * np.sqrt(beyond_chance) / count, 1.0)
    return Sharing(share=float(share), by_chance=(1 + as_much) / (_CHANGES + 1))
