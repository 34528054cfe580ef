"""Closing the loop on recordings: residual, cause, better model, and the error before and after."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from estimator.effects.site import EARTH_RATE
from estimator.errors import InvestigationError
from estimator.estimation.evidence import Evidence, Term
from estimator.estimation.runs.build import runs_of_all
from estimator.estimation.runs.run import Run, growth_notes, same_devices
from estimator.estimation.spectra import NoiseShapes, gyro_spectra
from estimator.geometry.kinematics import EARTH_RATE_RPS
from estimator.observations.defects.faults import Fault
from estimator.packaged import sentence
from estimator.recordings.recording import Recording
from estimator.tracing.augmented import Augmented, Part
from estimator.tracing.candidates import candidates_of
from estimator.tracing.investigation import COMMON_CAUSE, Finding, Investigation, ModelStep, OutOfSample, Unexplained
from estimator.tracing.judging.alike import with_alike_laws
from estimator.tracing.judging.averaging import averaged, beside_suspect, between_notes, between_recordings
from estimator.tracing.judging.cross_validation import confirmed, judged, out_of_sample
from estimator.tracing.judging.verification import Judged
from estimator.tracing.laws.composing import Composer, laws_of
from estimator.tracing.laws.spread import with_spreads
from estimator.tracing.open_world import OpenWorld, something_beside, weighed_against
from estimator.tracing.residuals.residual import Residual, residuals
from estimator.tracing.run_columns import RunColumns
from estimator.tracing.search import CERTAIN, Found, Search
from estimator.tracing.verdict import (
    NOTHING_MEASURED,
    Causes,
    Verdict,
    beyond_noise,
    faults_added,
    file_notes,
    rival_sizes,
    surprised,
    unexplained_of,
    verdict_of,
)
from estimator.types import Floats

Progress = Callable[[float, str], None]

_SURPRISED = 8.0
"""Sigmas by which the error on a verification run exceeds chance before a verdict is taken back."""
_VISIBLE = 3.0
_TOGETHER, _UNKNOWN = 6.0, 0.5  # sigmas of all numbers of an effect together, and its probability then


def investigate(
    recordings: Sequence[Recording],
    verification: Sequence[Recording] = (),
    *,
    most_effects: int = 4,
    progress: Progress | None = None,
) -> Investigation:
    """Return which effects the model of the gyros in ``recordings`` lacks, and the errors before and after adding them.

    The errors are those on ``verification``; without it they are in-sample, cross-validated by step. ``most_effects``
    limits the number of effects added; ``progress`` is called with the share done and a word for the step.

    Raises InvestigationError if the recordings are not of the same gyros, are compared with gravity, hold too little,
    or if only one of recordings and verification is at rest; RecordingError if memory does not suffice.
    """
    tell = progress or (lambda share, what: None)
    tell(0.0, "reading")
    runs, notes, faults = runs_of_all(recordings)
    held_back, more, _ = runs_of_all(verification, len(recordings))
    notes += [*more, *growth_notes([*runs, *held_back])]
    _check_same_gyros(recordings, verification, runs, held_back)
    if held_back and _at_rest(runs) != _at_rest(held_back):
        still, turning = ("recordings", "verification run") if _at_rest(runs) else ("verification run", "recordings")
        raise InvestigationError(sentence("tracing.nothing_in_common", still=still, turning=turning))
    tell(0.1, "residual")
    search, left_out = _prepared([RunColumns(run) for run in runs])
    found = _trace(search, most_effects, lambda share: tell(0.1 + 0.6 * share, "tracing"))
    tell(0.75, "before and after")
    notes += file_notes(search, found.terms)
    return _conclude(search, found, held_back, left_out, notes, faults, most_effects, verification)


def _check_same_gyros(
    recordings: Sequence[Recording], verification: Sequence[Recording], runs: Sequence[Run], held_back: Sequence[Run]
) -> None:
    """Raise InvestigationError, with the difference, if a recording or verification run has other gyros than the first.

    ``runs`` are those of the recordings, ``held_back`` those of the verification runs.
    """
    first = [run for run in runs if run.order == 0]
    for order, other in enumerate([*recordings, *verification]):
        difference = same_devices(first, [run for run in (*runs, *held_back) if run.order == order])
        if difference:
            kind = "recording" if order < len(recordings) else "verification run"
            raise InvestigationError(
                f"{other.name} is of another device than {recordings[0].name}: {difference}; "
                f"give a {kind} of the same gyros"
            )


def _prepared(columns: Sequence[RunColumns]) -> tuple[Search, dict[str, str]]:
    """Return a search over all candidates on some runs, and by name the effects that cannot be tried, with the reason.

    Among these are effects that the motion does not excite, which are removed from the search. General dependences are
    removed without a reason.
    """
    runs = [one.run for one in columns]
    span_s = max(float(run.t_s[-1] - run.t_s[0]) + run.length_s for run in runs)
    finely = any(run.recording.several_files for run in runs)
    search = Search(columns, Evidence(gyro_spectra(runs), NoiseShapes.over(span_s, several=True, finely=finely)))
    candidates, left_out = candidates_of(runs)
    search.add(candidates)
    for candidate in search.leave_out_unexcited():
        if not candidate.depends_on:
            left_out[candidate.called] = "the motion does not excite it"
    return search, left_out


def _trace(search: Search, most: int, tell: Callable[[float], None] | None = None) -> Found:
    """Return the result of the search, with composed laws unless the reference is another instrument."""
    found = search.run(most, tell)
    if not any(run.by_another for run in search.runs):
        found = Composer(search, laws_of([columns.coarse.run for columns in search.columns])).composed(found, most)
    return replace(found, parts=tuple(weighed_against(search, found.parts)))


def _conclude(
    search: Search,
    found: Found,
    held_back: Sequence[Run],
    left_out: dict[str, str],
    notes: list[str],
    faults: Sequence[Fault],
    most: int,
    verification: Sequence[Recording],
) -> Investigation:
    """Return the investigation after the search: effects judged and confirmed, errors before and after, verdict, and
    all that is reported beside these.

    ``held_back`` are the runs of ``verification``, ``left_out`` the effects that could not be tried, ``faults`` those
    that were seen in the data. ``most`` is the largest number of effects, for a second search if the verification run
    shows an error that the recordings do not.
    """
    evidence, visible = search.evidence, _visible(search, found)
    parts = with_spreads(search, with_alike_laws(search, visible, held_back))
    found = found.with_parts(visible, parts)
    weight = evidence.noise_weight([part.term for part in parts])
    told = out_of_sample(search.runs, Augmented.of(evidence, parts, weight), evidence.shapes)
    named = [part if _of_the_comparison(search, part) else _proven(part, told.get(part.term.name)) for part in parts]
    doubtful = [part for part in named if part.probability < CERTAIN]
    likely = [part for part in named if part.probability >= CERTAIN]
    borne_out = _borne_out(search, likely, held_back, verification, weight)
    certain, taken_back, after = borne_out.parts, borne_out.taken_back, borne_out.after
    opened, errors = borne_out.opened, borne_out.errors
    before, wider = borne_out.before, Augmented.of(evidence, [*certain, *doubtful], weight)
    terms = [part.term for part in certain if part.tone is None]
    between = between_recordings(search, terms)
    fitted, verified = (
        _residuals_before_and_after(search.runs, 0, before, after),
        _residuals_before_and_after(held_back, len(search.runs), before, after),
    )
    unexplained = unexplained_of(fitted[1]) if opened.probability > CERTAIN else beyond_noise(search, found)
    if unexplained and _explained_by(search, terms, doubtful):
        unexplained = None
    shared = errors.sharing.certain
    if shared and not doubtful:
        unexplained = unexplained or unexplained_of(fitted[1])
        if unexplained is None or unexplained.depends_on == NOTHING_MEASURED:
            unexplained = Unexplained(COMMON_CAUSE, errors.sharing.share)
    faulty = faults_added(faults)
    causes = Causes.among(search, certain, after, fitted[1], unexplained)
    verdict = verdict_of([*(a.effect for a in faulty), *_called(causes.parts)], doubtful, unexplained)
    gyros = averaged(search, errors.gyros, after, [*certain, *doubtful], opened, between)
    laws = [part for part in certain if part.candidate.law]
    understated = bool(held_back) and errors.understated > _UNKNOWN
    contradicted = bool(held_back) and (errors.surprise > _SURPRISED or (bool(laws) and understated))
    if verdict.finding in (Finding.NOTHING, Finding.ADDED) and contradicted:
        suspected, with_it = _suspected(search, held_back, most)
        verdict = surprised(certain, suspected, verified[1])
        gyros = beside_suspect(gyros, with_it)
    left = verified[1] if contradicted or understated else None
    if shared and held_back:  # a wander that the gyros share is none of theirs
        (left,) = residuals(held_back, [after.without_wander()], len(search.runs), held_back=True)
    causes = causes.less_probable(_most_probable(search, certain, verdict, errors, left))
    models = [ModelStep((), 0.0, errors.before)]
    gained = found.log_evidence[-1] - found.log_evidence[0]
    models += [ModelStep(_called(certain), gained, errors.after)] if certain else []
    if doubtful:
        with_all = judged(search, before, wider, held_back, verification).after
        models.append(ModelStep(_called([*certain, *doubtful]), gained, with_all))
    return Investigation(
        finding=verdict.finding,
        reason=verdict.reason,
        added=(*faulty, *causes.added(search, found, after, told)),
        rivals=verdict.rivals,
        unexplained=verdict.unexplained,
        before=errors.before,
        after=errors.after,
        improvement=errors.improvement,
        in_sample=not held_back,
        gyros=gyros,
        models=tuple(models),
        suspects=found.suspects,
        left_out=left_out,
        notes=(*notes, *between_notes(between), *_parts_notes(certain, taken_back), *causes.notes),
        taken_back=tuple(taken_back),
        views=errors.views,
        model=after,
        residual_before=fitted[0],
        residual_after=fitted[1],
        verified_before=verified[0],
        verified_after=verified[1],
        rival_sizes=rival_sizes(search, found, certain, doubtful, weight),
    )


def _most_probable(
    search: Search, certain: Sequence[Part], verdict: Verdict, errors: Judged, left: Residual | None
) -> dict[str, float]:
    """Return by the names of their candidates how probable effects that were added are at most.

    A law without a name has nothing but its predictions to support it, so it is certain only if nothing is left open,
    and if its error is likely to be like that of a law of known form; a flexible one only as far as that is likely.
    ``left`` is the residual of a verification run if it contradicts the model, shows a larger error than its covariance
    allows, or if the gyros share what is left; else None. An effect is no more probable than its share of what it
    explains of that run's squared error and what is left there of its kind: an effect that imitates another leaves
    such. That does not hold where the reference is another instrument, whose own errors are in that run. Tones are seen
    as lines: they, and effects without a limit, have no entry.
    """
    ratio = np.inf if errors.improvement is None else errors.improvement.ratio
    explained = 1 - ratio**-2 if ratio > 1 else 0.0
    foreign = any(run.by_another for run in search.runs)
    most = {}
    for part in certain:
        if part.candidate.law:
            open_to = 1.0 if verdict.leaves_nothing_open and left is None else _UNKNOWN
            as_exact = 1 - errors.formless
            if not part.candidate.flexible:  # its form was found among others: an even chance is enough
                as_exact = 1.0 if as_exact > _UNKNOWN else _UNKNOWN
            most[part.candidate.name] = min(open_to, max(as_exact, _UNKNOWN))
        elif part.tone is None and left is not None and not foreign:
            of_its_kind = (1 - explained) * left.share_of(part.candidate.effect.record.depends_on)
            most[part.candidate.name] = explained / max(explained + of_its_kind, 1e-9)
    return most


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class _BorneOut:
    """Effects that the verification run supports, what was taken back, models without and with them, their errors."""

    parts: list[Part]
    taken_back: list[str]
    before: Augmented
    after: Augmented
    opened: OpenWorld
    errors: Judged


def _borne_out(
    search: Search,
    certain: list[Part],
    held_back: Sequence[Run],
    verification: Sequence[Recording],
    weight: Floats,
) -> _BorneOut:
    """Return the effects among ``certain`` that the verification run supports, the models without and with them, and
    errors.

    First each effect is confirmed or taken back. Then, as long as all together do not lower the error on the
    verification runs ``held_back``, the least probable is taken back, composed laws before named effects. Names taken
    back are in the result. ``weight`` (G,) are the probabilities of the noise models.
    """
    certain, taken_back = confirmed(search, certain, held_back)
    before = Augmented.of(search.evidence, [], weight)
    while True:
        after = Augmented.of(search.evidence, certain, weight)
        named = [part for part in certain if part.tone is None]
        opened = something_beside(search, [part.term for part in named])
        errors = judged(search, before, after, held_back, verification)
        grown = errors.improvement is not None and errors.improvement.ratio <= 1
        if not (held_back and named and grown):
            return _BorneOut(
                parts=certain, taken_back=taken_back, before=before, after=after, opened=opened, errors=errors
            )
        worst = min(named, key=lambda part: (not part.candidate.law, part.probability))  # laws before names
        certain = [part for part in certain if part is not worst]
        taken_back = [*taken_back, worst.called]


def _explained_by(search: Search, terms: Sequence[Term], doubtful: Sequence[Part]) -> bool:
    """Return whether the doubtful effects together leave nothing unexplained beside a model."""
    open_terms = [part.term for part in doubtful if part.tone is None]
    return bool(open_terms) and something_beside(search, [*terms, *open_terms]).probability <= CERTAIN


def _suspected(search: Search, held_back: Sequence[Run], most: int) -> tuple[Found, Augmented]:
    """Return the result of a search with the verification runs included, and its model."""
    search_of_all, _ = _prepared([*search.columns, *(RunColumns(run) for run in held_back)])
    found = _trace(search_of_all, most)
    return found, Augmented.of(search_of_all.evidence, found.parts)


def _parts_notes(certain: Sequence[Part], taken_back: Sequence[str]) -> list[str]:
    """Return sentences on effects that were taken back, and on tones whose phase holds for one run only."""
    notes = [sentence("tracing.taken_back", effects=", ".join(taken_back))] if taken_back else []
    loose = [part for part in certain if part.tone is not None and not part.tone.found.locked]
    return notes + [sentence("tracing.tone_phases", frequency_hz=part.candidate.theta) for part in loose]


def _residuals_before_and_after(
    runs: Sequence[Run], first: int, before: Augmented, after: Augmented
) -> tuple[Residual | None, Residual | None]:
    """Return the residuals of runs under the models ``before`` and ``after``; (None, None) without runs.

    ``first`` is the number of the first run among all; only fitted runs begin at 0. Both are the same object if
    ``after`` has no effects.
    """
    if not runs:
        return None, None
    found = residuals(runs, [before, after] if after.parts else [before], first, held_back=first > 0)
    return found[0], found[-1]


def _visible(search: Search, found: Found) -> list[Part]:
    """Return the effects found that differ from zero by more than three sigmas, with less probability where in doubt.

    Effects that only together, over their numbers, differ from zero are kept with a probability of at most one half and
    themselves as a rival (and Earth rate, if that could give the same); laws of several terms are judged together in
    any case. Where all runs rest, an effect is a rival of each other one that could give the same outputs, since in a
    few poses a good fit is no proof. All others are left out.
    """
    model = Augmented.of(search.evidence, found.parts)
    seen = []
    for part in found.parts:
        where = model.slice_of(part.candidate.name)
        together = _sigmas_together(model, where)
        sd = np.sqrt(np.diagonal(model.covariance, axis1=1, axis2=2))[:, where]
        if float(np.abs(model.mean[:, where] / sd).max()) <= _VISIBLE and not _of_pieces(part):
            if together > _TOGETHER:  # its numbers are there, and none of them is known by itself
                share = min(part.probability, _UNKNOWN)
                others = (EARTH_RATE.name,) if _as_small_as_the_earth(search, model, part) else ()
                seen.append(replace(part, probability=share, share=share, rivals=(part.candidate.called, *others)))
        elif together > _VISIBLE:
            copies = search.copies(part, found.terms) if _at_rest(search.runs) else []
            if copies:
                rivals = tuple(dict.fromkeys((part.candidate.called, *copies)))
                share = min(part.probability, 1 / len(rivals))
                part = replace(part, probability=share, share=share, rivals=rivals)
            seen.append(part)
    return seen


def _as_small_as_the_earth(search: Search, model: Augmented, part: Part) -> bool:
    """Return whether Earth rate could give the outputs that ``model`` has of an effect of gravity.

    Only at rest with no site stated, and if the outputs vary by no more than Earth rate does.
    """
    if not _at_rest(search.runs) or any(run.recording.site is not None for run in search.runs):
        return False
    where = model.slice_of(part.candidate.name)
    largest = 0.0
    for number, run in enumerate(search.runs):
        for i, name in enumerate(run.array.names):
            said = model.columns(run, number, i)[run.weight > 0][:, where] @ model.mean[model.names.index(name), where]
            largest = max(largest, 0.5 * float(np.ptp(said)))
    return part.candidate.effect.record.depends_on == "gravity" and largest <= EARTH_RATE_RPS


def _sigmas_together(model: Augmented, where: slice) -> float:
    """Return by how many sigmas the numbers of an effect differ from zero together, in the gyro that shows it most.

    ``where`` is the place of the effect among the model's numbers. Each number beyond the first may be a sigma off by
    chance, which is subtracted.
    """
    own, covariance = model.mean[:, where], model.covariance[:, where, where]
    squares = [float(m @ np.linalg.solve(c, m)) for m, c in zip(own, covariance, strict=True)]
    return float(np.sqrt(max(max(squares) - (own.shape[1] - 1), 0.0)))


def _of_pieces(part: Part) -> bool:
    """Return whether an effect is a law of several terms, whose numbers need not be known each by itself."""
    return bool(part.candidate.law) and part.width > 1


def _called(parts: Sequence[Part]) -> tuple[str, ...]:
    return tuple(part.called for part in parts)


def _at_rest(runs: Sequence[Run]) -> bool:
    return not any(run.turns for run in runs)


def _of_the_comparison(search: Search, part: Part) -> bool:
    """Return whether cross-validation by single steps says nothing of an effect.

    That is so of a delay against another instrument, as it is one number of all recordings, while steps show the
    reference's errors in them; and at rest of an effect in doubt that has rivals, as each step is a pose that the
    others do not predict.
    """
    if part.candidate.by_size and any(run.by_another for run in search.runs):
        return True
    return _at_rest(search.runs) and part.share < CERTAIN and len(part.rivals) > 1


def _proven(part: Part, told: OutOfSample | None) -> Part:
    """Return an effect with at most the probability that left-out data and its prior give; unchanged without such."""
    if told is None:
        return part
    odds = told.least + part.candidate.log_prior
    return replace(part, probability=min(part.probability, float(1 / (1 + np.exp(-np.clip(odds, -50, 50))))))
