"""N, B and K of a sensor with intervals of 95 %, from the likelihood of its series at rest.

Points of an Allan deviation at different averaging times are correlated, so a fit of the curve has no sigmas. The
cosine transform of the series has coefficients that are independent but for a little flicker noise, so their likelihood
has: an interval holds what is not less likely than the chi-square distribution allows, with the other two fitted.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from estimator.observations.allan.likelihood import Bands
from estimator.observations.allan.spectrum import TERMS, allan_variances, band_of, cosine_variances
from estimator.types import Flags, Floats

_RISE = 3.8415  # of the deviance at the ends of an interval of 95 %: chi-square of one degree of freedom
_FINEST_S = 0.01  # shorter times show the sensor's filter and its steps, not its random walks
_FEWEST = 16  # means of a stretch that counts
_FLAT_DECADES = 1.0  # a floor shorter than this is no bias instability
_UNLIKE = 4.5  # sigmas by which an octave differs from the prediction of all below it
_LEAST_BANDS = 12  # that are left when the highest octaves are taken away


@dataclass(frozen=True, slots=True)
class Term:
    """Size of one noise term, SI: the most likely value, and its 95 % interval.

    A term that is not ``seen`` is at most ``high`` (95 %), and ``low`` is 0. N and K are seen if they are the larger
    part of the Allan variance at some averaging time, B if it is over a decade.
    """

    value: float
    low: float
    high: float
    seen: bool


@dataclass(frozen=True, slots=True)
class NoiseTerms:
    """N, B and K of one sensor.

    ``shortest_s`` is the averaging time from which they hold: if ``trimmed``, a filter shapes the noise below it.
    ``unlike_hz`` is the middle of an octave whose noise is ``unlike`` times that of the three terms; None if all agree.
    """

    n: Term
    b: Term
    k: Term
    shortest_s: float
    trimmed: bool = False
    unlike_hz: float | None = None
    unlike: float = 1.0

    def __getitem__(self, name: str) -> Term:
        """Return a term by its name: N, B or K."""
        return (self.n, self.b, self.k)[TERMS.index(name)]

    @property
    def values(self) -> Floats:
        """The likeliest N, B and K (3,)."""
        return np.array([self.n.value, self.b.value, self.k.value])


def fewest_samples(period_s: float) -> int:
    """Return how many samples a stretch must have to count."""
    return _FEWEST * mean_width(period_s)


def mean_width(period_s: float) -> int:
    """Return over how many samples means are taken before anything is fitted."""
    return max(round(_FINEST_S / period_s), 1)


def noise_terms(stretches: Sequence[Floats], period_s: float) -> list[NoiseTerms]:
    """Return N, B and K of each sensor, with intervals, of separate, evenly sampled stretches (n, m).

    High frequencies that a filter has taken out are left out, and the octave that fits least is named. Stretches
    shorter than ``fewest_samples`` do not count; ValueError if none is left.
    """
    width = mean_width(period_s)
    used = [part for part in stretches if len(part) >= fewest_samples(period_s)]
    if not used:
        raise ValueError(f"no stretch of {fewest_samples(period_s)} samples")
    hz, bands = _bands_of(used, period_s, width)
    start = _start(bands)
    bands, squares = _trimmed(bands, hz, start)
    spans_s = width * period_s, max(map(len, used)) * period_s / 3
    intervals = _intervals(bands, squares)
    found = []
    for row, own in enumerate(squares):
        counted = bands.counts[row] > 0
        highest_hz = float(hz[counted].max())
        n, b, k = (_term(number, own, intervals, row, spans_s) for number in range(3))
        unlike_hz, unlike = _unexplained(bands.select(np.array([row])), hz, own)
        trimmed = not counted.all()
        found.append(
            NoiseTerms(
                n=n,
                b=b,
                k=k,
                shortest_s=1 / (2 * highest_hz) if trimmed else width * period_s,
                trimmed=trimmed,
                unlike_hz=unlike_hz,
                unlike=unlike,
            )
        )
    return found


def _bands_of(stretches: Sequence[Floats], period_s: float, width: int) -> tuple[Floats, Bands]:
    """Return the frequencies (b,) in Hz of the bands of all stretches, and their sums of squares.

    Each stretch (n, m) has bands of its own, of the means over ``width`` samples; the mean of a stretch is in none.
    """
    from scipy.fft import dct

    hz: list[Floats] = []
    sums: list[Floats] = []
    counts: list[Floats] = []
    shapes: list[Floats] = []
    mean_s = width * period_s
    for part in stretches:
        rows = len(part) // width
        means = part[: rows * width].reshape(rows, width, -1).mean(axis=1)
        power = np.asarray(dct(means - means[0], axis=0, norm="ortho"))[1:] ** 2
        numbers = np.arange(1, rows)
        band = band_of(numbers)
        edges = np.flatnonzero(np.diff(band, prepend=-1))
        own = np.bincount(band).astype(np.float64)
        counts.append(own)
        sums.append(np.add.reduceat(power, edges, axis=0).T)
        shapes.append(np.add.reduceat(cosine_variances(numbers, rows, mean_s, width), edges, axis=0) / own[:, None])
        hz.append(np.add.reduceat(numbers / (2 * rows * mean_s), edges) / own)
    total = np.hstack(sums)
    every = np.tile(np.concatenate(counts), (len(total), 1))
    return np.concatenate(hz), Bands(total, every, np.vstack(shapes))


def _start(bands: Bands) -> Floats:
    """Return squares (p, 3) to begin the fit with: each term as if it were all that there is in the middle band."""
    ratio = bands.sums / bands.counts
    return np.column_stack([np.median(ratio / shape, axis=1) for shape in bands.shapes.T])


def _trimmed(bands: Bands, hz: Floats, start: Floats) -> tuple[Bands, Floats]:
    """Return the bands without the highest octaves of each sensor that contradict those below, and the fit (p, 3).

    ``hz`` (b,) are the frequencies of the bands, ``start`` (p, 3) the squares with which the fit begins. Go down octave
    by octave as long as that of a sensor contradicts and ``_LEAST_BANDS`` bands are left below. The output filter of a
    sensor reaches further down than it shows, so the octave below a dropped one is dropped, too.
    """
    dropped = np.zeros(bands.counts.shape, dtype=bool)
    top_hz = float(hz.max())
    rows = np.arange(len(dropped))
    while len(rows) and np.sum(hz <= top_hz / 4) >= _LEAST_BANDS:
        octave = (hz > top_hz / 2) & (hz <= top_hz)
        below = bands.select(rows).without(hz > top_hz / 2)
        squares, _ = below.fit(start[rows])
        share = bands.counts[0, octave].sum() / below.counts[0].sum()  # the uncertainty of that prediction
        differing = np.abs(_excess(bands.select(rows), squares, octave)) > _UNLIKE * np.sqrt(1 + share)
        rows = rows[differing]
        dropped[rows] |= hz > top_hz / 4
        top_hz /= 2
    kept = bands.without(dropped)
    squares, _ = kept.fit(start)
    return kept, squares


def _excess(bands: Bands, squares: Floats, chosen: Flags) -> Floats:
    """Return by how many sigmas (p,) the noise of chosen bands (b,) exceeds that predicted by squares (p, 3)."""
    counts = bands.counts[:, chosen]
    free = counts.sum(axis=1)
    ratio = np.sum(bands.sums[:, chosen] / (squares @ bands.shapes[chosen].T), axis=1)
    return np.asarray((ratio - free) / np.sqrt(2 * np.maximum(free, 1.0)))


def _unexplained(bands: Bands, hz: Floats, squares: Floats) -> tuple[float | None, float]:
    """Return the middle in Hz of the octave that deviates most from the fit, and by which factor; None and 1 if none
    does.

    ``bands`` are those of one sensor, at the frequencies ``hz`` (b,); ``squares`` (3,) are those of the fitted terms.
    Octaves of few coefficients are not judged. The factor is one of the density's root.
    """
    octave = np.floor(np.log2(hz)).astype(int)
    worst, found, factor = _UNLIKE, None, 1.0
    for number in np.unique(octave):
        chosen = (octave == number) & (bands.counts[0] > 0)
        free = float(bands.counts[0, chosen].sum())
        if free < _FEWEST:
            continue
        sigmas = float(_excess(bands, squares[None, :], chosen)[0])
        if abs(sigmas) > worst:
            worst, found = abs(sigmas), float(2 ** (number + 0.5))
            factor = float(np.sqrt(1 + sigmas * np.sqrt(2 / free)))
    return found, factor


def _intervals(bands: Bands, squares: Floats) -> Floats:
    """Return the lower and the upper ends of the intervals by term (3, 2, p)."""
    ends = [[bands.crossing(squares, term, _RISE, above=above) for above in (False, True)] for term in range(3)]
    return np.asarray(np.sqrt(np.array(ends)))


def _term(number: int, squares: Floats, intervals: Floats, row: int, spans_s: tuple[float, float]) -> Term:
    """Return a term with its interval, from 0 on if it is not the larger part of the Allan variance."""
    low, high = intervals[number, :, row].tolist()
    value = float(np.sqrt(squares[number]))
    seen = bool(low > 0 and larger_decades(number, squares, spans_s) >= (_FLAT_DECADES if number == 1 else 0.01))
    return Term(value, low if seen else 0.0, high, seen)


def larger_decades(number: int, squares: Floats, spans_s: tuple[float, float]) -> float:
    """Return over how many decades of averaging time, of a span, a term is at least half of the Allan variance."""
    tau_s = np.geomspace(*spans_s, 401)
    parts = allan_variances(tau_s) * squares
    larger = 2 * parts[:, number] >= parts.sum(axis=1)
    return float(np.mean(larger) * np.log10(spans_s[1] / spans_s[0]))
