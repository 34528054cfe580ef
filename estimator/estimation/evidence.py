"""How probable recordings are under a set of effects: the marginal likelihood, over all noise models at once.

Everything is linear and Gaussian given the noise: states under the data sheet's prior, parameters of effects under a
prior of mean zero whose scale, the same for all parameters of an effect, is some share of the largest plausible size.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimator.estimation.spectra import GyroSpectra, NoiseShapes, Stretch, Z
from estimator.types import Floats

_HARDLY = 0.2  # rtHz
_MATTERS = 9.0  # natural logarithm of how much less probable than the best a noise model may be and still count
SCALES = np.array([10.0, 3.0, 1.0, 0.3, 0.1, 0.03, 0.01, 0.003, 0.001])
"""Scales of an effect's parameters, as shares of the largest plausible size; none is preferred."""
_TELLING, _BY_CHANCE = 8.0, 1e-4
"""Degrees of freedom in which a level of noise is looked for, and its probability by chance."""
_OWN = 0.1  # share of the expectation on a gyro that does not follow the other gyros of its device


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

    def scaled(self, scale: float) -> "Term":
        """Return the same with another scale."""
        return replace(self, scale=scale)

    @property
    def precision(self) -> Floats:
        """Expected precision of each parameter (c,): that of its scale, times its size where sizes differ."""
        return 1 / (self.scale * np.array(self.sizes or [1.0] * len(self.columns))) ** 2


@dataclass(frozen=True, slots=True, eq=False)
class Posterior:
    """Estimate under terms: by gyro ``means`` (c,) and ``covariances`` (c, c) of [states, own terms, shared terms].

    ``columns`` (c,) are the columns that these belong to.
    """

    columns: list[int]
    means: list[Floats]
    covariances: list[Floats]

    def of(self, term: Term) -> Floats:
        """Return the parameters (gyros, p) of a term."""
        first = self.columns.index(term.columns[0])
        return np.array([mean[first : first + len(term.columns)] for mean in self.means])


@dataclass(frozen=True, slots=True, eq=False)
class Profile:
    """By how much the noise of a gyro in a run is larger than its models say: ``factor`` (f,) about ``hz`` (f,)."""

    hz: Floats
    factor: Floats

    def at(self, hz: Floats) -> Floats:
        """Return the factor (n,) at frequencies."""
        edges = np.sqrt(self.hz[1:] * self.hz[:-1])
        return np.asarray(self.factor[np.searchsorted(edges, hz)])

    @classmethod
    def of(cls, hz: Floats, squares: Floats, freedom: Floats, *, less: bool) -> "Profile":
        """Return that of what is left by band (n,); 1 where that may be chance, or smaller and not ``less``.

        Neighbouring bands are taken together until they tell something.
        """
        from scipy.special import gammainc, gammaincc  # of the chi-square; scipy.stats takes a second to import

        order = np.argsort(hz)
        hz, squares, freedom = hz[order], squares[order], freedom[order]
        group = np.floor(np.concatenate([[0.0], np.cumsum(freedom)[:-1]]) / _TELLING).astype(np.intp)
        _, group = np.unique(group, return_inverse=True)
        total, count = np.maximum(np.bincount(group, squares), 1e-12), np.bincount(group, freedom)
        ratio = total / count
        unlike = (gammaincc(count / 2, total / 2) < _BY_CHANCE) & (ratio > 1)
        unlike |= less & (gammainc(count / 2, total / 2) < _BY_CHANCE)
        middle = np.exp(np.bincount(group, np.log(np.maximum(hz, 1e-12))) / np.bincount(group))
        return cls(middle, np.where(unlike, ratio, 1.0))


_EVEN = Profile(np.ones(1), np.ones(1))


def log_mean(values: Floats, log_weights: Floats | None = None) -> float:
    """Return the logarithm of the mean of exponentials, or of the weighted sum."""
    return float(np.logaddexp.reduce(values + (log_weights if log_weights is not None else -np.log(len(values)))))


