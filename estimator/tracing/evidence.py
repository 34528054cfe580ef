"""How probable recordings are under a set of effects: the marginal likelihood, over all noise models at once.

Everything is linear and Gaussian given the noise: states under the data sheet's prior, parameters of effects under a
prior of mean zero whose scale, the same for all parameters of an effect, is some share of the largest plausible size.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimator.tracing.spectra import GyroSpectra, NoiseShapes, Stretch, Z

Floats = NDArray[np.float64]

_MATTERS = 9.0  # natural logarithm of how much less probable than the best a noise model may be and still count
SCALES = np.array([10.0, 3.0, 1.0, 0.3, 0.1, 0.03, 0.01, 0.003, 0.001])
"""Scales of an effect's parameters, as shares of the largest plausible size; none is preferred."""
_TELLING, _BY_CHANCE = 8.0, 1e-4
"""Degrees of freedom in which an excess over the noise is looked for, and its probability by chance."""


@dataclass(frozen=True, slots=True, eq=False)
class Term:
    """An effect in a model: where its columns are (scaled to the largest plausible size), its prior scale.

    ``sizes`` are scales of the columns beside that, if they differ.
    """

    name: str
    columns: tuple[int, ...]
    shared: bool
    scale: float = 1.0
    log_tries: float = 0.0
    sizes: tuple[float, ...] = ()

    def scaled(self, scale: float) -> Term:
        """Return the same with another scale."""
        return replace(self, scale=scale)

    @property
    def precision(self) -> Floats:
        """Expected precision of each parameter (c,): that of its scale, times its size where sizes differ."""
        return 1 / (self.scale * np.array(self.sizes or [1.0] * len(self.columns))) ** 2


@dataclass(frozen=True, slots=True, eq=False)
class Posterior:
    """Estimate under a set of terms.

    By gyro ``own`` (c,) and ``own_covariance`` (c, c) of [states, own terms]; ``shared`` (h,) and its covariance;
    ``cross`` (c, h) covariance of both. ``weight`` (G,) of each noise model.
    """

    own: list[Floats]
    own_covariance: list[Floats]
    shared: Floats
    shared_covariance: Floats
    cross: list[Floats]
    weight: Floats


def log_mean(values: Floats, log_weights: Floats | None = None) -> float:
    """Return the logarithm of the mean of exponentials, or of the weighted sum."""
    values = values + (log_weights if log_weights is not None else -np.log(len(values)))
    top = float(values.max())
    return top + float(np.log(np.exp(values - top).sum()))


