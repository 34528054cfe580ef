"""The model with effects added: its prediction for a run, and its uncertainty."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from estimator.effects.law import in_words
from estimator.estimation.evidence import Evidence, Posterior, Term
from estimator.estimation.runs.run import Run
from estimator.estimation.runs.samples import samples_of, tone_columns
from estimator.tracing.candidates import Candidate
from estimator.tracing.tones.tones import ToneFit
from estimator.types import Floats


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """One effect of a model: its candidate, its term, and its fit if it is a ``tone``.

    ``probability`` is how certain the effect is, ``rivals`` are the effects that may act in its place; ``share`` is its
    probability among these alone, before other doubts reduce it. ``alike`` are laws that predict the same. ``spread``
    is a part that holds how far its tuned numbers may be off: its term is ``part_of`` that of the effect.
    """

    candidate: Candidate
    term: Term
    probability: float = 1.0
    rivals: tuple[str, ...] = ()
    tone: ToneFit | None = None
    share: float = 1.0
    alike: tuple[str, ...] = ()
    spread: "Part | None" = None

    @property
    def terms(self) -> list[Term]:
        """Its term, and that of its spread; none of a tone."""
        if self.tone is not None:
            return []
        return [self.term] if self.spread is None else [self.term, self.spread.term]

    @property
    def called(self) -> str:
        """Name of the effect, or the text of a composed law."""
        law = self.candidate.law
        return f"{in_words(law)} (constructed)" if law else self.candidate.called

    @property
    def width(self) -> int:
        """How many parameters a gyro has of it."""
        if self.tone is None:
            return len(self.term.columns)
        return len(next(iter(self.tone.amplitude.values())))


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class Augmented:
    """Estimated states and effects of the gyros ``names`` (n).

    By gyro ``mean`` (n, c) and ``covariance`` (n, c, c) of [k, b, s_j, s_k, own effects, shared effects, tones], the
    effects in shares of their largest plausible size; ``parts`` are in the same order. ``prior`` (n, 4) are the data
    sheet's variances. ``arw`` (n,), ``instability`` and ``walk`` are the noise, the latter two over the angle random
    walk.
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
    def of(cls, evidence: Evidence, parts: Sequence[Part], weight: Floats | None = None) -> Self:
        """Return the states and effects of each gyro in the model of ``parts``, estimated from an evidence.

        In the result effects come first, those shared by all gyros after the others, and tones last. Tones keep the fit
        that was made before, without correlations. ``weight`` (G,) are the probabilities of the G noise models; by
        default those beside the parts.
        """
        weight = evidence.noise_weight([part.term for part in parts]) if weight is None else weight
        parts = [*parts, *(part.spread for part in parts if part.spread is not None)]
        posterior = evidence.posterior([part.term for part in parts], weight)
        tones = [part for part in parts if part.tone is not None]
        own, shared = ([p for p in parts if p.tone is None and p.term.shared == shared] for shared in (False, True))
        means, covariances = [], []
        added = sum(part.width for part in tones)
        for gyro, mean, covariance in zip(evidence.gyros, posterior.means, posterior.covariances, strict=True):
            at, amplitudes = len(mean), []
            whole = np.zeros((at + added,) * 2)
            whole[:at, :at] = covariance
            for part in tones:
                assert part.tone is not None
                size = part.candidate.effect.largest[0]
                amplitudes.append(part.tone.amplitude[gyro.name] / size)
                span = np.arange(at, at + part.width)
                whole[span, span] = (part.tone.sd[gyro.name] / size) ** 2
                at += part.width
            means.append(np.concatenate([mean, *amplitudes]))
            covariances.append(whole)
        prior, arw = (np.array([getattr(gyro, key) for gyro in evidence.gyros]) for key in ("prior", "arw"))
        shapes = evidence.shapes
        return cls(
            names=tuple(gyro.name for gyro in evidence.gyros),
            mean=np.array(means),
            covariance=np.array(covariances),
            parts=(*own, *shared, *tones),
            prior=prior,
            arw=arw,
            instability=float(np.sqrt(weight @ shapes.instability**2)),
            walk=float(np.sqrt(weight @ shapes.walk**2)),
        )

    def estimated(self, posterior: Posterior) -> Self:
        """Return the model with another estimate; its tones stay."""
        mean, covariance = self.mean.copy(), self.covariance.copy()
        for g, (own, its) in enumerate(zip(posterior.means, posterior.covariances, strict=True)):
            mean[g, : len(own)], covariance[g, : len(own), : len(own)] = own, its
        return replace(self, mean=mean, covariance=covariance)

    def without_wander(self) -> Self:
        """Return the model with the white noise of its gyros alone: biases that do not wander."""
        return replace(self, instability=0.0, walk=0.0)

    @property
    def effects(self) -> tuple[Part, ...]:
        """The parts that are effects: all but spreads."""
        return tuple(part for part in self.parts if not part.term.part_of)

    def slice_of(self, name: str) -> slice:
        """Return where the parameters of the effect of this name among candidates are."""
        number = [part.candidate.name for part in self.parts].index(name)
        start = 4 + sum(part.width for part in self.parts[:number])
        return slice(start, start + self.parts[number].width)

    def columns(self, run: Run, number: int, gyro: int) -> Floats:
        """Return the columns (b, c) over b blocks of the c [states, effects] of a gyro of a run; ``gyro`` is its number
        there.

        Effects are at the largest sizes of their parameters. ``number`` is the run's place among the fitted runs; a run
        that was not fitted has a number past the last.
        """
        columns = [run.state_columns()[gyro]]
        for part in self.parts:
            if part.tone is not None:
                columns.append(self._waves(part, run, number))
            else:
                columns.append(part.candidate.columns(run, gyro))
        return np.hstack(columns)

    def predict(self, run: Run, number: int, gyro: int) -> tuple[Floats, Floats]:
        """Return the predicted output error (b,) of a gyro of a run, and the columns behind it (b, c)."""
        columns = self.columns(run, number, gyro)
        return columns @ self.mean[self.names.index(run.array.names[gyro])], columns

    def _waves(self, part: Part, run: Run, number: int) -> Floats:
        """Return the columns (b, width) of a tone on a run, scaled to its largest size.

        A locked tone has two columns, for cosine and sine. Any other has two for each fitted run, of which only those
        of run ``number`` are not zero; for a run that was not fitted all are.
        """
        assert part.tone is not None
        out = np.zeros((len(run.t_s), part.width))
        at = 0 if part.tone.found.locked else 2 * number
        if at < part.width:
            waves = tone_columns(part.tone.found.frequency_hz, run, samples_of(run))
            out[:, at : at + 2] = waves * part.candidate.effect.largest
        return out