class Evidence:
    """The products of all columns of every gyro under every noise model, and what follows from them."""

    def __init__(
        self,
        gyros: Sequence[GyroSpectra],
        shapes: NoiseShapes,
        excess: Mapping[tuple[str, int], Profile] | None = None,
    ) -> None:
        """Take in the columns that the gyros have; ``excess`` by gyro and run is what noise has beyond its models."""
        self.gyros, self.shapes = list(gyros), shapes
        self._all = shapes
        self.excess = dict(excess or {})
        self.level = np.ones(len(self.gyros))
        self.misfit: dict[tuple[str, int], float] = {}
        self.refresh()

    def without(self, fold: Callable[[int, Stretch], bool]) -> "Evidence":
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
        return Evidence(gyros, self.shapes, self.excess)

    def narrow(self, models: Sequence[Sequence[Term]]) -> None:
        """Keep the noise models that matter beside one of some sets of terms, and those of biases that hardly move."""
        keep = (self._all.walk == 0) & (self._all.turn_on <= _HARDLY)
        for terms in models:
            log = self.by_noise(terms) + self.shapes.log_prior
            keep |= log > log.max() - _MATTERS
        self.shapes = self._all.select(keep)
        self.refresh()

    def refresh(self) -> None:
        """Take in columns that were added to the gyros since."""
        self.noise_logs = np.zeros((len(self.gyros), len(self.shapes)))
        self.grams: list[Floats] = []
        for gyro, log in zip(self.gyros, self.noise_logs, strict=True):
            densities = [self.density(gyro, stretch) for stretch in gyro.stretches]
            self.grams.append(gyro.gram(densities))
            for stretch, density in zip(gyro.stretches, densities, strict=True):
                log -= 0.5 * np.log(density) @ stretch.counts

    def density(self, gyro: GyroSpectra, stretch: Stretch) -> Floats:
        """Return the variance (G, bands) of a coefficient over that of white noise, what is beyond the models in it."""
        more = self.excess.get((gyro.name, stretch.run), _EVEN)
        return self.shapes.density(stretch) * more.at(stretch.band_hz)

    def allow_for_misfit(self, rich: Sequence[Term]) -> None:
        """Count as noise, by gyro, run and band, what all that is known together leaves beyond the noise.

        No function of what was measured explains it, so whatever is judged beside it is judged against it; where noise
        explains it all, nothing changes. ``rich``: all that is known, each gyro by itself. ``misfit`` is then the
        excess by gyro and run, summed over blocks, in (rad/s)^2.
        """
        self.excess.clear()
        self.refresh()
        for gyro, left in zip(self.gyros, self._left(rich), strict=True):
            for run in dict.fromkeys(stretch.run for stretch in gyro.stretches):
                hz, density, squares, freedom = left[1:, left[0] == run]
                profile = Profile.of(hz, squares, freedom, less=False)
                self.excess[gyro.name, run] = profile
                beyond = (profile.at(hz) > 1) * density * (squares - freedom)
                length_s = next(s.length_s for s in gyro.stretches if s.run == run)
                self.misfit[gyro.name, run] = max(float(beyond.sum()), 0.0) * gyro.arw**2 / length_s
        self.refresh()

    def settle(self, terms: Sequence[Term], least: Floats) -> None:
        """Take the noise from all of what a model leaves: its ``level`` (gyros,), and bands that have more or less.

        ``least`` (gyros,) is the noise that is stated, as of turns: a few rows tell no spectrum beyond it.
        """
        for level_only in (True, False)[: 1 if least.any() else 2]:
            for n, (gyro, (_, hz, _, squares, freedom)) in enumerate(zip(self.gyros, self._left(terms), strict=True)):
                if level_only:
                    self.level[n] = max(squares.sum() / max(freedom.sum(), 1.0), (float(least[n]) / gyro.arw) ** 2)
                profile = _EVEN if level_only else Profile.of(hz, squares, freedom, less=True)
                profile = replace(profile, factor=self.level[n] * profile.factor)
                self.excess.update(dict.fromkeys(((gyro.name, s.run) for s in gyro.stretches), profile))
            self.refresh()

    def _left(self, terms: Sequence[Term]) -> list[Floats]:
        """Return by gyro what a model leaves by band (5, n): run, frequency, noise, squares over it, their freedom."""
        own = [replace(term, shared=False) for term in terms]
        best = np.argmax(self.noise_weights(own), axis=0)
        columns = np.array([*range(Z), *(c for t in own for c in t.columns)])
        wide = np.append(columns, Z)
        found = []
        for gyro, gram, model in zip(self.gyros, self.grams, best.tolist(), strict=True):
            precision = np.concatenate([1 / gyro.prior, _precision(own)])
            inner = np.linalg.inv(gram[model][np.ix_(columns, columns)] + np.diag(precision))
            left = np.append(-inner @ gram[model][columns, Z], 1.0)
            parts = []
            for stretch, products in zip(gyro.stretches, gyro.products, strict=True):
                density = self.density(gyro, stretch)[model]
                chosen = products[:, wide[:, None], wide]
                squares = np.maximum(np.einsum("i,bij,j->b", left, chosen, left), 0.0) / density
                fitted = np.einsum("ij,bji->b", inner, chosen[:, :-1, :-1]) / density
                freedom = np.maximum(stretch.used * stretch.counts - fitted, 0.05 * stretch.counts)
                parts.append(np.array([0 * density + stretch.run, stretch.band_hz, density, squares, freedom]))
            found.append(np.hstack(parts))
        return found

    def of(self, terms: Sequence[Term]) -> float:
        """Return the log evidence of a set of terms, over all noise models."""
        return log_mean(self.by_noise(terms), self.shapes.log_prior)

    def by_noise(self, terms: Sequence[Term]) -> Floats:
        """Return the log evidence (G,) of a set of terms under each noise model."""
        return Base(self, terms).by_noise()

    def noise_weight(self, terms: Sequence[Term]) -> Floats:
        """Return how probable each noise model is (G,) beside a set of terms, if it is that of all gyros."""
        return _normal(self.by_noise(terms) + self.shapes.log_prior)

    def noise_weights(self, terms: Sequence[Term]) -> Floats:
        """Return how probable each noise model is for each gyro (G, gyros), which is expected to be like the others."""
        evidence = Base(self, [replace(term, shared=False) for term in terms]).by_gyro().T
        prior = self.shapes.log_prior[:, None]
        if evidence.shape[1] == 1:
            return _normal(evidence + prior)
        others = _normal(prior + evidence.sum(axis=1, keepdims=True) - evidence)
        return _normal(evidence + np.log((1 - _OWN) * others + _OWN * np.exp(prior)))

    def posterior(self, terms: Sequence[Term], weight: Floats | None = None) -> Posterior:
        """Return the estimate of states and effects, the mean over the noise models that matter.

        ``weight`` of the noise models: (G,) if one is that of all gyros, (G, gyros) if each gyro has its own; by
        default (G,) as the recordings say beside these terms.
        """
        weight = self.noise_weight(terms) if weight is None else weight
        each = np.broadcast_to(weight.reshape(len(weight), -1), (len(weight), len(self.gyros)))
        own, shared = _split(terms)
        columns = np.array([*range(Z), *(c for t in own for c in t.columns)])
        rest = np.array([*(c for t in shared for c in t.columns), Z])
        h, parts = len(rest) - 1, []
        for gyro, gram, its in zip(self.gyros, self.grams, each.T, strict=True):
            matter = np.flatnonzero(its > 1e-4)
            precision = np.diag(np.concatenate([1 / gyro.prior, _precision(own)]))
            inner = np.linalg.inv(gram[np.ix_(matter, columns, columns)] + precision)
            across = gram[np.ix_(matter, columns, rest)]
            gain = inner @ across
            left = gram[np.ix_(matter, rest, rest)] - across.transpose(0, 2, 1) @ gain
            chance = its[matter] / its[matter].sum()
            parts.append((chance, inner, gain, left, left if weight.ndim == 1 else chance @ left.swapaxes(0, 1)))
        prior = np.diag(_precision(shared))
        found = Posterior([*columns.tolist(), *rest[:-1].tolist()], [], [])
        of_all = np.sum([said for *_, said in parts], axis=0)
        for chance, inner, gain, left, said in parts:
            # What the other gyros say of shared terms they say under their own noise.
            left = left + (of_all - said)
            shared_covariance = np.linalg.inv(left[:, :h, :h] + prior)
            common = (shared_covariance @ left[:, :h, h:])[..., 0]
            slope = gain[:, :, :h]
            x = np.hstack([gain[:, :, h] - np.einsum("gij,gj->gi", slope, common), common])
            across = -slope @ shared_covariance
            whole = np.block(
                [[inner - across @ slope.transpose(0, 2, 1), across], [across.transpose(0, 2, 1), shared_covariance]]
            )
            mean = chance @ x
            spread = x - mean
            found.means.append(mean)
            squares = whole + spread[:, :, None] * spread[:, None, :]
            found.covariances.append(np.einsum("g,gij->ij", chance, squares))
        return found


