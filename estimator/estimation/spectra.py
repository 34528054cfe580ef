"""Products of columns by frequency: the sums that estimates and evidence need, for all noise models at once.

The blocks of a stretch are taken through the discrete cosine transform. In it white noise is white, and a random walk
has independent coefficients, exactly (its increments mirror at both ends); flicker noise nearly so. Noise is thus a
weight for each frequency, and the products of all columns, summed within narrow bands, serve every noise model.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from estimator.estimation.runs.run import Run, with_gyro
from estimator.geometry.noise import NoiseModel
from estimator.types import Floats

_BANDS_A_DECADE = 8
_UNLIKE = 5.0  # over the root of how many frequencies tell it: by so much levels of noise differ that are not the same
_FEWEST, _FEWEST_TURNS = 10, 2  # blocks of a stretch; of turns each is a row of its own
_SINGLE = 12  # each of the lowest frequencies of a stretch has a band of its own, up to this number
_WHITE = 0.6  # expected before the data: that a kind of coloured noise is too small to matter
_STATED_SPREAD = np.log(3.0)  # how far a device's instability may be from its data sheet
_LEAST = 0.05  # expectation of no coloured noise at most, where the data sheet states some
_TELLING, _BY_CHANCE = 8.0, 1e-4
"""Degrees of freedom in which a level of noise is looked for, and its probability by chance."""
_TURN_ON_FINE = np.geomspace(0.2, 200.0, 7)
_TURN_ON, _TURN_ON_EXPECTED = np.array([0.0, 0.2, 2.0, 50.0]), np.array([0.45, 0.2, 0.2, 0.15])


def cosines(values: Floats, axis: int = 0) -> Floats:
    """Return the orthonormal cosine transform of values along an axis, by default of columns (b, c) over rows."""
    from scipy.fft import dct

    return np.asarray(dct(values, axis=axis, norm="ortho"))


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class Stretch:
    """A stretch of a run: its blocks, and the band (b,) that each of its frequencies (b,) in Hz falls into.

    ``level`` is the variance of its white noise over that of all runs, ``used`` the share of blocks that hold data.
    """

    run: int
    blocks: slice
    frequency_hz: Floats
    band: NDArray[np.intp]
    band_hz: Floats
    counts: Floats
    length_s: float
    alone: bool
    level: float = 1.0
    used: float = 1.0

    @classmethod
    def of(cls, run: int, blocks: slice, length_s: float, alone: bool) -> "Stretch":
        """Return the stretch of some blocks of a run, its frequencies sorted into bands that widen with frequency.

        ``alone``: there is no other recording, so that the power was not off in between.
        """
        n = blocks.stop - blocks.start
        frequency = np.arange(n) / (2 * n * length_s)
        k = np.arange(n)
        log_band = _SINGLE + np.floor(_BANDS_A_DECADE * np.log10(np.maximum(k, _SINGLE) / _SINGLE)).astype(np.intp)
        band = np.where(k < _SINGLE, k, log_band)
        _, band = np.unique(band, return_inverse=True)
        counts = np.bincount(band).astype(np.float64)
        hz = np.bincount(band, frequency) / counts
        return cls(
            run=run,
            blocks=blocks,
            frequency_hz=frequency,
            band=band.astype(np.intp),
            band_hz=hz,
            counts=counts,
            length_s=length_s,
            alone=alone,
        )

    def by_band(self, left: Floats, right: Floats) -> Floats:
        """Return the products (bands, l, r) of columns (b, l) and (b, r), summed over the frequencies of each band."""
        edges = np.flatnonzero(np.diff(self.band, prepend=-1, append=-1)).tolist()
        return np.array([left[a:b].T @ right[a:b] for a, b in pairwise(edges)])


@dataclass(frozen=True, slots=True, eq=False)
class NoiseShapes:
    """Noise models to choose among: ratios to the angle random walk of bias instability (rtHz), walk (Hz), and the
    standard deviation of a bias from recording to recording (rtHz); (G,) each, with their log expectations.

    ``span_s`` is the length of the longest recording. A bias is that of a recording: of flicker noise, which goes on to
    ten times the span as in ``noise.MeansCovariance``, the mean of a stretch has (ln 10 + 3/2) / pi of its square in
    variance; of a random walk the bias is its value in the middle, or at power-on if there are several recordings.
    """

    instability: Floats
    walk: Floats
    turn_on: Floats
    log_prior: Floats
    span_s: float

    @classmethod
    def over(
        cls, span_s: float, stated: NoiseModel | None = None, *, several: bool = False, finely: bool = False
    ) -> "NoiseShapes":
        """Return the noise models that a recording of length ``span_s``, or ``several``, can tell apart.

        ``stated`` is the noise of a data sheet, which makes models near it likelier; one without angle random walk
        counts as None. Biases differ from recording to recording only with ``several``; ``finely`` takes finer steps
        for these, for estimates in which they are the noise of the states.
        """
        arw = stated.arw if stated is not None else 0.0
        ratios = (stated.instability / arw, stated.walk / arw) if stated is not None and arw > 0 else (0.0, 0.0)
        instability, chance_b = _expected(np.geomspace(1.0, 60, 6) / np.sqrt(span_s), ratios[0])
        walk, chance_k = _expected(np.geomspace(0.5, 40, 4) / span_s, ratios[1])
        turn_on, chance_t = (_TURN_ON, _TURN_ON_EXPECTED) if several else (np.zeros(1), np.ones(1))
        if several and finely:
            turn_on = np.concatenate([[0.0], _TURN_ON_FINE])
            chance_t = np.concatenate(
                [chance_t[:1], np.full(len(_TURN_ON_FINE), chance_t[1:].sum() / len(_TURN_ON_FINE))]
            )
        b, k, t = (part.ravel() for part in np.meshgrid(instability, walk, turn_on, indexing="ij"))
        return cls(b, k, t, np.log(np.einsum("b,k,t->bkt", chance_b, chance_k, chance_t).ravel()), span_s)

    def select(self, keep: NDArray[np.bool_]) -> "NoiseShapes":
        """Return the noise models for which ``keep`` (G,) is true."""
        parts = (self.instability[keep], self.walk[keep], self.turn_on[keep], self.log_prior[keep])
        return NoiseShapes(*parts, self.span_s)

    def density(self, stretch: Stretch) -> Floats:
        """Return for each of the G noise models the variance of a coefficient in each band, relative to white noise.

        The result is (G, bands). Band 0 is the mean of the stretch: its value includes the variance of the bias.
        """
        circle = 2 * np.pi * np.maximum(stretch.band_hz, 1e-12)
        out = stretch.level + self.instability[:, None] ** 2 / circle + (self.walk[:, None] / circle) ** 2
        own_s = len(stretch.band) * stretch.length_s
        flicker = (np.log(10 * max(self.span_s / own_s, 1.0)) + 1.5) / np.pi
        walk_s = own_s / 12 + max(self.span_s - own_s, 0.0) / 3 + (0.0 if stretch.alone else self.span_s)
        bias = self.instability**2 * flicker + self.walk**2 * walk_s + (0.0 if stretch.alone else self.turn_on**2)
        out[:, 0] = stretch.level + own_s * bias
        return np.asarray(out)

    def __len__(self) -> int:
        return len(self.instability)


def _expected(sizes: Floats, stated: float) -> tuple[Floats, Floats]:
    """Return ratios to the angle random walk (none, then ``sizes``) and the probability expected of each.

    ``stated`` is the ratio of a data sheet, 0 for none. Without one it is more probable than not that there is none,
    and all sizes are equally probable. With one the probability falls off with the logarithm of the ratio to it.
    """
    values = np.concatenate([[0.0], sizes])
    if stated <= 0:
        return values, np.concatenate([[_WHITE], np.full(len(sizes), (1 - _WHITE) / len(sizes))])
    least = sizes[0] / 2  # a size that cannot matter counts as none
    chance = np.exp(-0.5 * (np.log(np.maximum(values, least) / max(stated, least)) / _STATED_SPREAD) ** 2)
    chance[0] = chance[0] if stated < sizes[0] else min(chance[0], _LEAST)
    return values, chance / chance.sum()


@dataclass(frozen=True, slots=True, eq=False)
class Profile:
    """Factor by which the noise of a gyro in a run exceeds its models: ``factor`` (f,) at the frequencies ``hz``
    (f,).
    """

    hz: Floats
    factor: Floats

    def at(self, hz: Floats) -> Floats:
        """Return the factor (n,) at frequencies."""
        edges = np.sqrt(self.hz[1:] * self.hz[:-1])
        return np.asarray(self.factor[np.searchsorted(edges, hz)])

    @classmethod
    def of(cls, hz: Floats, squares: Floats, freedom: Floats, *, less: bool) -> "Profile":
        """Return the profile of residuals given by band (n,): ``squares`` over their degrees of ``freedom``.

        The factor is 1 where the ratio may be chance, and where it is below 1 unless ``less`` allows that. Neighbouring
        bands are merged until they have enough degrees of freedom.
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


