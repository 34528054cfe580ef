"""How long to record until N, B or K is known to a wished share of itself."""

import numpy as np

from estimator.observations.allan.likelihood import Bands
from estimator.observations.allan.spectrum import cosine_variances
from estimator.observations.allan.terms import NoiseTerms
from estimator.types import Floats

LONGEST_S = 1e8
"""Three years: what takes longer is not worth a figure."""
_SHORTEST_MEANS, _STEPS = 32, 60
_SINGLY = 512  # so many coefficients are summed one by one, higher ones by bands


def record_length_s(noise: NoiseTerms, term: int, share: float) -> float:
    """Return the length in s of one rest after which a term has the relative standard uncertainty ``share``.

    ``term`` is its number, 0 to 2 for N, B and K. From the Fisher information of the series under the estimated noise
    (Cramer-Rao). A term that was not seen is assumed to have its upper limit. The least result is 32 times
    ``noise.shortest_s``; beyond ``LONGEST_S`` it is inf.
    """
    sizes = noise.values
    found = (noise.n, noise.b, noise.k)[term]
    if not found.seen:
        sizes[term] = found.high
    mean_s = noise.shortest_s
    low, high = _SHORTEST_MEANS * mean_s, LONGEST_S
    if relative_uncertainty(sizes, term, high, mean_s) > share:
        return float("inf")
    for _ in range(_STEPS):
        middle = float(np.sqrt(low * high))
        if high / low < 1.005:
            break
        if relative_uncertainty(sizes, term, middle, mean_s) > share:
            low = middle
        else:
            high = middle
    return high


def relative_uncertainty(sizes: Floats, term: int, span_s: float, mean_s: float) -> float:
    """Return the relative standard uncertainty of a term after one rest of length ``span_s``.

    The rest is treated as means over ``mean_s``. ``sizes`` (3,) are N, B and K; one that is 0 counts as known to be 0.
    ``term`` is the number of one that is not.
    """
    bands = _bands(max(int(span_s / mean_s), 2), mean_s)
    squares = sizes[None, :] ** 2
    there = np.flatnonzero(sizes > 0)
    information = bands.information(squares)[0][np.ix_(there, there)]
    scale = sizes[there] ** 2
    covariance = np.linalg.inv(information * scale[:, None] * scale[None, :])
    return float(np.sqrt(covariance.diagonal()[there == term][0]) / 2)


def _bands(count: int, mean_s: float) -> Bands:
    """Return bands of a series of ``count`` means over ``mean_s``, without data.

    The lowest frequencies have a band each, all others together share some sixty bands.
    """
    numbers = np.arange(1, min(count, _SINGLY))
    counts = np.ones(len(numbers))
    if count > _SINGLY:
        edges = np.unique(np.geomspace(_SINGLY, count, 60).astype(np.int64))
        middles = np.sqrt(edges[1:] * edges[:-1].astype(float)).astype(np.intp)
        numbers = np.concatenate([numbers, middles])
        counts = np.concatenate([counts, np.diff(edges).astype(float)])
    shapes = cosine_variances(numbers, count, mean_s, 2)
    return Bands(np.zeros((1, len(counts))), counts[None, :], shapes)
