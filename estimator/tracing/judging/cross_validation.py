"""Models judged by runs and steps that were left out of their fit."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from estimator.estimation.evidence import Evidence, Term
from estimator.estimation.runs.build import runs_of_all
from estimator.estimation.runs.run import BLOCK_S, Run
from estimator.estimation.spectra import GyroSpectra, NoiseShapes, Stretch, Z, gyro_spectra
from estimator.recordings.recording import Recording
from estimator.tracing.augmented import Augmented, Part
from estimator.tracing.investigation import OutOfSample
from estimator.tracing.judging.expected import expected_squares
from estimator.tracing.judging.shared_errors import sharing
from estimator.tracing.judging.structure import with_structure
from estimator.tracing.judging.verification import (
    Judged,
    Misfit,
    drawn,
    judge,
    phases_of,
    sum_of,
)
from estimator.tracing.search import Search

Mask = list[NDArray[np.bool_]]
"""Which blocks of each run are left out."""
Fold = Callable[[int, Stretch], bool]
"""Whether a gyro's stretch, of this number, is left out."""

FOLDS = 5
_CONFIRMED = 2.0
"""Natural logarithm by which an effect must make the verification run more probable: less is chance."""
_TWICE, _LIKE = 2.0, 1.5  # errors over those that are expected: too large, and still like them
_TONE_BLOCKS = 8.0  # blocks in a period of a tone, where its error is judged


def by_step(runs: Sequence[Run]) -> list[Mask]:
    """Return ``FOLDS`` masks, each a list of one array (b,) for each run: true for the blocks in the fold.

    Steps (phases of a run) are counted over all runs, and dealt to the folds in turn. Blocks outside steps are in none.
    """
    masks: list[Mask] = [[np.zeros(len(run.t_s), dtype=np.bool_) for run in runs] for _ in range(FOLDS)]
    count = 0
    for number, run in enumerate(runs):
        for phase in phases_of(run):
            masks[count % FOLDS][number][phase.blocks] = True
            count += 1
    return masks


def held(runs: Sequence[Run], mask: Mask) -> list[Run]:
    """Return the runs with weight only on the blocks of ``mask``."""
    return [replace(run, weight=run.weight * out) for run, out in zip(runs, mask, strict=True)]


def together(runs: Sequence[Run], model: Augmented, shapes: NoiseShapes) -> tuple[Evidence, list[Term]]:
    """Return the evidence of runs with the effects of a model, tones subtracted and the misfit counted as noise."""
    spectra, terms = _spectra(runs, model)
    evidence = Evidence(spectra, shapes)
    evidence.allow_for_misfit(terms)
    return evidence, terms


def out_of_sample(runs: Sequence[Run], model: Augmented, shapes: NoiseShapes) -> dict[str, OutOfSample]:
    """Return by candidate name of each effect of a model what data left out of the fit say of it, beside the other
    effects; tones are left out.

    Whole recordings are left out one at a time if there are several (else that result is None), then stretches of some
    steps; between stretches a bias may wander. The data left out are predicted from the rest, with and without the
    effect. Empty if there are no effects or fewer than two stretches.
    """
    evidence, terms = together(runs, model, shapes)
    if not terms:
        return {}
    orders = list(dict.fromkeys(run.order for run in runs))
    by_run = None
    if len(orders) > 1:
        by_run = _log_gains_in_folds(evidence, terms, [_of_recordings(runs, [order]) for order in orders])
    evidence, terms = together([_divided_at_steps(run) for run in runs], model, shapes)
    count = max(len(gyro.stretches) for gyro in evidence.gyros)
    if count < 2:
        return {}
    steps = _log_gains_in_folds(evidence, terms, [_of_number(number) for number in range(count)])
    return {name: OutOfSample(None if by_run is None else by_run[name], steps[name]) for name in steps}


