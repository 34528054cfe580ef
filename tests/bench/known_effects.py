"""Effects that are told beforehand, estimated on recordings: what investigations and models are measured by."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from estimator.effects.disturbances import TONE
from estimator.errors import InvestigationError
from estimator.estimation.evidence import Base, Evidence
from estimator.estimation.runs.build import runs_of_all
from estimator.estimation.spectra import NoiseShapes, gyro_spectra
from estimator.recordings.recording import Recording
from estimator.tracing.augmented import Augmented, Part
from estimator.tracing.candidates import candidates_of
from estimator.tracing.run_columns import RunColumns
from estimator.tracing.scan import Scan
from estimator.tracing.search import Search


def fit_known(recordings: Sequence[Recording], effects: Sequence[str]) -> Augmented:
    """Return the model with these effects of the catalogue, estimated on all recordings, whether they are there or not.

    Of effects that come in several kinds (a harmonic's axis and order) the most telling one is taken.

    Raises InvestigationError for an effect that the catalogue does not hold or the recordings cannot show.
    """
    runs = runs_of_all(recordings)[0]
    span_s = max(float(run.t_s[-1] - run.t_s[0]) + run.length_s for run in runs)
    evidence = Evidence(gyro_spectra(runs), NoiseShapes.over(span_s, several=True))
    search = Search([RunColumns(run) for run in runs], evidence)
    candidates, left_out = candidates_of(runs)
    search.add([candidate for candidate in candidates if candidate.called in effects])
    parts: list[Part] = []
    for effect in effects:
        if effect in left_out:
            raise InvestigationError(f"{effect} cannot be estimated: {left_out[effect]}")
        parts.append(_best_of(search, effect, parts))
    return Augmented.of(search.evidence, _rescaled(search, parts))


def _best_of(search: Search, effect: str, chosen: Sequence[Part]) -> Part:
    """Return the most probable of the candidates that are called so, beside those chosen."""
    model = [part.term for part in chosen if part.tone is None]
    if effect == TONE.name:
        tone = search.heard.strongest(model)
        if tone is None:
            raise InvestigationError("no tone can be looked for in these recordings")
        search.heard.take(tone, 1.0, model)
        search.forget([])  # what was scored beside the tone
        return search.heard.parts[-1]
    names = [part.candidate.name for part in chosen]
    open_ones = [c for c, _ in search.known.values() if c.start is not None and c.name not in names]
    scan = Scan(search.columns, search.evidence, model)
    search.add([scan.tuned(candidate) for candidate in open_ones])
    scores = search.scores(model, names)
    named = [name for name in scores if search.known[name][0].called == effect]
    if not named:
        raise InvestigationError(f"the catalogue holds no effect {effect} for these recordings")
    best = max(named, key=lambda name: scores[name][0])
    return Part(search.known[best][0], scores[best][1], 1.0, (effect,))


def _rescaled(search: Search, chosen: Sequence[Part]) -> list[Part]:
    """Return the same, the prior scale of each as is most probable beside the others."""
    done = list(chosen)
    for number, part in enumerate(done):
        if part.tone is None:
            others = [own.term for m, own in enumerate(done) if m != number and own.tone is None]
            base = Base(search.evidence, others, part.term.columns)
            ((_, term),) = base.with_each([part.term])
            done[number] = replace(part, term=term)
    return done