class Base:
    """States and own terms of a model eliminated once, so that each further term costs little."""

    def __init__(self, evidence: Evidence, terms: Sequence[Term]) -> None:
        """``reduced`` is then by gyro (G, c, c): the products of all columns beside states and own terms."""
        own, self._shared = _split(terms)
        columns = [*range(Z), *(c for t in own for c in t.columns)]
        self._prior, self._logs = evidence.shapes.log_prior, evidence.noise_logs.copy()
        self.reduced: list[Floats] = []
        for gyro, gram, log in zip(evidence.gyros, evidence.grams, self._logs, strict=True):
            precision = np.concatenate([1 / gyro.prior, _precision(own)])
            reduced, gained = _eliminated(gram, columns, slice(None), precision)
            self.reduced.append(reduced)
            log += gained
        self._log = np.asarray(self._logs.sum(axis=0))

    def by_gyro(self) -> Floats:
        """Return the log evidence (gyros, G) of each gyro with its own terms."""
        return np.asarray(self._logs - 0.5 * np.array([reduced[:, Z, Z] for reduced in self.reduced]))

    def by_noise(self, more: Term | None = None) -> Floats:
        """Return the log evidence (G,), with one more term."""
        own, further = _split([] if more is None else [more])
        shared = [*self._shared, *further]
        rest = [*(c for t in shared for c in t.columns), Z]
        log = np.array(self._log)
        total = np.zeros((len(log), len(rest), len(rest)))
        for reduced in self.reduced:
            part = reduced[:, rest][:, :, rest]
            if own:
                part, gained = _eliminated(reduced, own[0].columns, rest, own[0].precision)
                log += gained
            total += part
        return _in_all(total, shared, log)

    def with_functions(self, columns: NDArray[np.intp], sizes: Floats, scales: Floats) -> Floats:
        """Return the log evidence (s, G) with, a gyro its own, a sum of functions of each scale (s,).

        The functions are ``columns`` times ``sizes`` (c,).
        """
        rest = [*(c for t in self._shared for c in t.columns), Z]
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
        return np.array([_in_all(total, self._shared, log) for total, log in zip(totals, logs, strict=True)])

    def with_term(self, term: Term) -> tuple[float, Term]:
        """Return the log evidence with one more term, over its scales, and the term at its most probable scale."""
        scaled = [term.scaled(scale) for scale in SCALES.tolist()]
        values = np.array([log_mean(self.by_noise(one), self._prior) for one in scaled])
        return log_mean(values) - term.log_tries, scaled[int(np.argmax(values))]