def confirmed(search: Search, certain: list[Part], held_back: Sequence[Run]) -> tuple[list[Part], list[str]]:
    """Return the effects that the verification run confirms, and the names of those that it does not, in the order of
    removal.

    An effect must make the runs ``held_back`` more probable and lower their squared residual. The least confirmed
    effect is removed first, and the others are judged again. Without such runs all are confirmed at once if they lower
    the errors of left-out steps; until then the least probable is removed. Tones are always kept.
    """
    taken_back: list[str] = []
    runs, orders = [*search.runs, *held_back], {run.order for run in held_back}
    while named := [part for part in certain if part.tone is None]:
        if held_back:
            evidence, terms = together(runs, Augmented.of(search.evidence, certain), search.evidence.shapes)
            told = _log_gains_in_folds(evidence, terms, [_of_recordings(runs, orders)])
            worst = min(named, key=lambda part: told[part.term.name])
            if told[worst.term.name] >= _CONFIRMED:
                grown = [part for part in named if not _lowers_residual(search, certain, part, held_back)]
                if not grown:
                    break
                worst = min(grown, key=lambda part: told[part.term.name])
        elif _lowered_in_sample(search, certain):
            break
        else:
            worst = min(named, key=lambda part: part.probability)
        certain = [part for part in certain if part is not worst]
        taken_back.append(worst.called)
    return certain, taken_back


def _lowers_residual(search: Search, certain: Sequence[Part], part: Part, held_back: Sequence[Run]) -> bool:
    """Return whether an effect lowers the squared residual of the verification runs, over all gyros, beside the
    others.
    """
    weight = search.evidence.noise_weight([one.term for one in certain])
    others = [one for one in certain if one is not part]
    without, together_with = (Augmented.of(search.evidence, own, weight) for own in (others, certain))
    squares = 0.0
    for number, run in enumerate(held_back, len(search.runs)):
        for gyro in range(len(run.array)):
            before, after = (
                (run.z_rps[:, gyro] - model.predict(run, number, gyro)[0])[run.weight > 0]
                for model in (without, together_with)
            )
            squares += float(before @ before - after @ after)
    return squares > 0


def _lowered_in_sample(search: Search, certain: Sequence[Part]) -> bool:
    """Return whether effects clearly lower the error on steps left out of the fit."""
    weight = search.evidence.noise_weight([part.term for part in certain])
    before, after = (Augmented.of(search.evidence, own, weight) for own in ((), certain))
    improvement = judged(search, before, after, (), ()).improvement
    return improvement is None or improvement.low >= 1


def judged(
    search: Search,
    before: Augmented,
    after: Augmented,
    held_back: Sequence[Run],
    verification: Sequence[Recording],
) -> Judged:
    """Return the errors of two models on the verification runs; without these, cross-validated by step.

    ``held_back`` are the runs of ``verification``; with tones in the last model they are formed again with blocks short
    enough for them. On verification runs a model with effects also has ``understated``, and one with laws ``formless``:
    the shares of draws in which the error is larger than expected.
    """
    all_runs = [*search.runs, *held_back]
    evidence, terms = together(all_runs, after, search.evidence.shapes)
    true, misfit = after.estimated(evidence.posterior(terms)), evidence.misfit
    shared = sharing(all_runs, after)
    if not held_back:
        return replace(_cross_validated(search, before, after, true, misfit), sharing=shared)
    tones = [part.tone.found.frequency_hz for part in after.parts if part.tone is not None]
    fine_s = min([BLOCK_S, *(1 / (_TONE_BLOCKS * hz) for hz in tones)])
    runs, first = list(held_back), len(search.runs)
    if fine_s < BLOCK_S:
        runs = runs_of_all(verification, held_back[0].order, fine_s)[0]
        scale = len(runs[0].t_s) / len(held_back[0].t_s)
        misfit = {key: scale * squares for key, squares in misfit.items()}
    errors = with_structure(runs, first, (before, after), drawn(runs, first, before, after, true, misfit), shared)
    found = replace(judge(runs, first, before, after, True, errors), sharing=shared)
    squares = sum_of(errors.values()).after
    candidates = [part.candidate for part in after.parts]
    if after.parts:
        expected = expected_squares(runs, first, after)
        found = replace(found, understated=float(np.mean(squares > _TWICE**2 * expected)))
    if any(candidate.law for candidate in candidates):
        expected = expected_squares(runs, first, after, forms_known=True)
        found = replace(found, formless=float(np.mean(squares > _LIKE**2 * expected)))
    return found