AS_MODELLED = Profile(np.ones(1), np.ones(1))
"""Noise that is what its models say."""


@dataclass(slots=True, eq=False)
class GyroSpectra:
    """One gyro over all runs: its columns in the cosine domain, and their products by band.

    ``columns`` holds for each stretch (b, c): the four states first, then z, then those of effects as they are added;
    ``products`` (c, c, bands of all stretches) likewise. All are divided by the white noise of one block, whose density
    is ``arw``.
    """

    name: str
    prior: Floats
    arw: float
    stretches: list[Stretch]
    columns: list[Floats]
    products: Floats = field(default_factory=lambda: np.empty((0, 0, 0)))

    def parts(self, runs: Sequence[Run], columns: Callable[[int, int], Floats]) -> list[Floats]:
        """Return weighted columns (b, c) of each stretch; ``columns`` gives those of a run by run and gyro number."""
        whole: dict[int, Floats] = {}
        for number in {stretch.run for stretch in self.stretches}:
            own = runs[number].array.names.index(self.name)
            whole[number] = runs[number].weighed(columns(number, own), own)
        return [whole[stretch.run][stretch.blocks] for stretch in self.stretches]

    def add(self, new: Sequence[Floats]) -> None:
        """Add columns (b, c), one array for each stretch, in the time domain and in rad/s."""
        count = self.columns[0].shape[1]
        self.put(np.arange(count, count + new[0].shape[1]), [cosines(part) for part in new])

    def put(self, numbers: NDArray[np.intp], turned: Sequence[Floats]) -> None:
        """Set the columns with these numbers (k,), which may lie beyond the present ones, and their products.

        ``turned`` holds for each stretch (b, k): columns in the cosine domain, in rad/s.
        """
        self.widen(int(numbers.max(initial=-1)) + 1)
        for stretch, bands, own, new in zip(self.stretches, self.bands(), self.columns, turned, strict=True):
            own[:, numbers] = new * (np.sqrt(stretch.length_s) / self.arw)
            border = stretch.by_band(own, own[:, numbers])
            self.products[:, numbers, bands] = border.transpose(1, 2, 0)
            self.products[numbers, :, bands] = border.transpose(2, 1, 0)

    def widen(self, count: int) -> None:
        """Replace columns and products by ones with room for ``count`` columns, new ones zero; do nothing if there are
        as many.
        """
        old, more = len(self.products), count - self.columns[0].shape[1]
        if more > 0:
            self.columns = [np.pad(own, ((0, 0), (0, more))) for own in self.columns]
            products = np.zeros((count, count, sum(len(stretch.counts) for stretch in self.stretches)))
            products[:old, :old, : self.products.shape[-1]] = self.products
            self.products = products

    def subtract(self, parts: Sequence[Floats]) -> None:
        """Take a column (b, 1) of each stretch, in the time domain and in rad/s, off the output error.

        Changes ``products`` in place, and replaces the items of ``columns``.
        """
        for i, (stretch, bands, part) in enumerate(zip(self.stretches, self.bands(), parts, strict=True)):
            self.columns[i] = self.columns[i].copy()
            self.columns[i][:, Z] -= cosines(part)[:, 0] * (np.sqrt(stretch.length_s) / self.arw)
            border = stretch.by_band(self.columns[i], self.columns[i][:, [Z]])[:, :, 0]
            self.products[:, Z, bands] = self.products[Z, :, bands] = border.T

    def bands(self) -> list[slice]:
        """Return which bands are those of each stretch."""
        ends = np.cumsum([0, *(len(stretch.counts) for stretch in self.stretches)])
        return [slice(first, last) for first, last in pairwise(ends.tolist())]

    def only(self, keep: Sequence[int]) -> "GyroSpectra":
        """Return the gyro with only the stretches whose numbers are in ``keep``."""
        bands = self.bands()
        products = [self.products[..., :0], *(self.products[..., bands[n]] for n in keep)]
        return replace(
            self,
            stretches=[self.stretches[n] for n in keep],
            columns=[self.columns[n] for n in keep],
            products=np.concatenate(products, axis=-1),
        )

    def gram(self, densities: Floats, rows: NDArray[np.intp], columns: NDArray[np.intp]) -> Floats:
        """Return the products (G, ...) of columns, summed over all bands, each divided by the densities (G, bands).

        The numbers in ``rows`` and ``columns`` are taken in pairs, as they broadcast.
        """
        products = self.products[rows, columns]
        *pairs, bands = products.shape
        summed = 1 / densities @ products.reshape(math.prod(pairs), bands).T
        return np.asarray(summed.reshape(len(densities), *pairs))