class Evidence:
    """The products of all columns of every gyro under every noise model, and what follows from them."""

    def __init__(self, gyros: Sequence[GyroSpectra], shapes: NoiseShapes) -> None:
        """Take in the columns that the gyros have."""
        self.gyros, self.shapes = list(gyros), shapes
        self._all = shapes
        self.excess = [[np.ones(len(s.counts)) for s in gyro.stretches] for gyro in self.gyros]
        self.misfit = [[0.0 for _ in gyro.stretches] for gyro in self.gyros]
        self.refresh()

    def without(self, fold: Callable[[int, Stretch], bool]) -> Evidence:
        """Return that of all stretches but those that ``fold`` names by their number."""
        kept = [[n for n, stretch in enumerate(gyro.stretches) if not fold(n, stretch)] for gyro in self.gyros]
        gyros = [
            replace(
                gyro,
                stretches=[gyro.stretches[n] for n in own],
                columns=[gyro.columns[n] for n in own],
                products=[gyro.products[n] for n in own],
            )
            for gyro, own in zip(self.gyros, kept, strict=True)
        ]
        rest = Evidence(gyros, self.shapes)
        rest.excess = [[excess[n] for n in own] for excess, own in zip(self.excess, kept, strict=True)]
        rest.refresh()
        return rest

    def narrow(self, models: Sequence[Sequence[Term]]) -> None:
        """Keep the noise models that matter beside one of some sets of terms, and a few between them."""
        keep = (self._all.walk == 0) & (self._all.turn_on == np.median(self._all.turn_on))
        for terms in models:
            log = self.by_noise(terms) + self.shapes.log_prior
            keep |= log > log.max() - _MATTERS
        self.shapes = self._all.select(keep)
        self.refresh()

    def refresh(self) -> None:
        """Take in columns that were added to the gyros since."""
        self.noise_log = np.zeros(len(self.shapes))
        self.grams: list[Floats] = []
        for gyro, excess in zip(self.gyros, self.excess, strict=True):
            densities = [self.shapes.density(s) * more for s, more in zip(gyro.stretches, excess, strict=True)]
            self.grams.append(gyro.gram(densities))
            for stretch, density in zip(gyro.stretches, densities, strict=True):
                self.noise_log -= 0.5 * np.log(density) @ stretch.counts

    def allow_for_misfit(self, rich: Sequence[Term]) -> None:
        """Count as noise, by gyro, stretch and band, what all that is known together leaves beyond the noise.

        No function of what was measured explains it, so whatever is judged beside it is judged against it; where noise
        explains it all, nothing changes. ``rich``: all that is known, each gyro by itself. ``misfit`` is then the
        excess by gyro and stretch, summed over blocks, in (rad/s)^2.
        """
        self.excess = [[np.ones(len(s.counts)) for s in gyro.stretches] for gyro in self.gyros]
        self.refresh()
        best = int(np.argmax(self.by_noise([replace(t, shared=False) for t in rich]) + self.shapes.log_prior))
        columns = np.array([*range(Z), *(c for t in rich for c in t.columns)])
        wide = np.append(columns, Z)
        for gyro, gram, excess, misfit in zip(self.gyros, self.grams, self.excess, self.misfit, strict=True):
            precision = np.concatenate([1 / gyro.prior, _precision(rich)])
            inner = np.linalg.inv(gram[best][np.ix_(columns, columns)] + np.diag(precision))
            left = np.append(-inner @ gram[best][columns, Z], 1.0)
            for number, (stretch, products) in enumerate(zip(gyro.stretches, gyro.products, strict=True)):
                density = self.shapes.density(stretch)[best]
                own = products[:, wide[:, None], wide]
                squares = np.einsum("i,bij,j->b", left, own, left) / density
                fitted = np.einsum("ij,bji->b", inner, own[:, :-1, :-1]) / density
                freedom = np.maximum(stretch.counts - fitted, 0.05 * stretch.counts)
                excess[number] = _excess(squares, freedom)
                beyond = (excess[number] > 1) * density * (squares - freedom)
                misfit[number] = max(float(beyond.sum()), 0.0) * gyro.arw**2 / stretch.length_s
        self.refresh()

    def of(self, terms: Sequence[Term]) -> float:
        """Return the log evidence of a set of terms, over all noise models."""
        return log_mean(self.by_noise(terms), self.shapes.log_prior)

    def by_noise(self, terms: Sequence[Term]) -> Floats:
        """Return the log evidence (G,) of a set of terms under each noise model."""
        return Base(self, [term for term in terms if not term.shared]).by_noise([t for t in terms if t.shared])

    def noise_weight(self, terms: Sequence[Term]) -> Floats:
        """Return how probable each noise model is (G,) beside a set of terms."""
        log = self.by_noise(terms) + self.shapes.log_prior
        weight = np.exp(log - log.max())
        return np.asarray(weight / weight.sum())

    def posterior(self, terms: Sequence[Term], weight: Floats | None = None) -> Posterior:
        """Return the estimate of states and effects, the mean over the noise models that matter.

        ``weight`` (G,) of the noise models, by default as the recordings say beside these terms.
        """
        weight = self.noise_weight(terms) if weight is None else weight
        matter = np.flatnonzero(weight > 1e-4)
        weight = weight[matter] / weight[matter].sum()
        own, shared = _split(terms)
        own_columns = np.array([*range(4), *(c for t in own for c in t.columns)])
        rest_columns = np.array([*(c for t in shared for c in t.columns), Z])
        h = len(rest_columns) - 1
        shared_precision = np.diag(_precision(shared))
        total = np.zeros((len(matter), h + 1, h + 1))
        kept = []
        for gyro, gram in zip(self.gyros, self.grams, strict=True):
            precision = np.diag(np.concatenate([1 / gyro.prior, _precision(own)]))
            inner = np.linalg.inv(gram[np.ix_(matter, own_columns, own_columns)] + precision)
            across = gram[np.ix_(matter, own_columns, rest_columns)]
            gain = inner @ across
            rest = gram[np.ix_(matter, rest_columns, rest_columns)]
            total += rest - across.transpose(0, 2, 1) @ gain
            kept.append((inner, gain))
        shared_covariance = np.linalg.inv(total[:, :h, :h] + shared_precision)
        shared_mean = (shared_covariance @ total[:, :h, h:])[..., 0]
        mean_shared = weight @ shared_mean
        result = Posterior([], [], mean_shared, np.zeros((h, h)), [], weight)
        offset = shared_mean - mean_shared
        covariance = np.einsum("g,gij->ij", weight, shared_covariance + offset[:, :, None] * offset[:, None, :])
        result.shared_covariance[:] = covariance
        for inner, gain in kept:
            slope = gain[:, :, :h]
            x = gain[:, :, h] - np.einsum("gij,gj->gi", slope, shared_mean)
            mean = weight @ x
            spread = x - mean
            total_own = inner + slope @ shared_covariance @ slope.transpose(0, 2, 1)
            result.own.append(mean)
            result.own_covariance.append(
                np.einsum("g,gij->ij", weight, total_own + spread[:, :, None] * spread[:, None, :])
            )
            both = -slope @ shared_covariance + spread[:, :, None] * offset[:, None, :]
            result.cross.append(np.einsum("g,gij->ij", weight, both))
        return result


