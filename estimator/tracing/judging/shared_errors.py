"""Errors that the gyros of a device share: noise and wandering biases of different gyros are independent.

A model that lacks an effect leaves an error that noise and a wandering bias can imitate in one gyro, but not in the
same way in several at once. The test assumes nothing about sizes or spectra: if errors are independent and as likely
positive as negative, a change of sign of any of them is as likely as what was measured. What a fit removes is alike in
all gyros, too, so the fit is repeated after each change (the wild bootstrap: C. F. J. Wu, Jackknife, bootstrap and
other resampling methods in regression analysis, 1986).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from estimator.estimation.runs.run import Run
from estimator.estimation.spectra import cosines
from estimator.tracing.augmented import Augmented
from estimator.tracing.residuals.origin import common_stretches
from estimator.types import Floats

_BANDS = ((1, 7), (7, 37))
"""Numbers of cosines in a stretch, from slow to faster: beyond these the noise of the table's readings is shared."""
_SLOWEST = 300
"""Cosines in which the columns of a model are removed."""
_CHANGES = 1999
"""Random changes of sign that the measured errors are compared with."""
_MOST_SIGNS = 2_000_000  # that are held in memory at once
_BY_CHANCE = 2e-3
_MOST_GYROS, _MOST_STRETCHES = 12, 40
_SEEN = 1e-6  # of the norm of a column: what it gives beyond the others


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
    columns of the model could still give in a stretch is removed from it, since a column acts alike in all gyros.
    Nothing is shared unless every run is of a table and at least two gyros measure together: the errors of other
    references are shared by all gyros. Of many gyros, or many stretches of data, the first ones do.
    """
    names = [name for name in model.names if any(name in run.array.names for run in runs)][:_MOST_GYROS]
    if len(names) < 2 or not all(run.grid.gimbals for run in runs):
        return NOTHING_SHARED
    stretches = _stretches(runs, model, names)
    if not stretches:
        return NOTHING_SHARED
    random = np.random.default_rng(0)
    measured = np.vstack([own.errors for own in stretches])
    sizes = np.sqrt(np.mean(measured**2, axis=0))
    if not sizes.all():
        return NOTHING_SHARED
    bands = _rows_of(stretches)
    found = [_Alike.of(measured[rows] / sizes) for rows in bands]
    as_much = np.zeros(len(found))
    at_once = max(_MOST_SIGNS // measured.size, 1)
    for first in range(0, _CHANGES, at_once):
        count = min(at_once, _CHANGES - first)
        changed = np.concatenate([own.changed(random, count) for own in stretches], axis=1)
        for number, rows in enumerate(bands):
            as_much[number] += np.sum(_Alike.of(changed[:, rows] / sizes).statistic >= found[number].statistic)
    chances = (1 + as_much) / (_CHANGES + 1)
    most = int(np.argmin(chances))
    share = float(found[most].share)
    return Sharing(share=share, by_chance=min(1.0, len(_BANDS) * float(chances[most])))


@dataclass(frozen=True, slots=True, eq=False)
class _Stretch:
    """Slow cosine coefficients of a stretch: ``errors`` (k, n) of n gyros, without what a model's columns can give.

    ``directions`` (n, k, c) are orthonormal, those that the columns have in each gyro.
    """

    errors: Floats
    directions: Floats

    def changed(self, random: np.random.Generator, count: int) -> Floats:
        """Return ``count`` draws (count, k, n) of the errors with random signs, without what the columns can give."""
        signs = random.choice(np.array([-1.0, 1.0], dtype=np.float32), (count, *self.errors.shape))
        return _beside(self.directions, signs * self.errors)


def _beside(directions: Floats, errors: Floats) -> Floats:
    """Return errors (d, k, n) of d draws without their parts along the directions (n, k, c) of each gyro."""
    along = np.einsum("nkc,dkn->dnc", directions, errors)
    return np.asarray(errors - np.einsum("nkc,dnc->dkn", directions, along))


@dataclass(frozen=True, slots=True, eq=False)
class _Alike:
    """How alike errors of gyros are, for one or more draws: a ``statistic`` that is 1 by chance, and the share."""

    statistic: Floats
    share: Floats

    @classmethod
    def of(cls, errors: Floats) -> Self:
        """Return how alike errors (..., n, m) of m gyros are; each of the n rows counts alike, whatever its size."""
        count, gyros = errors.shape[-2:]
        one, other = np.triu_indices(gyros, 1)
        size = np.maximum(np.sum(errors**2, axis=-1), 1e-300)[..., None]
        products = errors[..., one] * errors[..., other] / size
        squares = np.maximum(np.sum(products**2, axis=-2), 1e-300)
        sums = np.sum(products, axis=-2)
        # Rows that are all shared have products of +-1/m in each pair; by chance sums have the variance ``squares``.
        beyond_chance = np.maximum(np.mean(sums**2 - squares, axis=-1), 0.0)
        share = np.minimum(gyros * np.sqrt(beyond_chance) / count, 1.0)
        return cls(np.mean(sums**2 / squares, axis=-1), share)


def _rows_of(stretches: Sequence[_Stretch]) -> list[NDArray[np.intp]]:
    """Return for each band the numbers of its coefficients among those of all stretches, one behind the other."""
    numbers = np.concatenate([np.arange(len(own.errors)) for own in stretches])
    return [np.flatnonzero((numbers >= low - 1) & (numbers < high - 1)) for low, high in _BANDS]


def _stretches(runs: Sequence[Run], model: Augmented, names: Sequence[str]) -> list[_Stretch]:
    """Return the first stretches in which all of some gyros measure, without their means; those in which the columns of
    the model could give anything are left out.

    A straight line and a parabola are directions in each: where a bias ends elsewhere than it began, its coefficients
    would depend on each other.
    """
    rests, columns = [], []
    for number, run in enumerate(runs):
        held = run.weight > 0
        rests.append(np.zeros(run.z_rps.shape))
        columns.append(np.zeros((model.mean.shape[1], *run.z_rps.shape)))
        for gyro in range(len(run.array)):
            said, own = model.predict(run, number, gyro)
            rests[-1][held, gyro] = (run.z_rps[:, gyro] - said)[held]
            columns[-1][:, held, gyro] = own[held].T
    slow = slice(1, _SLOWEST + 1)
    errors = [cosines(values)[slow] for _, values in common_stretches(runs, rests, names)][:_MOST_STRETCHES]
    of_columns = [common_stretches(runs, list(each), names) for each in zip(*columns, strict=True)]
    found = []
    for number, own_errors in enumerate(errors):
        values = [column[number][1] for column in of_columns]
        place = np.linspace(-1, 1, len(values[0]))[:, None] * np.ones(len(names))
        each = np.array([cosines(own)[slow] for own in (*values, place, place**2)])  # (c, k, n)
        norms = np.linalg.norm(each, axis=1, keepdims=True)
        left, singular, _ = np.linalg.svd(
            (each / np.where(norms > 0, norms, 1.0)).transpose(2, 1, 0), full_matrices=False
        )
        directions = left * (singular > _SEEN)[:, None, :]
        if len(own_errors) > directions.shape[2]:  # else the columns can give anything
            found.append(_Stretch(_beside(directions, own_errors[None])[0], directions))
    return found
