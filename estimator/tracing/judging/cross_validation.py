"""What runs and steps that are left out say of models fitted to the others."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from estimator.estimation.evidence import Evidence, Term
from estimator.estimation.runs.run import Run
from estimator.estimation.spectra import GyroSpectra, NoiseShapes, Stretch, Z, gyro_spectra
from estimator.tracing.augmented import Augmented
from estimator.tracing.investigation import OutOfSample
from estimator.tracing.judging.verification import phases_of

Mask = list[NDArray[np.bool_]]
"""Which blocks of each run are left out."""
Fold = Callable[[int, Stretch], bool]
"""Whether a gyro's stretch, of this number, is left out."""

FOLDS = 5


def by_step(runs: Sequence[Run]) -> list[Mask]:
    """Return the steps of all runs in fifths, every fifth one together."""
    masks: list[Mask] = [[np.zeros(len(run.t_s), dtype=np.bool_) for run in runs] for _ in range(FOLDS)]
    count = 0
    for number, run in enumerate(runs):
        for phase in phases_of(run):
            masks[count % FOLDS][number][phase.blocks] = True
            count += 1
    return masks


def held(runs: Sequence[Run], mask: Mask) -> list[Run]:
    """Return the runs with nothing but what is left out."""
    return [replace(run, weight=run.weight * out) for run, out in zip(runs, mask, strict=True)]


def together(runs: Sequence[Run], model: Augmented, shapes: NoiseShapes) -> tuple[Evidence, list[Term]]:
    """Return the evidence of runs with the effects of a model, tones taken off, what it does not fit being noise."""
    spectra, terms = _spectra(runs, model)
    evidence = Evidence(spectra, shapes)
    evidence.allow_for_misfit(terms)
    return evidence, terms


def out_of_sample(runs: Sequence[Run], model: Augmented, shapes: NoiseShapes) -> dict[str, OutOfSample]:
    """Return for each effect of a model, tones apart, what is left out says of it beside the other effects.

    What is left out is predicted from the rest, with all that the rest leaves open, with an effect and without it.
    Recordings are left out one at a time, and stretches of some steps; between stretches a bias may wander.
    """
    evidence, terms = together(runs, model, shapes)
    if not terms:
        return {}
    orders = list(dict.fromkeys(run.order for run in runs))
    by_run = None
    if len(orders) > 1:
        by_run = _predicted(evidence, terms, [_of_recordings(runs, [order]) for order in orders])
    evidence, terms = together([_cut(run) for run in runs], model, shapes)
    count = max(len(gyro.stretches) for gyro in evidence.gyros)
    if count < 2:
        return {}
    steps = _predicted(evidence, terms, [_of_number(number) for number in range(count)])
    return {term.name: OutOfSample(None if by_run is None else by_run[term.name], steps[term.name]) for term in terms}


def told_by(
    evidence: Evidence, terms: Sequence[Term], runs: Sequence[Run], orders: Collection[int]
) -> dict[str, float]:
    """Return by effect how much more probable it makes some recordings beside the others, predicted from the rest."""
    return _predicted(evidence, terms, [_of_recordings(runs, orders)])


def by_run(evidence: Evidence, runs: Sequence[Run]) -> list[Evidence]:
    """Return the evidence of each recording alone."""
    orders = {run.order for run in runs}
    return [evidence.without(_of_recordings(runs, orders - {own})) for own in sorted(orders)]


def _of_recordings(runs: Sequence[Run], orders: Collection[int]) -> Fold:
    return lambda _, stretch: runs[stretch.run].order in orders


def _of_number(out: int) -> Fold:
    return lambda number, _: number == out


def _predicted(evidence: Evidence, terms: Sequence[Term], folds: Sequence[Fold]) -> dict[str, float]:
    """Return by effect how much more probable it makes each fold of stretches beside the others, summed."""
    whole = _gained(evidence, terms)
    total = dict.fromkeys(whole, 0.0)
    for fold in folds:
        rest = _gained(evidence.without(fold), terms)
        for name, gained in whole.items():
            total[name] += gained - rest[name]
    return total


def _gained(evidence: Evidence, terms: Sequence[Term]) -> dict[str, float]:
    both = evidence.of(terms)
    return {term.name: both - evidence.of([t for t in terms if t is not term]) for term in terms}


def _cut(run: Run) -> Run:
    """Return the run cut into stretches of some steps each."""
    stretch = np.array(run.stretch)
    least = max(len(stretch) // FOLDS, 1)
    number, begun = 0, 0
    for phase in phases_of(run):
        start = phase.blocks.start
        if start - begun >= least and len(stretch) - start >= least // 2:
            number, begun = number + 1, start
        stretch[start:] = run.stretch[start:] + number * (int(run.stretch.max()) + 1)
    return replace(run, stretch=stretch)


def _spectra(runs: Sequence[Run], model: Augmented) -> tuple[list[GyroSpectra], list[Term]]:
    """Return the spectra of runs with the columns of a model's effects, tones taken off, and the terms of these."""
    spectra = gyro_spectra(runs, dict(zip(model.names, model.arw.tolist(), strict=True)))
    terms: list[Term] = []
    start = Z + 1
    for part in model.parts:
        if part.tone is None:
            terms.append(replace(part.term, columns=tuple(range(start, start + part.width))))
            start += part.width
    for gyro in spectra:
        g = model.names.index(gyro.name)
        parts = gyro.parts(runs, lambda number, own: model.columns(runs[number], number, own))
        gyro.subtract([part[:, start - 1 :] @ model.mean[g, start - 1 :, None] for part in parts])
        if terms:
            gyro.add([part[:, Z : start - 1] for part in parts])
    return spectra, terms
