"""The model with effects added: what it predicts of a run, and how sure it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from estimator.estimation.evidence import Posterior, Term
from estimator.estimation.runs.run import Run
from estimator.estimation.runs.tone_columns import samples_of, tone_columns
from estimator.tracing.candidates import Candidate
from estimator.tracing.tones.tones import ToneFit
from estimator.types import Floats


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """One effect of a model; ``tone`` is its fit if it is a tone."""

    candidate: Candidate
    term: Term
    tone: ToneFit | None = None

    @property
    def width(self) -> int:
        """How many parameters a gyro has of it."""
        if self.tone is None:
            return len(self.term.columns)
        return len(next(iter(self.tone.amplitude.values())))


@dataclass(frozen=True, slots=True, eq=False)
class Augmented:
    """States and effects of the gyros ``names`` (n).

    By gyro ``mean`` (n, c) and ``covariance`` (n, c, c) of [k, b, s_j, s_k, own effects, shared effects], the effects
    in shares of their largest plausible size; ``parts`` in the order own, shared, tones. ``prior`` (n, 4) is the data
    sheet's, ``arw`` (n,), ``instability``, ``walk``: the noise, the latter two over the angle random walk.
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
        """Return the model of an estimate, and of tones that were fitted before it."""
        own = [part for part in parts if not part.term.shared and part.tone is None]
        tones = [part for part in parts if part.tone is not None]
        shared = [part for part in parts if part.term.shared]
        means, covariances = [], []
        added = sum(part.width for part in tones)
        for name, mean, covariance in zip(names, posterior.means, posterior.covariances, strict=True):
            at, amplitudes = len(mean), []
            whole = np.zeros((at + added,) * 2)
            whole[:at, :at] = covariance
            for part in tones:
                assert part.tone is not None
                size = part.candidate.largest[0]
                amplitudes.append(part.tone.amplitude[name] / size)
                span = np.arange(at, at + part.width)
                whole[span, span] = (part.tone.sd[name] / size) ** 2
                at += part.width
            means.append(np.concatenate([mean, *amplitudes]))
            covariances.append(whole)
        return cls(
            tuple(names),
            np.array(means),
            np.array(covariances),
            (*own, *shared, *tones),
            prior,
            arw,
            noise[0],
            noise[1],
        )

    def slice_of(self, number: int) -> slice:
        """Return where the parameters of part ``number`` are."""
        start = 4 + sum(part.width for part in self.parts[:number])
        return slice(start, start + self.parts[number].width)

    def columns(self, run: Run, number: int, gyro: int) -> Floats:
        """Return the columns (b, c) of [states, effects] of a gyro of a run that has this number among the runs fitted.

        A run that was not fitted has the number of none of them, past the last: steps have happened before it.
        """
        columns = [run.state_columns()[gyro]]
        for part in self.parts:
            if part.tone is not None:
                columns.append(self._waves(part, run, number))
            else:
                columns.append(part.candidate.columns(run, gyro))
        return np.hstack(columns)

    def predict(self, run: Run, number: int, gyro: int) -> tuple[Floats, Floats]:
        """Return the output error (b,) that the model says of a gyro of a run, and the columns behind it (b, c)."""
        columns = self.columns(run, number, gyro)
        return columns @ self.mean[self.names.index(run.array.names[gyro])], columns

    def _waves(self, part: Part, run: Run, number: int) -> Floats:
        assert part.tone is not None
        out = np.zeros((len(run.t_s), part.width))
        at = 0 if part.tone.found.locked else 2 * number
        if at < part.width:
            waves = tone_columns(part.tone.found.frequency_hz, run, samples_of(run))
            out[:, at : at + 2] = waves * part.candidate.largest
        return out
