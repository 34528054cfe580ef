"""Products of columns by frequency: what estimates, noise and evidence need of a run, under any noise at once.

The blocks of a stretch are taken through the discrete cosine transform. In it white noise is white, and a random walk
has independent coefficients, exactly (its increments mirror at both ends); flicker noise nearly so. Noise is thus a
weight for each frequency, and the products of all columns, summed within narrow bands, serve every noise model.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from estimator.tracing.runs import Run

Floats = NDArray[np.float64]

_BANDS_A_DECADE = 8
_UNLIKE = 5.0  # over the root of how many frequencies tell it: by so much levels of noise differ that are not the same
_FEWEST, _FEWEST_TURNS = 10, 2  # blocks of a stretch; of turns each is a row of its own
_SINGLE = 12  # so many of the lowest frequencies of a stretch have a band of their own


def cosines(columns: Floats) -> Floats:
    """Return the orthonormal cosine transform of columns (b, c) over rows."""
    from scipy.fft import dct

    return np.asarray(dct(columns, axis=0, norm="ortho"))


@dataclass(frozen=True, slots=True, eq=False)
class Stretch:
    """A stretch of a run: its blocks, and the band (b,) that each of its frequencies (b,) in Hz falls into.

    ``level`` is the variance of its white noise over that of all runs.
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

    @classmethod
    def of(cls, run: int, blocks: slice, length_s: float, alone: bool) -> Stretch:
        """Return that of some blocks; ``alone`` if there is no other recording: power was not off in between."""
        n = blocks.stop - blocks.start
        frequency = np.arange(n) / (2 * n * length_s)
        k = np.arange(n)
        log_band = _SINGLE + np.floor(_BANDS_A_DECADE * np.log10(np.maximum(k, _SINGLE) / _SINGLE)).astype(np.intp)
        band = np.where(k < _SINGLE, k, log_band)
        _, band = np.unique(band, return_inverse=True)
        counts = np.bincount(band).astype(np.float64)
        hz = np.bincount(band, frequency) / counts
        return cls(run, blocks, frequency, band.astype(np.intp), hz, counts, length_s, alone)

    @property
    def starts(self) -> NDArray[np.intp]:
        """First frequency of each band."""
        return np.flatnonzero(np.diff(self.band, prepend=-1))


@dataclass(frozen=True, slots=True, eq=False)
class NoiseShapes:
    """Noise models to choose among: ratios to the angle random walk of bias instability (rtHz), walk (Hz), and the
    standard deviation of a bias from stretch to stretch (rtHz); (G,) each, with their log expectations.
    """

    instability: Floats
    walk: Floats
    turn_on: Floats
    log_prior: Floats

    @classmethod
    def over(cls, span_s: float) -> NoiseShapes:
        """Return those that recordings of this length can tell apart."""
        instability = np.concatenate([[0.0], np.geomspace(1.0, 60.0, 6) / np.sqrt(span_s)])
        walk = np.concatenate([[0.0], np.geomspace(0.5, 40.0, 4) / span_s])
        turn_on = np.array([0.0, 0.5, 50.0])  # none beyond the wander, some, anything
        b, k, t = (part.ravel() for part in np.meshgrid(instability, walk, turn_on, indexing="ij"))
        chance = (
            np.where(b == 0, 0.4, 0.6 / 6)
            * np.where(k == 0, 0.6, 0.4 / 4)
            * np.array([0.45, 0.3, 0.25])[np.searchsorted(turn_on, t)]
        )
        return cls(b, k, t, np.log(chance))

    def select(self, keep: NDArray[np.bool_]) -> NoiseShapes:
        """Return only these."""
        return NoiseShapes(self.instability[keep], self.walk[keep], self.turn_on[keep], self.log_prior[keep])

    def density(self, stretch: Stretch) -> Floats:
        """Return the variance (G, bands) of a coefficient in each band over that of white noise."""
        hz = np.maximum(stretch.band_hz, 1e-12)
        circle = 2 * np.pi * hz
        out = stretch.level + self.instability[:, None] ** 2 / circle + (self.walk[:, None] / circle) ** 2
        span_s = len(stretch.band) * stretch.length_s
        wander = self.instability**2 * np.log(10 + span_s) / np.pi + self.walk**2 * span_s
        # The mean of a stretch holds what the bias has wandered to since another stretch, and since power-on.
        out[:, 0] = stretch.level + span_s * (wander + (0.0 if stretch.alone else self.turn_on**2))
        return np.asarray(out)

    def __len__(self) -> int:
        return len(self.instability)


