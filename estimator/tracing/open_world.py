"""Something that has no name: any function of what was measured, as a rival of the effects that have one.

Each gyro has such a function: a sum of all general dependences and effects, each with a coefficient of its own, all of
one expected size that is not known. Where an effect alone explains a residual, the sum pays for its many coefficients;
where much is left beside it, the sum is there anyway, and could say what the effect says.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from estimator.estimation.evidence import Base, Evidence, Term, log_mean
from estimator.types import Floats

SIZES_RPS = np.geomspace(1e-6, 3e-2, 10)
"""Expected rms of each function; none is preferred."""
_PRESENT = 0.1  # expectation that something acts that has no name


@dataclass(frozen=True, slots=True, eq=False)
class OpenWorld:
    """Log evidence of a model, ``closed`` without anything more, ``by_size`` with something of each size beside it."""

    closed: float
    by_size: Floats

    @classmethod
    def beside(cls, evidence: Evidence, model: Sequence[Term], columns: Sequence[int], sizes: Floats) -> OpenWorld:
        """Return that of a model; ``columns``, times ``sizes`` (c,) of 1 rad/s rms, are the functions there may be."""
        base = Base(evidence, model)
        closed = log_mean(base.by_noise(), evidence.shapes.log_prior)
        if not columns:
            return cls(closed, np.full(len(SIZES_RPS), -np.inf))
        by_noise = base.with_functions(np.array(columns), sizes, SIZES_RPS)
        return cls(closed, np.array([log_mean(one, evidence.shapes.log_prior) for one in by_noise]))

    @property
    def total(self) -> float:
        """Log evidence of the model, whether something acts beside it or not."""
        return float(np.logaddexp(self.closed + np.log1p(-_PRESENT), log_mean(self.by_size) + np.log(_PRESENT)))

    @property
    def probability(self) -> float:
        """Probability that something acts that has no name."""
        return float(np.exp(log_mean(self.by_size) + np.log(_PRESENT) - self.total))

    @property
    def size_rps(self) -> float:
        """Its most probable size."""
        return float(SIZES_RPS[int(np.argmax(self.by_size))])