def _cross_validated(search: Search, before: Augmented, after: Augmented, true: Augmented, misfit: Misfit) -> Judged:
    """Return the errors of two models, each fifth of the steps predicted by models fitted to the others.

    Noise and tones stay as estimated on all steps. ``true`` is the posterior from which errors are drawn, ``misfit``
    what the model leaves beyond noise. Only the drawn errors and their coverage are cross-validated: phases, largest
    errors, views and states are those of the fit to all steps. Without effects all errors are.
    """
    all_runs, shapes = search.runs, search.evidence.shapes
    if not after.parts:
        return judge(all_runs, 0, before, after, False, drawn(all_runs, 0, before, after, true, misfit))
    # The models are those of all the data; errors by step are those of a fit without that step.
    weight = search.evidence.noise_weight([part.term for part in after.parts])
    parts = []
    share = {key: squares / FOLDS for key, squares in misfit.items()}
    for mask in by_step(all_runs):
        runs = held(all_runs, mask)
        # Tones stay as estimated on all steps: a fifth of them gives no other line.
        evidence, terms = together(held(all_runs, [~out for out in mask]), after, shapes)
        old = before.estimated(evidence.posterior([], weight))
        new = after.estimated(evidence.posterior(terms, weight))
        errors = drawn(runs, 0, old, new, true, share)
        parts.append((judge(runs, 0, old, new, False, errors), errors))
    whole = {name: sum_of(errors[name] for _, errors in parts) for name in after.names}
    found = judge(all_runs, 0, before, after, False, whole)
    cover = [
        float(np.mean([own.coverage95 for own in which if np.isfinite(own.coverage95)]))
        for which in ([j.before for j, _ in parts], [j.after for j, _ in parts])
    ]
    return replace(
        found,
        before=replace(found.before, coverage95=cover[0]),
        after=replace(found.after, coverage95=cover[1]),
    )


def by_run(evidence: Evidence, runs: Sequence[Run]) -> list[Evidence]:
    """Return the evidence of each recording alone."""
    orders = {run.order for run in runs}
    return [evidence.without(_of_recordings(runs, orders - {own})) for own in sorted(orders)]


def _of_recordings(runs: Sequence[Run], orders: Collection[int]) -> Fold:
    return lambda _, stretch: runs[stretch.run].order in orders


def _of_number(out: int) -> Fold:
    return lambda number, _: number == out


def _log_gains_in_folds(evidence: Evidence, terms: Sequence[Term], folds: Sequence[Fold]) -> dict[str, float]:
    """Return by effect the log of how much more probable it makes the data in the folds, beside the other effects.

    Each fold is predicted from all data outside it; the logs are summed over the folds.
    """
    whole = _gained(evidence, terms)
    total = dict.fromkeys(whole, 0.0)
    for fold in folds:
        rest = _gained(evidence.without(fold), terms)
        for name, gained in whole.items():
            total[name] += gained - rest[name]
    return total


def _gained(evidence: Evidence, terms: Sequence[Term]) -> dict[str, float]:
    """Return by effect how much it adds to the log evidence, with the spread of its tuned numbers."""
    both = evidence.of(terms)
    return {
        one.name: both - evidence.of([other for other in terms if one.name not in (other.name, other.part_of)])
        for one in terms
        if not one.part_of
    }


def _divided_at_steps(run: Run) -> Run:
    """Return the run divided into further stretches of at least a fifth of its blocks, which begin where a step begins.

    What is left at the end is not cut off if it is less than half of that.
    """
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
    """Return the spectra of runs with the columns of a model's effects, and the terms that name these columns.

    Tones, as the model has them, are subtracted from the data and have no term.
    """
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
