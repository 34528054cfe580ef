"""Which terms of a flexible law the data need: the others are left out.

Beside a model, the coefficients of the terms have a normal posterior. By how much it makes the data more probable that
one of them is zero is the density there in the posterior over that in the prior (the Savage-Dickey ratio), so that no
model needs to be fitted anew. All gyros have the same terms, each with coefficients of its own.
"""

from dataclasses import dataclass
from math import lgamma, log
from typing import Self

import numpy as np
from numpy.typing import NDArray

from estimator.estimation.evidence import SCALES
from estimator.types import Floats


@dataclass(frozen=True, slots=True)
class Needed:
    """Numbers of the terms that are needed, and by how much they raise the log evidence.

    ``log_tries`` is the logarithm of how many choices of terms there are, as many for each number of them; it is not
    yet taken off.
    """

    terms: tuple[int, ...]
    log_evidence: float
    log_tries: float

    @property
    def worth(self) -> float:
        """By how much the terms raise the log evidence, less what it costs that they were chosen."""
        return self.log_evidence - self.log_tries


def needed(products: Floats, with_rest: Floats) -> Needed:
    """Return the terms of a law that the data need: the worst is left out again and again, and the most probable set
    counts.

    ``products`` (gyros, p, p) are those of the columns of the p terms, ``with_rest`` (gyros, p) those with what is to
    be explained, both beside a model and over the noise. The columns are scaled to the largest plausible coefficients.
    At least one term remains.
    """
    count = products.shape[-1]
    terms = np.arange(count)
    found = []
    while len(terms):
        shown = _Shown.of(products[:, terms[:, None], terms], with_rest[:, terms])
        log_tries = log_choices(count, len(terms))
        found.append((shown.log_evidence - log_tries, terms, log_tries))
        terms = np.delete(terms, shown.least)
    worth, best, log_tries = max(found, key=lambda one: one[0])
    return Needed(tuple(best.tolist()), worth + log_tries, log_tries)


def log_choices(count: int, chosen: int) -> float:
    """Return the logarithm of how many choices of ``chosen`` terms of ``count`` there are, each number as probable."""
    return log(count) + lgamma(count + 1) - lgamma(chosen + 1) - lgamma(count - chosen + 1)


@dataclass(frozen=True, slots=True)
class _Shown:
    """The log evidence of some terms at their most probable scale, and the number of that which tells ``least``."""

    log_evidence: float
    least: int

    @classmethod
    def of(cls, products: NDArray[np.float64], with_rest: Floats) -> Self:
        """Return the evidence and the least telling term for terms with these products.

        ``products`` (gyros, p, p) are those of their columns, ``with_rest`` (gyros, p) those with what is to be
        explained.
        """
        values, vectors = np.linalg.eigh(products)
        values = np.maximum(values, 0.0)
        along = np.einsum("gij,gi->gj", vectors, with_rest)
        squares = SCALES[:, None, None] ** 2
        grown = 1 + squares * values
        evidence = 0.5 * (squares * along**2 / grown - np.log(grown)).sum(axis=(1, 2))
        best = int(np.argmax(evidence))
        spread = squares[best] / grown[best]
        mean = np.einsum("gij,gj->gi", vectors, spread * along)
        variance = np.einsum("gij,gj->gi", vectors**2, spread)
        at_zero = -0.5 * (mean**2 / variance + np.log(variance / squares[best]))
        return cls(float(evidence[best]), int(np.argmax(at_zero.sum(axis=0))))
