"""The model with effects added: what it predicts of a run, and how sure it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.tracing.candidates import Candidate
from estimator.tracing.evidence import Posterior, Term
from estimator.tracing.runs import Run
from estimator.tracing.tones import samples_of, tone_columns

Floats = NDArray[np.float64]

TONE = "tone"


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """One effect of a model, with its scaled parameters: ``own`` (n, p) of each gyro, or ``shared`` (p,)."""

    candidate: Candidate
    term: Term

    @property
    def locked(self) -> bool:
        """Whether a tone has the same phase in every run; other effects always do."""
        return not self.candidate.name.startswith(TONE) or len(self.term.columns) == 2


@dataclass(frozen=True, slots=True, eq=False)
class Augmented:
    """States and effects of the gyros ``names`` (n).

    By gyro ``mean`` (n, c) and ``covariance`` (n, c, c) of [k, b, s_j, s_k, own effects, shared effects], the effects
    in shares of their largest plausible size; ``parts`` in the order own, shared. ``prior`` (n, 4) is the data sheet's,
    ``arw`` (n,), ``instability``, ``walk``: the noise, the latter two over the angle random walk.
    """

    names: tuple[str, ...]
    mean: Floats
    covariance: Floats
    parts: tuple[Part, ...]
    prior: Floats
    arw: Floats
    instability: float
    walk: float

    @classmethod
    def of(
        cls,
        names: Sequence[str],
        posterior: Posterior,
        parts: Sequence[Part],
        prior: Floats,
        arw: Floats,
        noise: tuple[float, float],
    ) -> Augmented:
        """Return the model of an estimate, with the phases of tones that are not locked left out."""
        own = [part for part in parts if not part.term.shared]
        shared = [part for part in parts if part.term.shared]
        h = len(posterior.shared)
        means, covariances = [], []
        for mean, covariance, cross in zip(posterior.own, posterior.own_covariance, posterior.cross, strict=True):
            whole = np.zeros((len(mean) + h, len(mean) + h))
            c = len(mean)
            whole[:c, :c], whole[:c, c:], whole[c:, :c] = covariance, cross, cross.T
            whole[c:, c:] = posterior.shared_covariance
            means.append(np.concatenate([mean, posterior.shared]))
            covariances.append(whole)
        return cls(
            tuple(names), np.array(means), np.array(covariances), (*own, *shared), prior, arw, noise[0], noise[1]
        )

    def slice_of(self, number: int) -> slice:
        """Return where the parameters of part ``number`` are."""
        start = 4 + sum(len(part.term.columns) for part in self.parts[:number])
        return slice(start, start + len(self.parts[number].term.columns))

    def columns(self, run: Run, number: int, gyro: int) -> Floats:
        """Return the columns (b, c) of [states, effects] of a gyro of a run that has this number among the runs fitted.

        A run that was not fitted has the number of none of them, past the last: steps have happened before it.
        """
        columns = [run.state_columns()[gyro]]
        for part in self.parts:
            if part.candidate.name.startswith(TONE):
                columns.append(self._waves(part, run, number))
            else:
                columns.append(part.candidate.columns(run, gyro))
        return np.hstack(columns)

    def predict(self, run: Run, number: int, gyro: int) -> tuple[Floats, Floats]:
        """Return the output error (b,) that the model says of a gyro of a run, and the columns behind it (b, c)."""
        columns = self.columns(run, number, gyro)
        return columns @ self.mean[self.names.index(run.array.names[gyro])], columns

    def _waves(self, part: Part, run: Run, number: int) -> Floats:
        width = len(part.term.columns)
        out = np.zeros((len(run.t_s), width))
        at = 0 if part.locked else 2 * number
        if at < width:
            assert part.candidate.theta is not None
            waves = tone_columns(part.candidate.theta, run, samples_of(run))
            out[:, at : at + 2] = waves * part.candidate.largest
        return out
