"""The tones of some runs: taken off samples and blocks one by one, the strongest first."""

from collections.abc import Sequence

import numpy as np

from estimator.effects.disturbances import TONE
from estimator.estimation.evidence import Evidence, Term
from estimator.estimation.runs.run import Run
from estimator.estimation.runs.samples import samples_of, tone_columns
from estimator.tracing.augmented import Part
from estimator.tracing.candidates import Candidate
from estimator.tracing.tones.tones import ToneFound, find_tone, fit_tone, without_tone
from estimator.types import Floats

_MOST_TONES = 3


class Heard:
    """The tones found so far, as ``parts`` of a model, and the samples without them."""

    def __init__(self, runs: Sequence[Run], evidence: Evidence) -> None:
        """Begin without tones; ``evidence`` is of the same runs."""
        self._runs, self._evidence = runs, evidence
        # Beside another moving instrument no tone is searched (``find_tone``): its samples are not computed.
        self._samples = [] if any(run.by_another for run in runs) else [samples_of(run) for run in runs]
        self.parts: list[Part] = []

    def strongest(self, model: Sequence[Term]) -> ToneFound | None:
        """Return the strongest line beside a model, None without one or once there are ``_MOST_TONES``."""
        full = len(self.parts) >= _MOST_TONES or not self._samples
        return None if full else find_tone(self._runs, self._samples, self._predicted(model))

    def take(self, tone: ToneFound, probability: float, model: Sequence[Term]) -> None:
        """Fit a tone beside a model, subtract it from the samples and the blocks, and append it to ``parts``.

        ``probability`` is noted with it. The evidence is computed anew.
        """
        fit = fit_tone(tone, self._runs, self._samples, self._predicted(model))
        waves = [tone_columns(tone.frequency_hz, run, own) for run, own in zip(self._runs, self._samples, strict=True)]

        def heard(number: int, own: int) -> Floats:
            return waves[number] @ fit.at(self._runs[number].array.names[own], number)[:, None]

        for gyro in self._evidence.gyros:
            gyro.subtract(gyro.parts(self._runs, heard))
        self._samples = without_tone(fit, self._samples)
        self._evidence.refresh()
        effect = TONE.effect(frequency_hz=tone.frequency_hz)
        candidate = Candidate(f"{TONE.name} {tone.frequency_hz:.4f} Hz", effect, theta=tone.frequency_hz)
        self.parts.append(Part(candidate, Term(candidate.name, (), False), probability, (TONE.name,), fit))

    def _predicted(self, model: Sequence[Term]) -> list[Floats]:
        """Return the output errors (b, m) of each run that the posterior of a model predicts.

        They are 0 in blocks outside the stretches that have a spectrum.
        """
        from scipy.fft import idct

        posterior = self._evidence.posterior(model)
        predicted = [np.zeros(run.z_rps.shape) for run in self._runs]
        for gyro, mean in zip(self._evidence.gyros, posterior.means, strict=True):
            for stretch, part in zip(gyro.stretches, gyro.columns, strict=True):
                said = idct(part[:, posterior.columns] @ mean, norm="ortho") * gyro.arw / np.sqrt(stretch.length_s)
                own = self._runs[stretch.run].array.names.index(gyro.name)
                predicted[stretch.run][stretch.blocks, own] = said
        return predicted
