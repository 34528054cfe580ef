"""How probable recordings are under a set of effects: the marginal likelihood, over all noise models at once.

Everything is linear and Gaussian given the noise: states under the data sheet's prior, parameters of effects under a
prior of mean zero whose scale, the same for all parameters of an effect, is some share of the largest plausible size.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from estimator.estimation.spectra import AS_MODELLED, GyroSpectra, NoiseShapes, Profile, Stretch, Z
from estimator.types import Floats

Numbers = NDArray[np.intp]
"""Numbers of columns."""

_HARDLY = 0.2  # rtHz
_MATTERS = 9.0  # natural logarithm of how much less probable than the best a noise model may be and still count
SCALES = np.array([10.0, 3.0, 1.0, 0.3, 0.1, 0.03, 0.01, 0.003, 0.001])
"""Scales of an effect's parameters, as shares of the largest plausible size; none is preferred."""
_OWN = 0.1  # share of the expectation on a gyro that does not follow the other gyros of its device


@dataclass(frozen=True, slots=True, eq=False)
class Term:
    """An effect in a model: its columns (scaled to the largest plausible size) and the scale of its prior.

    ``shared``: all gyros have the same parameters. ``sizes`` are scales of the single columns in addition, if they
    differ; ``log_tries`` is lost of the log evidence because many like it are tried. ``part_of`` names the term without
    which it means nothing, if any.
    """

    name: str
    columns: tuple[int, ...]
    shared: bool
    scale: float = 1.0
    log_tries: float = 0.0
    sizes: tuple[float, ...] = ()
    part_of: str = ""

    def scaled(self, scale: float) -> "Term":
        """Return the same with another scale."""
        return replace(self, scale=scale)

    @property
    def precision(self) -> Floats:
        """Expected precision of each parameter (c,): that of its scale, times its size where sizes differ."""
        return 1 / (self.scale * self.relative_sizes) ** 2

    @property
    def relative_sizes(self) -> Floats:
        """Scales of the columns (c,), 1 where they do not differ."""
        return np.array(self.sizes) if self.sizes else np.ones(len(self.columns))


@dataclass(frozen=True, slots=True, eq=False)
class Posterior:
    """Estimate under terms: by gyro ``means`` (c,) and ``covariances`` (c, c) of [states, own terms, shared terms],
    whose columns have the numbers ``columns`` (c,).
    """

    columns: list[int]
    means: list[Floats]
    covariances: list[Floats]

    def of(self, term: Term) -> Floats:
        """Return the parameters (gyros, p) of a term."""
        first = self.columns.index(term.columns[0])
        return np.array([mean[first : first + len(term.columns)] for mean in self.means])


def log_mean(values: Floats, log_weights: Floats | None = None) -> float:
    """Return the logarithm of the mean of exponentials, or of the weighted sum."""
    return float(np.logaddexp.reduce(values + (log_weights if log_weights is not None else -np.log(len(values)))))