Z = 4
"""Column of the output error; the states come before it, effects after it."""


def gyro_spectra(runs: Sequence[Run], arw: Mapping[str, float] | None = None) -> list[GyroSpectra]:
    """Return the gyros of the runs, with the columns of states and output error over all long enough stretches.

    Gyros of one name in several runs are one; those without such a stretch are left out. Names come in the order of the
    runs.

    The white noise is the median over the upper half of the spectrum, where ramps and tones are few, and at least the
    stated noise of turns. ``arw`` gives it by name of the gyro instead (rad/s/rtHz), for runs of which much is left
    out. A run whose white noise differs by more than chance has a ``level`` of its own.
    """
    names = list(dict.fromkeys(name for run in runs for name in run.array.names))
    alone = len({run.order for run in runs}) == 1 and not any(run.recording.several_files for run in runs)
    found = []
    for name in names:
        stretches: list[Stretch] = []
        turned: list[Floats] = []
        prior = None
        for number, run, i in with_gyro(runs, name):
            prior = run.prior.variances()
            both = run.weighed(np.column_stack([run.state_columns()[i], run.z_rps[:, i]]), i)
            for blocks in stretches_used(run):
                used = float(np.mean(run.weight[blocks] > 0))
                stretches.append(replace(Stretch.of(number, blocks, run.length_s, alone), used=used))
                turned.append(cosines(both[blocks]))
        if prior is None or not stretches:
            continue
        stated = [runs[s.run].stated_rps * np.sqrt(s.length_s) for s in stretches]
        white = arw[name] if arw is not None else max(_white(turned, stretches), min(stated))
        stretches = _levelled(turned, stretches, white)
        stretches = [replace(s, level=max(s.level, (d / white) ** 2)) for s, d in zip(stretches, stated, strict=True)]
        gyro = GyroSpectra(name, prior, white, stretches, [np.empty((len(part), 0)) for part in turned])
        gyro.put(np.arange(Z + 1), turned)
        found.append(gyro)
    return found