@dataclass(slots=True, eq=False)
class GyroSpectra:
    """One gyro over all runs: its columns in the cosine domain, and their products by stretch and band.

    ``columns`` holds for each stretch (b, c): the four states first, then z, then those of effects as they are added;
    ``products`` (bands, c, c) likewise. All are over the white noise of one block, of which ``arw`` is the density.
    """

    name: str
    prior: Floats
    arw: float
    stretches: list[Stretch]
    columns: list[Floats]
    products: list[Floats] = field(default_factory=list)

    def add(self, new: Sequence[Floats]) -> None:
        """Add columns (b, c), one array for each stretch, in the time domain and in rad/s."""
        for i, (stretch, part) in enumerate(zip(self.stretches, new, strict=True)):
            turned = cosines(part) * (np.sqrt(stretch.length_s) / self.arw)
            old = self.columns[i]
            both = np.hstack([old, turned])
            c0, c1 = old.shape[1], both.shape[1]
            products = np.empty((len(stretch.counts), c1, c1))
            for band, start in enumerate(stretch.starts):
                stop = stretch.starts[band + 1] if band + 1 < len(stretch.starts) else len(both)
                border = both[start:stop].T @ turned[start:stop]
                products[band, :, c0:] = border
                products[band, c0:, :] = border.T
            if c0:
                products[:, :c0, :c0] = self.products[i]
            self.columns[i] = both
            if i < len(self.products):
                self.products[i] = products
            else:
                self.products.append(products)

    def subtract(self, parts: Sequence[Floats]) -> None:
        """Take something (b,) of each stretch, in rad/s, off the output error."""
        for i, (stretch, part) in enumerate(zip(self.stretches, parts, strict=True)):
            self.columns[i] = self.columns[i].copy()
            self.columns[i][:, Z] -= cosines(part[:, None])[:, 0] * (np.sqrt(stretch.length_s) / self.arw)
            whole = self.columns[i]
            for band, start in enumerate(stretch.starts):
                stop = stretch.starts[band + 1] if band + 1 < len(stretch.starts) else len(whole)
                border = whole[start:stop].T @ whole[start:stop, Z]
                self.products[i][band, :, Z] = border
                self.products[i][band, Z, :] = border

    def gram(self, densities: Sequence[Floats]) -> Floats:
        """Return the weighed products (G, c, c), summed over stretches of which the density (G, bands) is given."""
        total: Floats = np.zeros(())
        for products, density in zip(self.products, densities, strict=True):
            bands, c = products.shape[0], products.shape[1]
            total = total + (1 / density) @ products.reshape(bands, c * c)
        c = self.products[0].shape[1]
        return np.asarray(total).reshape(-1, c, c)


Z = 4
"""Column of the output error; the states come before it, effects after it."""


def gyro_spectra(runs: Sequence[Run], arw: Mapping[str, float] | None = None) -> list[GyroSpectra]:
    """Return every gyro of the runs, with the columns of its states and its output error.

    The white noise of a block is taken from the upper half of its spectrum, by the median: ramps and tones are few.
    ``arw`` states it by gyro (rad/s/rtHz) where much of the runs is left out.
    """
    names = list(dict.fromkeys(name for run in runs for name in run.array.names))
    alone = len({run.order for run in runs}) == 1
    found = []
    for name in names:
        stretches: list[Stretch] = []
        parts: list[Floats] = []
        prior = None
        for number, run in enumerate(runs):
            if name not in run.array.names:
                continue
            i = run.array.names.index(name)
            prior = run.prior.variances()
            both = run.weighed(np.column_stack([run.state_columns()[i], run.z_rps[:, i]]), i)
            for blocks in run.stretches():
                if blocks.stop - blocks.start >= (_FEWEST_TURNS if run.stated_rps else _FEWEST):
                    stretches.append(Stretch.of(number, blocks, run.length_s, alone))
                    parts.append(both[blocks])
        if prior is None or not stretches:
            continue
        stated = [runs[s.run].stated_rps * np.sqrt(s.length_s) for s in stretches]
        white = arw[name] if arw is not None else max(_white(parts, stretches), min(stated))
        stretches = _levelled(parts, stretches, white)
        stretches = [replace(s, level=max(s.level, (d / white) ** 2)) for s, d in zip(stretches, stated, strict=True)]
        gyro = GyroSpectra(name, prior, white, stretches, [np.empty((len(p), 0)) for p in parts])
        gyro.add(parts)
        found.append(gyro)
    return found


def _levelled(parts: Sequence[Floats], stretches: Sequence[Stretch], white: float) -> list[Stretch]:
    """Return stretches with the level of the white noise of their run, where that is not the level of all by chance."""
    levels = {}
    for run in {stretch.run for stretch in stretches}:
        own = [n for n, stretch in enumerate(stretches) if stretch.run == run]
        ratio = _white([parts[n] for n in own], [stretches[n] for n in own]) / white
        known = sum(len(parts[n]) for n in own) / 2
        levels[run] = ratio**2 if abs(np.log(ratio)) > _UNLIKE / np.sqrt(known) else 1.0
    return [replace(stretch, level=levels[stretch.run]) for stretch in stretches]


def _white(parts: Sequence[Floats], stretches: Sequence[Stretch]) -> float:
    """Return the angle random walk (rad/s/rtHz) from the upper half of the frequencies."""
    rows = np.vstack(
        [np.sqrt(s.length_s) * cosines(part)[len(part) // 2 :] for part, s in zip(parts, stretches, strict=True)]
    )
    rest = rows[:, Z] - rows[:, :Z] @ np.linalg.lstsq(rows[:, :Z], rows[:, Z], rcond=1e-10)[0]
    free = 1 - rows.shape[1] / max(len(rows), 2 * rows.shape[1])  # what the states take of a few rows
    return float(max(np.median(np.abs(rest)) / 0.6745 / np.sqrt(free), 1e-9))