class Evidence:
    """Log evidence of recordings under every noise model, computed from the products of columns of all gyros."""

    def __init__(
        self,
        gyros: Sequence[GyroSpectra],
        shapes: NoiseShapes,
        excess: Mapping[tuple[str, int], Profile] | None = None,
    ) -> None:
        """Take gyros, noise models and the ``excess`` beyond these, by name of gyro and number of run; refresh."""
        self.gyros, self.shapes = list(gyros), shapes
        self.excess = dict(excess or {})
        self.level = np.ones(len(self.gyros))
        self.misfit: dict[tuple[str, int], float] = {}
        self.refresh()

    def without(self, fold: Callable[[int, Stretch], bool]) -> "Evidence":
        """Return the evidence without the stretches for which ``fold(number within the gyro, stretch)`` is true."""
        kept = [[n for n, stretch in enumerate(gyro.stretches) if not fold(n, stretch)] for gyro in self.gyros]
        gyros = [gyro.only(own) for gyro, own in zip(self.gyros, kept, strict=True)]
        return Evidence(gyros, self.shapes, self.excess)

    def under(self, noise: int) -> "Evidence":
        """Return that under one of the noise models alone."""
        return Evidence(self.gyros, self.shapes.select(np.arange(len(self.shapes)) == noise), self.excess)

    def narrow(self, models: Sequence[Sequence[Term]]) -> None:
        """Keep noise models that matter beside any of ``models`` or have no walk and hardly any turn-on; refresh."""
        keep = (self.shapes.walk == 0) & (self.shapes.turn_on <= _HARDLY)
        for terms in models:
            log = self.by_noise(terms) + self.shapes.log_prior
            keep |= log > log.max() - _MATTERS
        self.shapes = self.shapes.select(keep)
        self.refresh()

    def refresh(self) -> None:
        """Recompute the densities and their log determinants after the noise models or the excess have changed."""
        self.noise_logs = np.zeros((len(self.gyros), len(self.shapes)))
        self._densities: list[Floats] = []
        for gyro, log in zip(self.gyros, self.noise_logs, strict=True):
            densities = [np.empty((len(self.shapes), 0))]
            for stretch in gyro.stretches:
                density = self.density(gyro, stretch)
                log -= 0.5 * np.log(density) @ stretch.counts
                densities.append(density)
            self._densities.append(np.hstack(densities))

    def density(self, gyro: GyroSpectra, stretch: Stretch) -> Floats:
        """Return the variance (G, bands) of a coefficient over that of white noise, including the excess."""
        more = self.excess.get((gyro.name, stretch.run), AS_MODELLED)
        return self.shapes.density(stretch) * more.at(stretch.band_hz)

    def gram(self, rows: Numbers, columns: Numbers) -> Floats:
        """Return the products (gyros, G, ...) of pairs of columns, as the numbers broadcast, under each noise model."""
        pairs = zip(self.gyros, self._densities, strict=True)
        return np.array([gyro.gram(densities, rows, columns) for gyro, densities in pairs])

    def allow_for_misfit(self, rich: Sequence[Term]) -> None:
        """Set ``excess`` to what all known terms together leave beyond the noise models, by gyro, run and band.

        Every effect is then judged against that rest, which no function of measured values explains. ``rich`` are all
        terms, fitted by each gyro alone. The former ``excess`` is dropped; less noise than the models have is not
        allowed for. ``misfit`` becomes the excess by gyro and run, summed over blocks, in (rad/s)^2, 0 for none.
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
        """Scale the noise to what a model leaves: first ``level`` (gyros,), then bands that hold more or less.

        Both go to ``excess``. ``level`` is a variance over that of the gyro's ``arw``; ``least`` (gyros,) is its lower
        limit, as a density in rad/s sqrt(s). If any ``least`` is above 0, as of turns, only levels are set.
        """
        for level_only in (True, False)[: 1 if least.any() else 2]:
            for n, (gyro, (_, hz, _, squares, freedom)) in enumerate(zip(self.gyros, self._left(terms), strict=True)):
                if level_only:
                    self.level[n] = max(squares.sum() / max(freedom.sum(), 1.0), (float(least[n]) / gyro.arw) ** 2)
                profile = AS_MODELLED if level_only else Profile.of(hz, squares, freedom, less=True)
                profile = replace(profile, factor=self.level[n] * profile.factor)
                self.excess.update(dict.fromkeys(((gyro.name, s.run) for s in gyro.stretches), profile))
            self.refresh()

    def _left(self, terms: Sequence[Term]) -> list[Floats]:
        """Return by gyro what a model leaves by band, (5, n): run, frequency in Hz, noise, squares over it, freedom.

        The n bands are those of all stretches. Each gyro has its most probable noise model and fits shared terms by
        itself. The degrees of freedom are at least 5 % of the coefficients of a band.
        """
        own = [replace(term, shared=False) for term in terms]
        best = np.argmax(self.noise_weights(own), axis=0)
        columns = np.array([*_columns(own), Z])
        precision = _precision(own)
        found = []
        for gyro, densities, model in zip(self.gyros, self._densities, best.tolist(), strict=True):
            density = densities[model]
            products = gyro.products[columns[:, None], columns]
            gram = products @ (1 / density)
            covariance = np.linalg.inv(gram[:-1, :-1] + np.diag(np.concatenate([1 / gyro.prior, precision])))
            left = np.append(-covariance @ gram[:-1, -1], 1.0)  # share of each column in the residual
            squares = np.maximum(left @ np.tensordot(left, products, 1), 0.0) / density
            fitted = np.tensordot(np.pad(covariance, ((0, 1), (0, 1))), products, 2) / density
            counts = np.concatenate([stretch.counts for stretch in gyro.stretches])
            used = np.concatenate([stretch.used * stretch.counts for stretch in gyro.stretches])
            run = np.concatenate([np.full(len(stretch.counts), stretch.run) for stretch in gyro.stretches])
            hz = np.concatenate([stretch.band_hz for stretch in gyro.stretches])
            found.append(np.array([run, hz, density, squares, np.maximum(used - fitted, 0.05 * counts)]))
        return found

    def of(self, terms: Sequence[Term]) -> float:
        """Return the log evidence of a set of terms, over all noise models."""
        return log_mean(self.by_noise(terms), self.shapes.log_prior)

    def by_noise(self, terms: Sequence[Term]) -> Floats:
        """Return the log evidence (G,) of a set of terms under each noise model."""
        return Base(self, terms).by_noise()

    def noise_weight(self, terms: Sequence[Term]) -> Floats:
        """Return the probability of each noise model (G,) beside terms, if all gyros have the same."""
        return _normal(self.by_noise(terms) + self.shapes.log_prior)

    def noise_weights(self, terms: Sequence[Term]) -> Floats:
        """Return the probability of each noise model for each gyro (G, gyros); gyros are expected to be similar.

        Each gyro fits shared terms by itself.
        """
        evidence = Base(self, [replace(term, shared=False) for term in terms]).by_gyro().T
        prior = self.shapes.log_prior[:, None]
        if evidence.shape[1] == 1:
            return _normal(evidence + prior)
        others = _normal(prior + evidence.sum(axis=1, keepdims=True) - evidence)
        return _normal(evidence + np.log((1 - _OWN) * others + _OWN * np.exp(prior)))

    def posterior(self, terms: Sequence[Term], weight: Floats | None = None) -> Posterior:
        """Return the estimate of states and effects, averaged over the noise models that matter.

        ``weight`` is their probability: (G,) for all gyros, (G, gyros) for each; by default that beside these terms,
        for all gyros. Columns are the states, terms of each gyro, then shared ones.
        """
        weight = self.noise_weight(terms) if weight is None else weight
        each = np.broadcast_to(weight.reshape(len(weight), -1), (len(weight), len(self.gyros)))
        own, shared = _split(terms)
        columns = _columns(own)
        m, h = len(columns), sum(len(term.columns) for term in shared)
        asked = np.array([*columns, *(c for term in shared for c in term.columns), Z])
        parts = []
        for gyro, densities, its in zip(self.gyros, self._densities, each.T, strict=True):
            matter = np.flatnonzero(its > 1e-4)
            gram = gyro.gram(densities[matter], asked[:, None], asked)
            precision = np.diag(np.concatenate([1 / gyro.prior, _precision(own)]))
            inner = np.linalg.inv(gram[:, :m, :m] + precision)
            across = gram[:, :m, m:]
            gain = inner @ across
            left = gram[:, m:, m:] - across.transpose(0, 2, 1) @ gain
            chance = its[matter] / its[matter].sum()
            parts.append((chance, inner, gain, left, left if weight.ndim == 1 else chance @ left.swapaxes(0, 1)))
        prior = np.diag(_precision(shared))
        found = Posterior(asked[:-1].tolist(), [], [])
        of_all = np.sum([said for *_, said in parts], axis=0)
        for chance, inner, gain, left, said in parts:
            # The other gyros' information on shared terms is taken under their own noise.
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
    """A model of which states and own terms are eliminated once, so that each further term costs little.

    With the states and own terms m, what is left of the products of other columns a and b is
    G_ab - G_ma' (G_mm + precision)^-1 G_mb, for each gyro and under each noise model.
    """

    def __init__(self, evidence: Evidence, terms: Sequence[Term], others: Sequence[int] = ()) -> None:
        """Eliminate the states and the terms that each gyro has for itself; terms shared by all gyros stay.

        ``others`` are further columns whose products with the eliminated ones are needed later.
        """
        own, self._shared = _split(terms)
        model = np.array(_columns(own))
        self._last = np.array([*(c for term in self._shared for c in term.columns), Z])
        asked = np.array([*others, *self._last], dtype=np.intp)
        precision = np.array([np.concatenate([1 / gyro.prior, _precision(own)]) for gyro in evidence.gyros])
        block = evidence.gram(model[:, None], model) + (precision[:, :, None] * np.eye(len(model)))[:, None]
        self._across = evidence.gram(model[:, None], asked)
        self._gain = np.linalg.solve(block, self._across)
        self._place = np.zeros(int(asked.max()) + 1, dtype=np.intp)
        self._place[asked] = np.arange(len(asked))
        self._evidence, self._prior = evidence, evidence.shapes.log_prior
        self._logs = evidence.noise_logs + 0.5 * np.log(precision).sum(axis=1)[:, None] - 0.5 * _log_det(block)

    def by_gyro(self) -> Floats:
        """Return the log evidence (gyros, G) of each gyro with its own terms."""
        z = np.array([[Z]])
        return np.asarray(self._logs - 0.5 * self.products(z, z)[:, :, 0, 0, 0])

    def by_noise(self) -> Floats:
        """Return the log evidence (G,)."""
        return _without_shared(self._total(), self._shared, self._logs.sum(axis=0))

    def products(self, rows: Numbers, columns: Numbers) -> Floats:
        """Return the products of columns that states and own terms leave, (gyros, G, K, r, c).

        ``rows`` (K, r) and ``columns`` (K, c) are numbers among ``others``, shared terms and z; sets of rows and
        columns are paired.
        """
        across = self._across[..., self._place[rows]].transpose(0, 1, 3, 4, 2)
        gain = self._gain[..., self._place[columns]].transpose(0, 1, 3, 2, 4)
        return np.asarray(self._evidence.gram(rows[:, :, None], columns[:, None, :]) - across @ gain)

    def _total(self) -> Floats:
        """Return the products (G, h + 1, h + 1) of shared columns and z, summed over gyros."""
        return np.asarray(self.products(self._last[None], self._last[None])[:, :, 0].sum(axis=0))

    def with_functions(self, columns: Numbers, sizes: Floats, scales: Floats) -> Floats:
        """Return the log evidence (s, G) with some functions added that each gyro has for itself, at scales (s,).

        The functions are ``columns`` (c,), numbers of columns, times ``sizes`` (c,).
        """
        return self._with_own(columns[None], sizes[None], scales)[:, :, 0]

    def with_each(self, terms: Sequence[Term]) -> list[tuple[float, Term]]:
        """Return for each term, in order, the log evidence with it, less its ``log_tries``, and it at its best scale.

        Names of terms must differ. The log evidence is that of all gyros, averaged over all scales and noise models.
        """
        found: dict[str, tuple[float, Term]] = {}
        alike = groupby(sorted(terms, key=_form), key=_form)
        for (shared, _), group in alike:
            of_form = list(group)
            columns = np.array([term.columns for term in of_form], dtype=np.intp)
            sizes = np.array([term.relative_sizes for term in of_form])
            with_each_of_form = self._with_shared if shared else self._with_own
            values = with_each_of_form(columns, sizes, SCALES)
            values = np.logaddexp.reduce(values + self._prior[:, None], axis=1)
            best = np.argmax(values, axis=0)
            means = np.logaddexp.reduce(values, axis=0) - np.log(len(SCALES))
            for term, value, scale in zip(of_form, means.tolist(), SCALES[best].tolist(), strict=True):
                found[term.name] = (value - term.log_tries, term.scaled(scale))
        return [found[term.name] for term in terms]

    def _with_own(self, columns: Numbers, sizes: Floats, scales: Floats) -> Floats:
        """Return the log evidence (s, G, K) with each of K terms that every gyro has to itself, at scales (s,).

        A term is its ``columns`` (K, p) times ``sizes`` (K, p).
        """
        block = self.products(columns, columns) * (sizes[:, :, None] * sizes[:, None, :])
        last = np.broadcast_to(self._last, (len(columns), len(self._last)))
        across = self.products(columns, last) * sizes[:, :, None]
        terms = _Scaled.of(block, across)
        total, log = self._total()[:, None], self._logs.sum(axis=0)[:, None]
        values = []
        for scale in scales.tolist():
            gained, taken = terms.at(scale)
            values.append(_without_shared(total - taken.sum(axis=0), self._shared, log + gained.sum(axis=0)))
        return np.array(values)

    def _with_shared(self, columns: Numbers, sizes: Floats, scales: Floats) -> Floats:
        """Return the log evidence (s, G, K) with each of K terms that all gyros share, at scales (s,).

        A term is its ``columns`` (K, p) times ``sizes`` (K, p).
        """
        last = np.broadcast_to(self._last, (len(columns), len(self._last)))
        both = np.hstack([columns, last])
        scale_of = np.hstack([sizes, np.ones(last.shape)])
        total = self.products(both, both).sum(axis=0) * (scale_of[:, :, None] * scale_of[:, None, :])
        # The shared terms of the model go first: they are the last columns but z.
        p, h = columns.shape[1], len(self._last) - 1
        rest = np.array([*range(p), p + h])
        log = self._logs.sum(axis=0)[:, None]
        if h:
            precision = _precision(self._shared)
            shared = total[..., p : p + h, p : p + h] + np.diag(precision)
            beside = total[..., p : p + h, rest]
            taken = beside.swapaxes(-1, -2) @ np.linalg.solve(shared, beside)
            total = total[..., rest[:, None], rest] - taken
            log = log + 0.5 * np.log(precision).sum() - 0.5 * _log_det(shared)
        terms = _Scaled.of(total[..., :p, :p], total[..., :p, p:])
        values = []
        for scale in scales.tolist():
            gained, taken = terms.at(scale)
            values.append(log + gained - 0.5 * (total[..., p, p] - taken[..., 0, 0]))
        return np.array(values)


@dataclass(frozen=True, slots=True, eq=False)
class _Scaled:
    """Terms whose parameters all have the same scale, rotated so that their products are diagonal.

    ``power`` (..., p) are the eigenvalues of their products, ``across`` (..., p, r) their products with r other
    columns.
    """

    power: Floats
    across: Floats

    @classmethod
    def of(cls, block: Floats, across: Floats) -> "_Scaled":
        """Return that of terms with products (..., p, p) of their own, and (..., p, r) with other columns."""
        power, turned = np.linalg.eigh(block)
        return cls(np.maximum(power, 0.0), turned.swapaxes(-1, -2) @ across)

    def at(self, scale: float) -> tuple[Floats, Floats]:
        """Return what the terms add to the log evidence (...), and take from products (..., r, r), at a scale."""
        grown = 1 + scale**2 * self.power
        weighed = self.across * (scale**2 / grown)[..., None]
        return -0.5 * np.log(grown).sum(axis=-1), self.across.swapaxes(-1, -2) @ weighed


def _form(term: Term) -> tuple[bool, int]:
    """Return the key of terms that can be computed together."""
    return term.shared, len(term.columns)


def _without_shared(total: Floats, shared: Sequence[Term], log: Floats) -> Floats:
    """Return the log evidence (...) with the shared terms eliminated, too; they may be none.

    ``total`` (..., h + 1, h + 1) are the products of their h columns and of z, which is the last. ``log`` (...) is the
    part of the log evidence that does not depend on z.
    """
    left = total[..., -1, -1]
    if shared:
        precision = _precision(shared)
        block = total[..., :-1, :-1] + np.diag(precision)
        across = total[..., :-1, -1:]
        left = left - (across.swapaxes(-1, -2) @ np.linalg.solve(block, across))[..., 0, 0]
        log = log + 0.5 * np.log(precision).sum() - 0.5 * _log_det(block)
    return np.asarray(log - 0.5 * left)


def _log_det(block: Floats) -> Floats:
    """Return the logarithms (...) of the determinants of positive matrices (..., c, c)."""
    return np.asarray(np.linalg.slogdet(block)[1])


def _normal(log: Floats) -> Floats:
    weight = np.exp(log - log.max(axis=0))
    return np.asarray(weight / weight.sum(axis=0))


def _split(terms: Sequence[Term]) -> tuple[list[Term], list[Term]]:
    return [t for t in terms if not t.shared], [t for t in terms if t.shared]


def _columns(terms: Sequence[Term]) -> list[int]:
    """Return the columns of the states and of terms that each gyro has to itself."""
    return [*range(Z), *(column for term in terms for column in term.columns)]


def _precision(terms: Sequence[Term]) -> Floats:
    return np.concatenate([np.empty(0), *(t.precision for t in terms)])