class Base:
    """States and own terms eliminated once, so that each further term costs little."""

    def __init__(self, evidence: Evidence, own: Sequence[Term]) -> None:
        """``own``: terms that each gyro has to itself."""
        self._evidence = evidence
        columns = [*range(4), *(c for t in own for c in t.columns)]
        self._log = np.array(evidence.noise_log)
        self.reduced: list[Floats] = []
        for gyro, gram in zip(evidence.gyros, evidence.grams, strict=True):
            precision = np.concatenate([1 / gyro.prior, _precision(own)])
            block = gram[:, columns][:, :, columns] + np.diag(precision)
            across = gram[:, columns, :]
            self.reduced.append(gram - across.transpose(0, 2, 1) @ np.linalg.solve(block, across))
            self._log += 0.5 * np.log(precision).sum() - 0.5 * np.linalg.slogdet(block)[1]

    def by_noise(self, shared: Sequence[Term], own: Term | None = None) -> Floats:
        """Return the log evidence (G,) with these shared terms, and one more own term."""
        h_columns = [c for t in shared for c in t.columns]
        rest = [*h_columns, Z]
        log = np.array(self._log)
        total = np.zeros((len(log), len(rest), len(rest)))
        for reduced in self.reduced:
            part = reduced[:, rest][:, :, rest]
            if own is not None:
                precision = _precision([own])
                block = reduced[:, own.columns][:, :, own.columns] + np.diag(precision)
                across = reduced[:, own.columns][:, :, rest]
                part = part - across.transpose(0, 2, 1) @ np.linalg.solve(block, across)
                log += 0.5 * np.log(precision).sum() - 0.5 * np.linalg.slogdet(block)[1]
            total += part
        return _eliminated(total, shared, log)

    def with_functions(
        self, shared: Sequence[Term], columns: NDArray[np.intp], sizes: Floats, scales: Floats
    ) -> Floats:
        """Return the log evidence (s, G) with shared terms and, a gyro its own, a sum of functions of each scale (s,).

        The functions are ``columns`` times ``sizes`` (c,).
        """
        rest = [*(c for t in shared for c in t.columns), Z]
        logs = np.repeat(self._log[None], len(scales), axis=0)
        totals = np.zeros((len(scales), len(self._log), len(rest), len(rest)))
        for reduced in self.reduced:
            block = reduced[:, columns[:, None], columns] * np.outer(sizes, sizes)
            power, turned = np.linalg.eigh(block)
            power = np.maximum(power, 0.0)
            across = turned.transpose(0, 2, 1) @ (reduced[:, columns][:, :, rest] * sizes[:, None])
            for n, scale in enumerate(scales.tolist()):
                grown = 1 + scale**2 * power
                logs[n] -= 0.5 * np.log(grown).sum(axis=1)
                taken = across.transpose(0, 2, 1) @ (across * (scale**2 / grown)[:, :, None])
                totals[n] += reduced[:, rest][:, :, rest] - taken
        return np.array([_eliminated(total, shared, log) for total, log in zip(totals, logs, strict=True)])

    def with_term(self, shared: Sequence[Term], term: Term) -> tuple[float, Term]:
        """Return the log evidence with one more term, over its scales, and the term at its most probable scale."""
        prior = self._evidence.shapes.log_prior
        values = []
        for scale in SCALES:
            scaled = term.scaled(float(scale))
            by_noise = self.by_noise([*shared, scaled]) if term.shared else self.by_noise(shared, scaled)
            values.append(log_mean(by_noise, prior))
        best = int(np.argmax(values))
        return log_mean(np.array(values)) - term.log_tries, term.scaled(float(SCALES[best]))


def _eliminated(total: Floats, shared: Sequence[Term], log: Floats) -> Floats:
    """Return the log evidence (G,) when shared terms go too; ``total`` (G, h + 1, h + 1) has their products and z's."""
    square = total[:, -1, -1]
    if shared:
        precision = _precision(shared)
        block = total[:, :-1, :-1] + np.diag(precision)
        right = total[:, :-1, -1:]
        square = square - np.sum(right * np.linalg.solve(block, right), axis=(1, 2))
        log = log + 0.5 * np.log(precision).sum() - 0.5 * np.linalg.slogdet(block)[1]
    return np.asarray(log - 0.5 * square)


def _excess(squares: Floats, freedom: Floats) -> Floats:
    """Return by how much the noise of each band (b,) is larger than it should be, 1 where that may be chance.

    Neighbouring bands are taken together until they tell something.
    """
    from scipy.stats import chi2

    group = np.floor(np.concatenate([[0.0], np.cumsum(freedom)[:-1]]) / _TELLING).astype(np.intp)
    _, group = np.unique(group, return_inverse=True)
    total, count = np.bincount(group, squares), np.bincount(group, freedom)
    beyond = total > chi2.isf(_BY_CHANCE, count)
    return np.asarray(np.where(beyond, np.maximum(total / count, 1.0), 1.0)[group])


def _split(terms: Sequence[Term]) -> tuple[list[Term], list[Term]]:
    return [t for t in terms if not t.shared], [t for t in terms if t.shared]


def _precision(terms: Sequence[Term]) -> Floats:
    return np.concatenate([np.empty(0), *(t.precision for t in terms)])