def stretches_used(run: Run) -> list[slice]:
    """Return the blocks of each stretch of a run that is long enough to have a spectrum."""
    fewest = _FEWEST_TURNS if run.stated_rps else _FEWEST
    return [blocks for blocks in run.stretches() if blocks.stop - blocks.start >= fewest]


def _levelled(turned: Sequence[Floats], stretches: Sequence[Stretch], white: float) -> list[Stretch]:
    """Return stretches with ``level`` set to the variance of the white noise of their run over that of ``white``, 1
    where the difference may be chance.

    ``turned`` has by stretch the cosine coefficients (b, 5) of states and output error.
    """
    levels = {}
    for run in {stretch.run for stretch in stretches}:
        own = [n for n, stretch in enumerate(stretches) if stretch.run == run]
        ratio = _white([turned[n] for n in own], [stretches[n] for n in own]) / white
        known = sum(len(turned[n]) for n in own) / 2
        levels[run] = ratio**2 if abs(np.log(ratio)) > _UNLIKE / np.sqrt(known) else 1.0
    return [replace(stretch, level=levels[stretch.run]) for stretch in stretches]


def _white(turned: Sequence[Floats], stretches: Sequence[Stretch]) -> float:
    """Return the angle random walk (rad/s/rtHz), the median of the residual in the upper half of the frequencies.

    ``turned`` has by stretch the cosine coefficients (b, 5) of states and output error. It is at least 1e-9.
    """
    rows = np.vstack([np.sqrt(s.length_s) * part[len(part) // 2 :] for part, s in zip(turned, stretches, strict=True)])
    rest = rows[:, Z] - rows[:, :Z] @ np.linalg.lstsq(rows[:, :Z], rows[:, Z], rcond=1e-10)[0]
    free = 1 - rows.shape[1] / max(len(rows), 2 * rows.shape[1])  # share of a few rows that the states do not fit
    return float(max(np.median(np.abs(rest)) / 0.6745 / np.sqrt(free), 1e-9))
