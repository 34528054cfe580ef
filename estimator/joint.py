"""States, and laws that stand beside them, estimated together under noise that is found from the data.

Block means go through the cosine transform (``tracing.spectra``), in which coloured noise is a weight for each
frequency. Every noise model is gone through: how much of it is bias instability and how much rate random walk is not
known beforehand. The estimate is the mean over them, so its covariance holds the doubt about the noise too. Gyros of
one device are of one make: what the others say of the noise is the better part of what is expected of each. Where the
residual is beyond all models, up or down, its own spectrum is the noise. Without laws this is the estimate of four
states.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.blocks import Blocks
from estimator.effects.conditions import Conditions
from estimator.effects.effect import Effect
from estimator.errors import RecordingError
from estimator.noise import NoiseFound, NoiseModel
from estimator.recording import ImuData, Recording
from estimator.reference import TableReadings
from estimator.tracing.evidence import Evidence, Term
from estimator.tracing.runs import Run
from estimator.tracing.spectra import GyroSpectra, NoiseShapes, Stretch, Z, gyro_spectra
from estimator.tracing.tones import samples_of, tone_columns

Floats = NDArray[np.float64]

_OWN = 0.1  # share of the expectation on a gyro that does not follow the other gyros of its device
_WHITE = 0.65  # expected before the data: that a kind of coloured noise is too small to matter
_STATED_SPREAD = np.log(3.0)  # how far a device's instability may be from its data sheet
_LEAST = 0.05  # expectation of no coloured noise at most, where the data sheet states some
_LEAST_ARW = 1e-9  # rad/s/rtHz, below any gyro
_ACCELERATING = 0.02  # change of rate from block to block, as a share of the largest rate, that counts as a ramp
_FEWEST_STEADY = 40
_ASIDE = 0.1  # weight of ramps while steady rates are fitted
_ROWS_A_COLUMN = 4  # fewer and what is left of the blocks tells nothing of ramps
_TELLING, _BY_CHANCE = 16.0, 1e-4  # degrees of freedom that tell a level of noise, and its probability by chance


class TooShort(RecordingError):
    """Too few blocks to tell noise by its frequencies."""


@dataclass(frozen=True, slots=True, eq=False)
class Law:
    """An effect beside the states: mean and standard deviation that are expected of its parameters (p,).

    ``line`` names the line of the budget that holds what the data do not show of it; empty: it counts as noise.
    ``hz`` is the frequency of a tone, ``source`` the only source that it is of, empty for all.
    """

    called: str
    effect: Effect
    mean: Floats
    sd: Floats
    line: str = ""
    hz: float | None = None
    source: str = ""

    @property
    def shared(self) -> bool:
        """Whether all gyros have one set of its parameters."""
        return self.effect.shared


@dataclass(frozen=True, slots=True, eq=False)
class Joint:
    """Estimate of all gyros of some runs.

    By gyro ``means`` (c,) and ``covariances`` (c, c) of [states, laws]: laws in the order of ``laws``, those of a gyro
    its own before those that all share, each parameter in units of its expected sigma, from its expected value.
    ``noise`` is that which was found; ``arw`` and ``white`` (gyros,) are the white noise in all of the residual and in
    the upper half of its frequencies. ``runs`` are rid of what was expected of the laws, ``columns`` are theirs.
    """

    runs: list[Run]
    laws: list[Law]
    columns: list[Floats]
    means: list[Floats]
    covariances: list[Floats]
    noise: list[NoiseFound]
    arw: Floats
    white: Floats
    expected_nis: tuple[float, float]
    shapes: NoiseShapes
    weight: Floats
    spectra: list[GyroSpectra]
    profiles: list[_Profile]

    def gyros_of(self, run: int) -> range:
        """Return which of the gyros are those of a run."""
        first = sum(len(r.array) for r in self.runs[:run])
        return range(first, first + len(self.runs[run].array))

    def slice_of(self, law: int) -> slice:
        """Return where the parameters of a law are."""
        first = 4 + sum(len(one.sd) for one in self.laws[:law])
        return slice(first, first + len(self.laws[law].sd))

    def whitened(self, gyro: int) -> tuple[Floats, Floats]:
        """Return instants (b,) and the rows (b, c + 1) of [states, z, laws] as they count: of white noise of one."""
        from scipy.fft import idct

        spectra = self.spectra[gyro]
        parts = []
        for stretch, columns in zip(spectra.stretches, spectra.columns, strict=True):
            weight = (self.weight[:, gyro] @ (1 / self.shapes.density(stretch)))[stretch.band]
            parts.append(idct(columns * np.sqrt(weight)[:, None], axis=0, norm="ortho"))
        t_s = [self.runs[stretch.run].t_s[stretch.blocks] for stretch in spectra.stretches]
        return np.concatenate(t_s), np.vstack(parts)

    def halves(self) -> list[Joint]:
        """Return the estimates from the first and from the second half, under the noise of the whole.

        TooShort if a half has too few blocks.
        """
        begin = min(float(run.t_s[0]) for run in self.runs)
        middle_s = 0.5 * (begin + max(float(run.t_s[-1]) for run in self.runs))
        found = []
        for early in (True, False):
            keeps = [(run.t_s < middle_s) == early for run in self.runs]
            runs = [_some(run, keep) for run, keep in zip(self.runs, keeps, strict=True)]
            columns = [c[:, keep] for c, keep in zip(self.columns, keeps, strict=True)]
            spectra = _spectra(runs, columns)
            _flatten(spectra, _level(spectra, self.arw))
            _flatten(spectra, self.profiles)
            means, covariances = _posterior(spectra, self.shapes, self.laws, self.weight)
            found.append(
                replace(self, runs=runs, columns=columns, means=means, covariances=covariances, spectra=spectra)
            )
        return found


def joint_estimate(runs: Sequence[Run], laws: Sequence[Law] = (), stated: NoiseModel | None = None) -> Joint:
    """Return the estimate of the gyros of one device, each name once; ``stated`` is its data sheet's noise.

    Raises TooShort for a gyro with fewer blocks than tell noise by its frequencies.
    """
    ordered = sorted(laws, key=lambda law: law.shared)
    columns = [columns_of(run, ordered) for run in runs]
    expected = expected_of(ordered)
    moved = [
        _steadied(replace(r, z_rps=r.z_rps - np.einsum("mbp,p->bm", c, expected)), c)
        for r, c in zip(runs, columns, strict=True)
    ]
    if not all(len(run.t_s) for run in moved):
        raise TooShort("no block holds samples")
    shapes = _shapes(max(float(run.t_s[-1] - run.t_s[0]) + run.length_s for run in moved), stated)
    spectra = _spectra(moved, columns)
    white = np.array([gyro.arw for gyro in spectra])
    weight = _weights(spectra, shapes, ordered)
    means, covariances = _posterior(spectra, shapes, ordered, weight)
    unused = np.concatenate([np.full(len(run.array), float((run.weight <= 0).sum())) for run in moved])
    left = [_left(*each) for each in zip(spectra, means, covariances, _best(shapes, weight), strict=True)]
    level = [own[1].sum() / max(own[2].sum() - none, 1.0) for own, none in zip(left, unused.tolist(), strict=True)]
    arw = np.maximum(white * np.sqrt(level), _LEAST_ARW)
    _flatten(spectra, _level(spectra, arw))
    weight = _weights(spectra, shapes, ordered)
    means, covariances = _posterior(spectra, shapes, ordered, weight)
    left = [_left(*each) for each in zip(spectra, means, covariances, _best(shapes, weight), strict=True)]
    profiles = [_Profile.of(*own) for own in left]
    _flatten(spectra, profiles)
    weight = _weights(spectra, shapes, ordered)
    means, covariances = _posterior(spectra, shapes, ordered, weight)
    noise = [_noise(own, shapes, share) for own, share in zip(arw.tolist(), weight.T, strict=True)]
    chance = _expected_nis(spectra, shapes, weight)
    white = np.maximum(white, 1e-3 * arw)
    return Joint(
        list(moved), ordered, columns, means, covariances, noise, arw, white, chance, shapes, weight, spectra, profiles
    )


def run_of_blocks(source: str, data: ImuData, blocks: Blocks, reference: TableReadings) -> Run:
    """Return blocks as a run without conditions, of which only the states can be estimated; ``data`` may be empty."""
    b, m = (int(blocks.index[-1]) + 1 if len(blocks.index) else 0), len(data.array)
    w, z, weight = np.zeros((b, 3)), np.zeros((b, m)), np.zeros(b)
    w[blocks.index], z[blocks.index] = blocks.w_rps, blocks.z_rps
    weight[blocks.index] = 2 * blocks.held_s >= blocks.length_s
    none = np.empty((0, 0))
    nowhere = Conditions(np.empty(0), *(np.empty((0, 3)),) * 2, none, none, none, (), np.empty((0, 3)))
    return Run(
        name=source,
        source=source,
        data=data,
        length_s=blocks.length_s,
        t_s=np.asarray((np.arange(b) + 0.5) * blocks.length_s),
        w_rps=w,
        z_rps=z,
        weight=weight,
        stretch=np.zeros(b, dtype=np.intp),
        grid=nowhere,
        fold=lambda columns: columns,
        recording=Recording({source: data}, reference),
        period_s=blocks.period_s,
        order=0,
        held=1,
    )


def columns_of(run: Run, laws: Sequence[Law]) -> Floats:
    """Return the block means (m, b, p) of all laws, scaled by what is expected of each parameter."""
    waves: dict[str, Floats] = {}
    if any(law.hz is not None for law in laws):
        samples = samples_of(run)
        waves = {law.called: tone_columns(law.hz, run, samples) for law in laws if law.hz is not None}
    found = np.empty((len(run.array), len(run.t_s), sum(len(law.sd) for law in laws)))
    for gyro, own in enumerate(found):
        first = 0
        for law in laws:
            columns = waves[law.called] if law.called in waves else run.columns(law.effect, gyro)
            own[:, first : first + len(law.sd)] = columns * law.sd * (law.source in ("", run.source))
            first += len(law.sd)
    return found


def expected_of(laws: Sequence[Law]) -> Floats:
    """Return what is expected of each parameter of some laws (p,), in its sigmas."""
    return np.concatenate([np.zeros(0), *(law.mean / law.sd for law in laws)])


def _some(run: Run, keep: NDArray[np.bool_]) -> Run:
    """Return a run with some of its blocks only; its conditions stay those of all."""
    values: dict[str, Any] = {f.name: getattr(run, f.name) for f in fields(run)}
    parts: dict[str, Any] = {k: v[keep] for k, v in values.items() if isinstance(v, np.ndarray) and len(v) == len(keep)}
    return replace(run, **parts)


def _shapes(span_s: float, stated: NoiseModel | None) -> NoiseShapes:
    """Return the noise models that a recording of this length can tell apart, by what a data sheet expects."""
    ratios = (stated.instability, stated.walk) if stated is not None and stated.arw > 0 else (0.0, 0.0)
    arw = stated.arw if stated is not None and stated.arw > 0 else 1.0
    instability, chance_b = _expected(np.geomspace(0.7, 40, 9) / np.sqrt(span_s), ratios[0] / arw)
    walk, chance_k = _expected(np.geomspace(0.3, 60, 7) / span_s, ratios[1] / arw)
    b, k = (part.ravel() for part in np.meshgrid(instability, walk, indexing="ij"))
    # One recording is of one power-on: no bias changes but by wandering.
    return _OneRecording(b, k, np.zeros(len(b)), np.log(np.outer(chance_b, chance_k).ravel()), span_s)


def _expected(sizes: Floats, stated: float) -> tuple[Floats, Floats]:
    """Return none and these ratios to the angle random walk, and what is expected of each; ``stated``: 0 for none."""
    values = np.concatenate([[0.0], sizes])
    if stated <= 0:
        return values, np.concatenate([[_WHITE], np.full(len(sizes), (1 - _WHITE) / len(sizes))])
    least = sizes[0] / 2  # a size that cannot matter counts as none
    chance = np.exp(-0.5 * (np.log(np.maximum(values, least) / max(stated, least)) / _STATED_SPREAD) ** 2)
    chance[0] = chance[0] if stated < sizes[0] else min(chance[0], _LEAST)
    return values, chance / chance.sum()


@dataclass(frozen=True, slots=True, eq=False)
class _OneRecording(NoiseShapes):
    """Noise models of one recording of ``span_s``: its bias is that of its span, not that since power-on.

    Flicker noise goes on to ten times the span, as in ``noise.MeansCovariance``, so that the mean of a stretch has
    (ln 10 + 3/2) / pi of its square in variance; of a random walk the bias is its value in the middle.
    """

    span_s: float = 0.0

    def density(self, stretch: Stretch) -> Floats:
        out = NoiseShapes.density(self, stretch)
        own_s = len(stretch.band) * stretch.length_s
        flicker = (np.log(10 * self.span_s / own_s) + 1.5) / np.pi
        walk = own_s / 12 + (self.span_s - own_s) / 3
        out[:, 0] = 1 + own_s * (self.instability**2 * flicker + self.walk**2 * walk)
        return out

    def select(self, keep: NDArray[np.bool_]) -> NoiseShapes:
        part = NoiseShapes.select(self, keep)
        return _OneRecording(part.instability, part.walk, part.turn_on, part.log_prior, self.span_s)


def _steadied(run: Run, columns: Floats) -> Run:
    """Return a run whose ramps count less where their residual says so.

    While an axis accelerates, what the table reports is off by its timing and by what lies between two readings.
    """
    good = np.flatnonzero(run.weight > 0)
    if len(good) < _ROWS_A_COLUMN * (4 + columns.shape[2]):
        return run
    size = float(np.abs(run.w_rps[good]).max(initial=0.0))
    change = np.abs(np.diff(run.w_rps, axis=0, prepend=run.w_rps[:1])).max(axis=1)
    ramp = (np.maximum(change, np.append(change[1:], 0.0)) > _ACCELERATING * size)[good]
    if not ramp.any() or (~ramp).sum() < _FEWEST_STEADY:
        return run
    # What ramps alone show is fitted to them, everything else to steady rates.
    states, row, shares = run.state_columns()[:, good], np.where(ramp, _ASIDE, 1.0), []
    for i, own in enumerate(columns[:, good]):
        both, z = np.hstack([states[i], own]), run.z_rps[good, i]
        scale = np.maximum(np.linalg.norm(both, axis=0), 1e-300)
        rest = z - both @ (np.linalg.lstsq(both / scale * row[:, None], z * row, rcond=1e-8)[0] / scale)
        steady = float(np.mean(rest[~ramp] ** 2))
        # Only what is beyond chance: the mean square of so few has this much scatter of its own.
        excess = float(np.mean(rest[ramp] ** 2)) - steady * (1 + 2 * np.sqrt(2 / ramp.sum()))
        shares.append(max(excess, 0.0) / max(steady, 1e-30))
    weight = run.weight.copy()
    weight[good[ramp]] /= np.sqrt(1 + np.mean(shares))
    return replace(run, weight=weight)


def _spectra(runs: Sequence[Run], columns: Sequence[Floats]) -> list[GyroSpectra]:
    spectra = gyro_spectra(runs)
    if [gyro.name for gyro in spectra] != [name for run in runs for name in run.array.names]:
        raise TooShort("too few blocks of a gyro follow on each other")
    for gyro in spectra if columns[0].shape[2] else ():
        parts = []
        for stretch in gyro.stretches:
            run = runs[stretch.run]
            own = columns[stretch.run][run.array.names.index(gyro.name)]
            parts.append((own * run.weight[:, None])[stretch.blocks])
        gyro.add(parts)
    return spectra


@dataclass(frozen=True, slots=True, eq=False)
class _Profile:
    """By how much a noise is larger than its models say, by frequency: ``factor`` (f,) at ``hz`` (f,)."""

    hz: Floats
    factor: Floats

    def at(self, hz: Floats) -> Floats:
        """Return the factor (n,) at frequencies."""
        return np.exp(np.interp(np.log(np.maximum(hz, 1e-12)), np.log(self.hz), np.log(self.factor)))

    @classmethod
    def of(cls, hz: Floats, squares: Floats, freedom: Floats) -> _Profile:
        """Return that of what is left by band (n,); 1 where the difference may be chance."""
        from scipy.special import gammainc, gammaincc  # of the chi-square; scipy.stats takes a second to import

        group = np.floor(np.concatenate([[0.0], np.cumsum(freedom)[:-1]]) / _TELLING).astype(np.intp)
        _, group = np.unique(group, return_inverse=True)
        total, count = np.maximum(np.bincount(group, squares), 1e-12), np.bincount(group, freedom)
        chance = 2 * np.minimum(gammaincc(count / 2, total / 2), gammainc(count / 2, total / 2))
        middle = np.exp(np.bincount(group, np.log(np.maximum(hz, 1e-12))) / np.bincount(group))
        return cls(middle, np.where(chance < _BY_CHANCE, total / count, 1.0))


def _left(gyro: GyroSpectra, mean: Floats, covariance: Floats, shapes: NoiseShapes) -> tuple[Floats, Floats, Floats]:
    """Return by band, in order, its frequency (n,), the squares left over those of noise, and their freedom."""
    left = np.concatenate([-mean[:4], [1.0], -mean[4:]])
    free = np.r_[0:4, Z + 1 : len(left)]
    found: list[tuple[float, float, float]] = []
    for stretch, products in zip(gyro.stretches, gyro.products, strict=True):
        density = shapes.density(stretch)[0]
        squares = np.maximum(np.einsum("i,bij,j->b", left, products, left), 0.0) / density
        fitted = np.einsum("ij,bji->b", covariance, products[:, free][:, :, free]) / density
        freedom = np.maximum(stretch.counts - fitted, 0.05 * stretch.counts)
        found += zip(stretch.band_hz.tolist(), squares.tolist(), freedom.tolist(), strict=True)
    hz, squares, freedom = np.array(sorted(found)).T
    return hz, squares, freedom


def _level(spectra: Sequence[GyroSpectra], arw: Floats) -> list[_Profile]:
    """Return what makes the white noise of each gyro this (gyros,) at all frequencies."""
    return [_Profile(np.ones(1), np.array([(own / g.arw) ** 2])) for g, own in zip(spectra, arw, strict=True)]


def _best(shapes: NoiseShapes, weight: Floats) -> list[NoiseShapes]:
    """Return by gyro the noise model that is most probable."""
    return [_select(shapes, np.array([own])) for own in np.argmax(weight, axis=0)]


def _flatten(spectra: Sequence[GyroSpectra], profiles: Sequence[_Profile]) -> None:
    """Let frequencies count less by how much more noise they hold than the models of it say."""
    for gyro, profile in zip(spectra, profiles, strict=False):
        for i, stretch in enumerate(gyro.stretches):
            factor = profile.at(stretch.band_hz)
            gyro.products[i] = gyro.products[i] / factor[:, None, None]
            gyro.columns[i] = gyro.columns[i] / np.sqrt(factor[stretch.band])[:, None]


def _select(shapes: NoiseShapes, which: NDArray[np.intp]) -> NoiseShapes:
    return shapes.select(np.isin(np.arange(len(shapes)), which))


def _weights(spectra: Sequence[GyroSpectra], shapes: NoiseShapes, laws: Sequence[Law]) -> Floats:
    """Return how probable each noise model is for each gyro (G, gyros), which is expected to be like the others."""
    count = sum(len(law.sd) for law in laws)
    terms = [Term("laws", tuple(range(Z + 1, Z + 1 + count)), shared=False)] if count else []
    evidence = np.column_stack([Evidence([gyro], shapes).by_noise(terms) for gyro in spectra])
    prior = shapes.log_prior[:, None]
    if evidence.shape[1] == 1:
        return _normal(evidence + prior)
    others = _normal(prior + evidence.sum(axis=1, keepdims=True) - evidence)
    return _normal(evidence + np.log((1 - _OWN) * others + _OWN * np.exp(prior)))


def _normal(log: Floats) -> Floats:
    weight = np.exp(log - log.max(axis=0))
    return np.asarray(weight / weight.sum(axis=0))


def _posterior(
    spectra: Sequence[GyroSpectra], shapes: NoiseShapes, laws: Sequence[Law], weight: Floats
) -> tuple[list[Floats], list[Floats]]:
    """Return means (c,) and covariances (c, c) of [states, own laws, shared laws] by gyro, each under its own noise."""
    parts = [_reduced(gyro, shapes, laws, own) for gyro, own in zip(spectra, weight.T, strict=True)]
    h = parts[0].left.shape[-1] - 1
    of_all = np.sum([np.einsum("g,gij->ij", part.weight, part.left) for part in parts], axis=0)
    means, covariances = [], []
    for part in parts:
        # What the other gyros say of shared laws they say under their own noise.
        left = part.left + (of_all - np.einsum("g,gij->ij", part.weight, part.left))
        shared_covariance = np.linalg.inv(left[:, :h, :h] + np.eye(h))
        shared = (shared_covariance @ left[:, :h, h:])[..., 0]
        slope = part.gain[:, :, :h]
        x = np.hstack([part.gain[:, :, h] - np.einsum("gij,gj->gi", slope, shared), shared])
        across = -slope @ shared_covariance
        own = part.inner - across @ slope.transpose(0, 2, 1)
        whole = np.block([[own, across], [across.transpose(0, 2, 1), shared_covariance]])
        mean = part.weight @ x
        spread = x - mean
        means.append(mean)
        covariances.append(np.einsum("g,gij->ij", part.weight, whole + spread[:, :, None] * spread[:, None, :]))
    return means, covariances


@dataclass(frozen=True, slots=True, eq=False)
class _Reduced:
    """One gyro with its states and own laws eliminated, under the noise models that matter (G,).

    ``inner`` (G, c, c) is their covariance, ``gain`` (G, c, h + 1) what they take of [shared laws, z], ``left``
    (G, h + 1, h + 1) the products of these that are left.
    """

    weight: Floats
    inner: Floats
    gain: Floats
    left: Floats


def _reduced(gyro: GyroSpectra, shapes: NoiseShapes, laws: Sequence[Law], weight: Floats) -> _Reduced:
    matter = np.flatnonzero(weight > 1e-4)
    gram = Evidence([gyro], _select(shapes, matter)).grams[0]
    count = sum(len(law.sd) for law in laws if not law.shared)
    own = [*range(4), *range(Z + 1, Z + 1 + count)]
    rest = [*range(Z + 1 + count, gram.shape[1]), Z]
    precision = np.diag(np.concatenate([1 / gyro.prior, np.ones(count)]))
    inner = np.asarray(np.linalg.inv(gram[:, own][:, :, own] + precision), dtype=np.float64)
    across = gram[:, own][:, :, rest]
    gain = inner @ across
    left = gram[:, rest][:, :, rest] - across.transpose(0, 2, 1) @ gain
    return _Reduced(weight[matter] / weight[matter].sum(), inner, gain, left)


def _expected_nis(spectra: Sequence[GyroSpectra], shapes: NoiseShapes, weight: Floats) -> tuple[float, float]:
    """Return mean and standard deviation that the mean NIS of blocks has, taken as white, under the noise found."""
    total = squares = count = 0.0
    for gyro, own in zip(spectra, weight.T, strict=True):
        for stretch in gyro.stretches:
            density = (own @ shapes.density(stretch))[1:]  # the mean of a stretch is the bias
            counts = stretch.counts[1:]
            total += float(counts @ density)
            squares += float(2 * counts @ density**2)
            count += float(counts.sum())
    return total / count, float(np.sqrt(squares)) / count


def _noise(arw: float, shapes: NoiseShapes, weight: Floats) -> NoiseFound:
    instability, walk = shapes.instability * arw, shapes.walk * arw
    mean = NoiseModel(arw, float(weight @ instability), float(weight @ walk))
    return NoiseFound(mean, _quantile(instability, weight), _quantile(walk, weight))


def _quantile(values: Floats, weight: Floats, share: float = 0.95) -> float:
    """Return the value below which a share of the weight lies."""
    order = np.argsort(values)
    reached = np.searchsorted(np.cumsum(weight[order]), share - 1e-12)
    return float(values[order][min(int(reached), len(order) - 1)])