def _eliminated(
    gram: Floats, columns: Sequence[int], rest: Sequence[int] | slice, precision: Floats
) -> tuple[Floats, Floats]:
    """Return the products (G, r, r) of the ``rest`` of columns beside some of this precision, and log evidence (G,)."""
    block = gram[:, columns][:, :, columns] + np.diag(precision)
    across = gram[:, columns][:, :, rest]
    left = gram[:, rest][:, :, rest] - across.transpose(0, 2, 1) @ np.linalg.solve(block, across)
    return left, 0.5 * np.log(precision).sum() - 0.5 * np.linalg.slogdet(block)[1]


def _in_all(total: Floats, shared: Sequence[Term], log: Floats) -> Floats:
    """Return the log evidence (G,) when shared terms go too; ``total`` (G, h + 1, h + 1) has their products and z's."""
    left, gained = _eliminated(total, list(range(total.shape[1] - 1)), [-1], _precision(shared))
    return np.asarray(log + gained - 0.5 * left[:, 0, 0])


def _normal(log: Floats) -> Floats:
    weight = np.exp(log - log.max(axis=0))
    return np.asarray(weight / weight.sum(axis=0))


def _split(terms: Sequence[Term]) -> tuple[list[Term], list[Term]]:
    return [t for t in terms if not t.shared], [t for t in terms if t.shared]


def _precision(terms: Sequence[Term]) -> Floats:
    return np.concatenate([np.empty(0), *(t.precision for t in terms)])
