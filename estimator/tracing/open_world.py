"""Effects without a name: any function of measured values, as a rival of the named effects.

Each gyro has such a function: a sum of all general dependences and effects, each with a coefficient of its own, all of
one expected size that is not known. Where an effect alone explains a residual, the sum pays for its many coefficients;
where much is left beside it, the sum is there anyway, and could say what the effect says.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from estimator.estimation.evidence import Base, Evidence, Term, log_mean
from estimator.tracing.augmented import Part
from estimator.tracing.candidates import Candidate
from estimator.tracing.search import Search
from estimator.types import Floats

Columns = NDArray[np.intp]

SIZES_RPS = np.geomspace(1e-6, 3e-2, 10)
"""Expected rms of each function; none is preferred."""
_PRESENT = 0.1  # expectation that something acts that has no name
_LIKE = 0.1  # share of a function's squares that an effect puts out: from then on they are of a kind
_CHANCE = 3.0  # natural logarithm by which functions without a name may be the more probable by chance


@dataclass(frozen=True, slots=True, eq=False)
class OpenWorld:
    """Log evidence of a model: ``closed`` without any further effect, ``by_size`` with one of each size beside it."""

    closed: float
    by_size: Floats

    @classmethod
    def beside(cls, evidence: Evidence, model: Sequence[Term], columns: Columns, sizes: Floats) -> Self:
        """Return the log evidences of a model without and with a further effect of each size in ``SIZES_RPS``.

        ``columns`` (c,) are the numbers of possible functions, ``sizes`` (c,) the factors that give each 1 rad/s rms.
        Without columns the sizes have no evidence (-inf).
        """
        base = Base(evidence, model, columns.tolist())
        closed = log_mean(base.by_noise(), evidence.shapes.log_prior)
        if not len(columns):
            return cls(closed, np.full(len(SIZES_RPS), -np.inf))
        by_noise = base.with_functions(columns, sizes, SIZES_RPS)
        return cls(closed, np.array([log_mean(one, evidence.shapes.log_prior) for one in by_noise]))

    @property
    def total(self) -> float:
        """Log evidence of the model, with or without a further effect."""
        return float(np.logaddexp(self.closed + np.log1p(-_PRESENT), log_mean(self.by_size) + np.log(_PRESENT)))

    @property
    def probability(self) -> float:
        """Probability that something acts that has no name."""
        return float(np.exp(log_mean(self.by_size) + np.log(_PRESENT) - self.total))


def something_beside(search: Search, model: Sequence[Term]) -> OpenWorld:
    """Return the log evidences of effects without a name acting beside a model."""
    return OpenWorld.beside(search.evidence, model, *functions_of(search))


def unnamed(search: Search) -> list[Term]:
    """Return the sum of functions that may act without a name, as a term of each of the sizes that it may have."""
    columns, sizes = functions_of(search)
    term = Term("open", tuple(columns.tolist()), False, sizes=tuple(sizes.tolist()))
    return [term.scaled(size_rps) for size_rps in SIZES_RPS.tolist()]


def functions_of(search: Search) -> tuple[Columns, Floats]:
    """Return columns (c,) that stand for any function of measured values, and factors (c,) that give each 1 rad/s rms.

    They are those of the candidates of a search, but laws and candidates whose nonlinear parameter (other than a size)
    is searched for. Columns that do not vary are left out.
    """
    plain = [term for candidate, term in search.known.values() if not _one_of_many(candidate)]
    columns = np.array([c for term in plain for c in term.columns], dtype=np.intp)
    squares, seconds = np.zeros(len(columns)), 0.0
    for gyro in search.evidence.gyros:
        for stretch, bands in zip(gyro.stretches, gyro.bands(), strict=True):
            beside_mean = slice(bands.start + 1, bands.stop)  # the mean of a stretch is a band of its own
            squares += gyro.products[columns, columns, beside_mean].sum(axis=1) * gyro.arw**2
            seconds += len(stretch.band) * stretch.length_s
    rms = np.sqrt(squares / seconds)
    seen = rms > 1e-9 * rms.max(initial=1e-30)
    return columns[seen], 1 / rms[seen]


def weighed_against(search: Search, parts: Sequence[Part]) -> list[Part]:
    """Return the effects with the probability that the structure left beside them allows.

    An effect that only imitates another leaves functions similar to itself, an effect that truly acts does not. If the
    reference is another instrument with errors of its own, all functions count for all effects but a delay. Tones stay
    as they are.
    """
    foreign = any(run.by_another for run in search.runs)
    terms = [part.term for part in parts if part.tone is None]
    columns, sizes = functions_of(search)
    judged = []
    for part in parts:
        if part.tone is None:
            others = [term for term in terms if term is not part.term]
            least = 0.0 if foreign and not part.candidate.by_size else _LIKE
            like = _likeness(search.evidence, part.term, columns, others) > least
            left = OpenWorld.beside(search.evidence, terms, columns[like], sizes[like])
            explained = max(left.closed - search.evidence.of(others), 0.0)
            beside = max(float(left.by_size.max()) - left.closed - _CHANCE, 0.0)
            part = replace(part, probability=part.probability * explained / max(explained + beside, 1e-9))
        judged.append(part)
    return judged


def _likeness(evidence: Evidence, term: Term, columns: Columns, beside: Sequence[Term]) -> Floats:
    """Return the share (c,) of the squares of each column that the columns of a term explain, over all gyros.

    All are taken beside the terms ``beside`` and under the noise that is most probable with them.
    """
    best = int(np.argmax(evidence.noise_weight(beside)))
    mine = np.array(term.columns)
    both = np.array([*mine, *columns])
    left = Base(evidence.under(best), beside, both.tolist()).products(both[None], both[None])[:, 0, 0]
    shown, whole = np.zeros(len(columns)), np.full(len(columns), 1e-300)
    p = len(mine)
    for products in left:
        across = products[:p, p:]
        inner = products[:p, :p] + (1e-12 * np.trace(products[:p, :p]) + 1e-30) * np.eye(p)
        whole += np.diag(products)[p:]
        shown += np.sum(across * np.linalg.solve(inner, across), axis=0)
    return np.asarray(shown / whole)


def _one_of_many(candidate: Candidate) -> bool:
    """Return whether a model holds only one of many forms of a candidate: a value of its nonlinear parameter, or
    a law.
    """
    return bool(candidate.law) or (candidate.start is not None and not candidate.by_size)
