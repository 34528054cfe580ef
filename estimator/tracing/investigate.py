"""Closing the loop on recordings: residual, cause, better model, and the error before and after."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from estimator.effects.constructed import CONSTRUCTED
from estimator.effects.disturbances import SAMPLE_HOLD
from estimator.effects.law import in_words
from estimator.errors import InvestigationError
from estimator.estimation.evidence import Evidence, Posterior, Term
from estimator.estimation.repeatability import between_runs
from estimator.estimation.runs.making import runs_of
from estimator.estimation.runs.run import BLOCK_S, Run, growth_notes, same_devices
from estimator.estimation.spectra import GyroSpectra, NoiseShapes, gyro_spectra
from estimator.geometry.model import STATES, decode
from estimator.observations.defects.faults import Fault
from estimator.observations.turned import by_turns
from estimator.recordings.recording import Recording
from estimator.tracing.augmented import Augmented, Part
from estimator.tracing.candidates import candidates_of
from estimator.tracing.composing import laws_of
from estimator.tracing.investigation import (
    Added,
    Finding,
    GyroErrors,
    Investigation,
    ModelStep,
    OutOfSample,
    Suspect,
    Unexplained,
    Value,
)
from estimator.tracing.judging.cross_validation import FOLDS, by_run, by_step, held, out_of_sample, together, told_by
from estimator.tracing.judging.verification import Judged, Truth, drawn, judge, sum_of
from estimator.tracing.open_world import SIZES_RPS, OpenWorld
from estimator.tracing.residuals.residual import Residual, residuals
from estimator.tracing.search import CERTAIN, Choice, Found, Search
from estimator.types import Floats

Progress = Callable[[float, str], None]

_SURPRISED = 8.0
"""Sigmas by which the error on a verification run exceeds chance before a verdict is taken back."""
_CONFIRMED = 2.0
"""Natural logarithm by which an effect must make the verification run more probable: less is chance."""
_VISIBLE = 3.0
_SHOWN = 2.0  # a gyro shows an effect if a parameter of it is so many sigmas from zero
_TONE_BLOCKS = 8.0  # blocks in a period of a tone, where its error is judged
_UNLIKE_NOISE = 0.1  # share of the residual's power beyond the noise: less is 5 % of a sigma
_MATTERS = 1e-2  # share of the probability below which what may act is not averaged over
NOTHING_MEASURED = "nothing that was measured"


@dataclass(frozen=True, slots=True, eq=False)
class Traced:
    """What was found on some runs, and all that it was found with."""

    runs: list[Run]
    spectra: list[GyroSpectra]
    search: Search
    found: Found

    @property
    def names(self) -> list[str]:
        """Names of the gyros."""
        return [gyro.name for gyro in self.spectra]


def investigate(
    recordings: Sequence[Recording],
    verification: Sequence[Recording] = (),
    *,
    most_effects: int = 4,
    progress: Progress | None = None,
) -> Investigation:
    """Return what the model of the gyros in ``recordings`` lacks, and the error before and after on ``verification``.

    Without verification recordings the errors are in-sample, cross-validated by step.

    Raises InvestigationError if the recordings are not of the same gyros, or hold too little.
    """
    tell = progress or (lambda share, what: None)
    tell(0.0, "reading")
    runs, notes, faults = _all_runs(recordings)
    held_back, more, _ = _all_runs(verification, len(recordings))
    notes += [*more, *growth_notes([*runs, *held_back])]
    _same(recordings, verification, runs, held_back)
    if held_back and _at_rest(runs) != _at_rest(held_back):
        still, turning = ("recordings", "verification run") if _at_rest(runs) else ("verification run", "recordings")
        raise InvestigationError(
            f"the {still} only rest and the {turning} turn: they have no conditions in common to judge by; "
            "verify on a run of the same kind"
        )
    tell(0.1, "residual")
    traced, left_out = _trace(runs, most_effects, lambda share: tell(0.1 + 0.6 * share, "tracing"))
    tell(0.75, "before and after")
    return _conclude(traced, held_back, left_out, notes, faults, most_effects, verification)


def fit_known(recordings: Sequence[Recording], effects: Sequence[str]) -> Augmented:
    """Return the model with these effects of the catalogue, estimated on all recordings, whether they are there or not.

    Of effects that come in several kinds (a harmonic's axis and order) the most telling one is taken.

    Raises InvestigationError for an effect that the catalogue does not hold or the recordings cannot show.
    """
    runs = _all_runs(recordings)[0]
    traced, left_out = _prepared(runs, effects)
    choices: list[Choice] = []
    for effect in effects:
        if effect in left_out:
            raise InvestigationError(f"{effect} cannot be estimated: {left_out[effect]}")
        choices.append(traced.search.best_of(effect, choices))
    choices = traced.search.rescaled(choices)
    return _model(traced, choices, traced.search.evidence.noise_weight([c.term for c in choices]))


def _all_runs(
    recordings: Sequence[Recording], first: int = 0, block_s: float = BLOCK_S
) -> tuple[list[Run], list[str], list[Fault]]:
    runs: list[Run] = []
    notes: list[str] = []
    faults: list[Fault] = []
    for order, recording in enumerate(recordings, first):
        own, said, found = runs_of(recording, block_s, order)
        runs += own
        notes += said
        faults += found
    return runs, notes, faults


def _same(
    recordings: Sequence[Recording], verification: Sequence[Recording], runs: Sequence[Run], held_back: Sequence[Run]
) -> None:
    first = [run for run in runs if run.order == 0]
    for order, other in enumerate([*recordings, *verification]):
        difference = same_devices(first, [run for run in (*runs, *held_back) if run.order == order])
        if difference:
            kind = "recording" if order < len(recordings) else "verification run"
            raise InvestigationError(
                f"{other.name} is of another device than {recordings[0].name}: {difference}; "
                f"give a {kind} of the same gyros"
            )


def _trace(
    runs: Sequence[Run], most: int, tell: Callable[[float], None] | None = None
) -> tuple[Traced, dict[str, str]]:
    traced, left_out = _prepared(runs)
    found = traced.search.run(most, tell)
    if _lawful(runs):
        found = traced.search.composed(found, laws_of(runs), most)
    return replace(traced, found=found), left_out


def _lawful(runs: Sequence[Run]) -> bool:
    """Return whether laws may be composed: what turns beside another instrument shows the laws of that one, too."""
    return not any(by_turns(run.recording.reference) and run.turns for run in runs)


def _prepared(runs: Sequence[Run], only: Sequence[str] | None = None) -> tuple[Traced, dict[str, str]]:
    spectra = gyro_spectra(runs)
    span_s = max(float(run.t_s[-1] - run.t_s[0]) + run.length_s for run in runs)
    search = Search(runs, spectra, Evidence(spectra, NoiseShapes.over(span_s, several=True)))
    candidates, left_out = candidates_of(runs)
    search.add([c for c in candidates if only is None or c.called in only])
    for candidate in search.leave_out_unexcited() if candidates and only is None else []:
        if not candidate.depends_on:
            left_out[candidate.called] = "the motion does not excite it"
    return Traced(list(runs), spectra, search, Found((), (), ())), left_out


def _conclude(
    traced: Traced,
    held_back: Sequence[Run],
    left_out: dict[str, str],
    notes: list[str],
    faults: Sequence[Fault],
    most: int,
    verification: Sequence[Recording],
) -> Investigation:
    choices = _visible(traced)
    if _at_rest(traced.runs):
        choices = tuple(_with_copies(traced, choice) for choice in choices)
    weight = traced.search.evidence.noise_weight([c.term for c in choices])
    told = out_of_sample(traced.runs, _model(traced, choices, weight), traced.search.evidence.shapes)
    named = [_proven(choice, told.get(choice.term.name)) for choice in choices]
    certain, taken_back = _confirmed(traced, [c for c in named if c.probability >= CERTAIN], held_back)
    doubtful = [c for c in named if c.probability < CERTAIN]
    before, after = _model(traced, [], weight), _model(traced, certain, weight)
    opened = traced.search.open_world([c.term for c in certain if c.tone is None])
    judged = _judged(traced, held_back, before, after, verification, certain)
    between = _between_runs(traced, [c.term for c in certain if c.tone is None])
    notes += _between_notes(between)
    judged = replace(judged, gyros=_owned_up(traced, judged.gyros, after, [*certain, *doubtful], opened, between))
    residuals_of = _left(traced.runs, 0, before, after), _left(held_back, len(traced.runs), before, after)
    unexplained = _unexplained(residuals_of[0][1]) if opened.probability > CERTAIN else _beyond_noise(traced)
    # What leaves as much of its kind as it explains is a part of what is unexplained, and no rival of anything.
    open_ones = [c for c in doubtful if c.share < CERTAIN <= c.probability / c.share]
    rivals = [names for names in _rivals(open_ones) if len(names) > 1]
    faulty = _faulty(faults)
    added = [a.effect for a in faulty] + [_called(c) for c in certain]
    if rivals or (doubtful and not unexplained):
        rivals = rivals or _rivals(doubtful)
        finding = Finding.CANNOT_TELL
        reason = "these recordings cannot tell apart " + "; nor ".join(" and ".join(names) for names in rivals)
    elif unexplained:
        finding = Finding.PARTLY if added else Finding.UNEXPLAINED
        reason = f"added {', '.join(added)}; " if added else ""
        beyond = "is beyond the noise and " if unexplained.depends_on == NOTHING_MEASURED else ""
        reason += f"{unexplained.share:.0%} of what is left {beyond}depends on {unexplained.depends_on}, unexplained"
    elif added:
        finding, reason = Finding.ADDED, "added " + ", ".join(added)
    else:
        finding, reason = Finding.NOTHING, "the residual is that of the noise"
    if taken_back:
        notes.append(
            f"{', '.join(taken_back)}: the recordings speak for it, but it does not lower the error on the "
            "verification run beyond chance: taken back"
        )
    if held_back and finding in (Finding.NOTHING, Finding.ADDED) and judged.surprise > _SURPRISED:
        finding, reason, rivals, unexplained = _surprised(traced, held_back, most, certain, residuals_of[1][1])
    gained = traced.found.log_evidence[-1] - traced.found.log_evidence[0]
    models = [ModelStep((), 0.0, judged.before)]
    if certain:
        models.append(ModelStep(tuple(_called(c) for c in certain), gained, judged.after))
    if doubtful:
        called = tuple(_called(c) for c in [*certain, *doubtful])
        wider = _model(traced, [*certain, *doubtful], weight)
        errors = _judged(traced, held_back, before, wider, verification, [*certain, *doubtful]).after
        models.append(ModelStep(called, gained, errors))
    for choice in certain:
        if choice.tone is not None and not choice.tone.found.locked:
            notes.append(
                f"the tone at {choice.candidate.theta:.3f} Hz has another phase in each run: it is known, but cannot "
                "be taken off the rates of another run"
            )
    return Investigation(
        finding,
        reason,
        (*faulty, *(_added(traced, choice, after, told.get(choice.term.name)) for choice in certain)),
        tuple(rivals),
        unexplained,
        judged.before,
        judged.after,
        judged.improvement,
        not held_back,
        judged.gyros,
        tuple(models),
        _suspects(traced.found),
        left_out,
        tuple(notes),
        tuple(taken_back),
        judged.views,
        after,
        *residuals_of[0],
        *residuals_of[1],
    )


def _called(choice: Choice) -> str:
    """Return the name of an effect, or what a law is that has none."""
    law = choice.candidate.law
    return f"{in_words(law)} (constructed)" if law else choice.candidate.called


def _confirmed(traced: Traced, certain: list[Choice], held_back: Sequence[Run]) -> tuple[list[Choice], list[str]]:
    """Return the effects that the verification run bears out, and the names of those that it does not.

    The one that lowers its error least goes first, and the rest is judged again.
    """
    taken_back: list[str] = []
    while held_back and any(c.tone is None for c in certain):
        evidence, terms, runs = _with_held_back(traced, held_back, certain)
        told = told_by(evidence, terms, runs, {run.order for run in held_back})
        worst = min((c for c in certain if c.tone is None), key=lambda c: told[c.term.name])
        if told[worst.term.name] >= _CONFIRMED:
            break
        certain = [c for c in certain if c is not worst]
        taken_back.append(_called(worst))
    return certain, taken_back


def _with_held_back(
    traced: Traced, held_back: Sequence[Run], choices: Sequence[Choice]
) -> tuple[Evidence, list[Term], list[Run]]:
    """Return the evidence of all recordings, the verification runs' too, with the terms of some effects."""
    weight = traced.search.evidence.noise_weight([c.term for c in choices])
    runs = [*traced.runs, *held_back]
    return *together(runs, _model(traced, choices, weight), traced.search.evidence.shapes), runs


def _between_runs(traced: Traced, terms: Sequence[Term]) -> Floats:
    """Return the standard deviation (4,) of the states from recording to recording, zero where that may be chance."""
    evidence = traced.search.evidence
    weight = evidence.noise_weight(terms) * (evidence.shapes.turn_on == 0)  # else runs are expected to differ
    alone = [part for part in by_run(evidence, traced.runs) if all(gyro.stretches for gyro in part.gyros)]
    if len(alone) < 2 or not weight.any():
        return np.zeros(4)
    found = [part.posterior(terms, weight / weight.sum()) for part in alone]
    means = np.array([[mean[:4] for mean in one.means] for one in found])
    variances = np.array([[np.diag(c)[:4] for c in one.covariances] for one in found])
    return between_runs(means, np.sqrt(variances))


def _between_notes(between: Floats) -> list[str]:
    """Return, in words, which states differ from run to run."""
    sizes = between * [1e6, np.degrees(3600), 1e3, 1e3]
    words = zip(STATES, sizes.tolist(), ("ppm", "deg/h", "mrad", "mrad"), strict=True)
    told = [f"{name.split('_r')[0]} differs by {size:.2g} {unit}" for name, size, unit in words if size]
    return [f"{', '.join(told)} from run to run: the sigmas are those of another run"] if told else []


def _owned_up(
    traced: Traced,
    gyros: Sequence[GyroErrors],
    after: Augmented,
    choices: Sequence[Choice],
    opened: OpenWorld,
    between: Floats,
) -> tuple[GyroErrors, ...]:
    """Return errors with states that are the mean over what may act beside the model: rivals, and what has no name.

    Their sigmas are those of the same mixture, with what is ``between`` runs (4,).
    """
    search = traced.search
    closed = np.log1p(-min(opened.probability, 1 - 1e-12))
    sets = [(terms, value + closed) for terms, value in search.alternatives(choices)]
    sure = [c.term for c in choices if c.probability >= CERTAIN and c.tone is None]
    share = opened.by_size - np.logaddexp.reduce(opened.by_size) + np.log(max(opened.probability, 1e-30))
    base = np.logaddexp.reduce([value for _, value in sets]) - closed
    sets += [([*sure, search.open_term(float(s))], base + w) for s, w in zip(SIZES_RPS, share, strict=True)]
    total = np.logaddexp.reduce([value for _, value in sets])
    weights = [(terms, np.exp(value - total)) for terms, value in sets if value > total + np.log(_MATTERS)]
    scale = sum(w for _, w in weights)
    posteriors = [(search.evidence.posterior(terms), w / scale) for terms, w in weights]
    known = []
    for gyro in gyros:
        g = after.names.index(gyro.name)
        mean = np.sum([w * posterior.means[g][:4] for posterior, w in posteriors], axis=0)
        covariance = np.diag(between**2)
        for posterior, w in posteriors:
            apart = posterior.means[g][:4] - mean
            covariance += w * (posterior.covariances[g][:4, :4] + np.outer(apart, apart))
        states, covariance = decode(mean, covariance)
        moved = gyro.moved + (states - gyro.states_after) / gyro.sd_before
        known.append(replace(gyro, states_after=states, moved=moved, sd_after=np.sqrt(np.diag(covariance))))
    return tuple(known)


def _left(
    runs: Sequence[Run], first: int, before: Augmented, after: Augmented
) -> tuple[Residual | None, Residual | None]:
    """Return what two models leave of runs, of which the first has this number; from 0 are those that were fitted."""
    if not runs:
        return None, None
    found = residuals(runs, [before, after] if after.parts else [before], first, held_back=first > 0)
    return found[0], found[-1]


def _faulty(faults: Sequence[Fault]) -> list[Added]:
    """Return faults of the data as effects: they are seen in the samples, and what they spoil is left out."""
    found = []
    for kind in dict.fromkeys(fault.kind for fault in faults if fault.kind != SAMPLE_HOLD.name):
        own = [fault for fault in faults if fault.kind == kind]
        parameters = {f"{f.gyro} {name}": Value(value, 0.0, unit) for f in own for name, value, unit in f.values}
        found.append(Added(kind, tuple(dict.fromkeys(f.gyro for f in own)), 1.0, parameters))
    return found


def _visible(traced: Traced) -> tuple[Choice, ...]:
    """Return the effects found of which at least one number is some sigmas from zero: sums of little are no cause."""
    choices = traced.found.choices
    weight = traced.search.evidence.noise_weight([c.term for c in choices])
    model = _model(traced, choices, weight)
    kept = []
    for choice in choices:
        where = model.slice_of([part.candidate.name for part in model.parts].index(choice.candidate.name))
        sd = np.sqrt(np.diagonal(model.covariance, axis1=1, axis2=2))[:, where]
        if choice.candidate.depends_on or float(np.abs(model.mean[:, where] / sd).max()) > _VISIBLE:
            kept.append(choice)
    return tuple(kept)


def _at_rest(runs: Sequence[Run]) -> bool:
    return not any(run.turns for run in runs)


def _proven(choice: Choice, told: OutOfSample | None) -> Choice:
    """Return a choice no more probable than what was left out of the fit makes it, given what was expected of it."""
    if told is None:
        return choice
    odds = told.least + choice.candidate.log_prior
    return replace(choice, probability=min(choice.probability, float(1 / (1 + np.exp(-np.clip(odds, -50, 50))))))


def _with_copies(traced: Traced, choice: Choice) -> Choice:
    """Return a choice that cannot be told from others if a few rests let these put out the same.

    In a few poses at a few temperatures one cause is as good as another: that the simpler one fits is no proof.
    """
    if choice.tone is not None:
        return choice
    copies = traced.search.copies(choice, traced.found.terms)
    if not copies:
        return choice
    rivals = tuple(dict.fromkeys((choice.candidate.called, *copies)))
    share = min(choice.probability, 1 / len(rivals))
    return replace(choice, probability=share, share=share, rivals=rivals)


def _model(traced: Traced, choices: Sequence[Choice], weight: Floats) -> Augmented:
    evidence = traced.search.evidence
    posterior = evidence.posterior([c.term for c in choices], weight)
    shapes = evidence.shapes
    return Augmented.of(
        traced.names,
        posterior,
        [Part(c.candidate, c.term, c.tone) for c in choices],
        np.array([gyro.prior for gyro in traced.spectra]),
        np.array([gyro.arw for gyro in traced.spectra]),
        (float(np.sqrt(weight @ shapes.instability**2)), float(np.sqrt(weight @ shapes.walk**2))),
    )


def _judged(
    traced: Traced,
    held_back: Sequence[Run],
    before: Augmented,
    after: Augmented,
    verification: Sequence[Recording],
    choices: Sequence[Choice],
) -> Judged:
    evidence, terms, _ = _with_held_back(traced, held_back, choices)
    posterior = evidence.posterior(terms)
    all_of_it = _estimated(after, posterior)
    truth = Truth(all_of_it, evidence.misfit)
    if not held_back:
        return _cross_validated(traced, before, after, choices, truth)
    tones = [c.tone.found.frequency_hz for c in choices if c.tone is not None]
    fine_s = min([BLOCK_S, *(1 / (_TONE_BLOCKS * hz) for hz in tones)])
    runs: list[Run] = list(held_back)
    if fine_s < BLOCK_S:
        runs = _all_runs(verification, held_back[0].order, fine_s)[0]
        scale = len(runs[0].t_s) / len(held_back[0].t_s)
        truth = replace(truth, misfit={key: scale * squares for key, squares in truth.misfit.items()})
    first = len(traced.runs)
    return judge(runs, first, before, after, True, drawn(runs, first, before, after, truth))


def _estimated(model: Augmented, posterior: Posterior) -> Augmented:
    """Return a model with another estimate; its tones stay as they are."""
    mean, covariance = model.mean.copy(), model.covariance.copy()
    for g, (own, its) in enumerate(zip(posterior.means, posterior.covariances, strict=True)):
        mean[g, : len(own)], covariance[g, : len(own), : len(own)] = own, its
    return replace(model, mean=mean, covariance=covariance)


def _cross_validated(
    traced: Traced, before: Augmented, after: Augmented, choices: Sequence[Choice], truth: Truth
) -> Judged:
    """Return errors on each fifth of the steps of models fitted to the others, the noise as found on all."""
    if not choices:
        return judge(traced.runs, 0, before, after, False, drawn(traced.runs, 0, before, after, truth))
    # The models are those of all the data; errors by step hold what a fit without that step would have said.
    weight = traced.search.evidence.noise_weight([c.term for c in choices])
    parts = []
    share = replace(truth, misfit={key: squares / FOLDS for key, squares in truth.misfit.items()})
    for mask in by_step(traced.runs):
        runs = held(traced.runs, mask)
        # Tones stay as they were found on all steps: a fifth of them says nothing else of a line.
        rest = held(traced.runs, [~out for out in mask])
        evidence, terms = together(rest, after, traced.search.evidence.shapes)
        old = _estimated(before, evidence.posterior([], weight))
        new = _estimated(after, evidence.posterior(terms, weight))
        errors = drawn(runs, 0, old, new, share)
        parts.append((judge(runs, 0, old, new, False, errors), errors))
    whole = {name: sum_of(errors[name] for _, errors in parts) for name in after.names}
    judged = judge(traced.runs, 0, before, after, False, whole)
    cover = [
        float(np.mean([own.coverage95 for own in which if np.isfinite(own.coverage95)]))
        for which in ([j.before for j, _ in parts], [j.after for j, _ in parts])
    ]
    return replace(
        judged,
        before=replace(judged.before, coverage95=cover[0]),
        after=replace(judged.after, coverage95=cover[1]),
    )


def _added(traced: Traced, choice: Choice, model: Augmented, told: OutOfSample | None) -> Added:
    number = [part.candidate.name for part in model.parts].index(choice.candidate.name)
    where = model.slice_of(number)
    effect, shared = choice.candidate.effect, choice.term.shared
    parameters: dict[str, Value] = {}
    shown = []
    for g, name in enumerate(model.names):
        mean, doubts = model.mean[g, where], np.sqrt(np.diag(model.covariance[g, where, where]))
        if np.any(np.abs(mean) > _SHOWN * doubts):
            shown.append(name)
        if shared and g:
            continue
        for i, (value, doubt) in enumerate(zip(mean, doubts, strict=True)):
            parameter = effect.parameters[i % len(effect.parameters)]
            size = parameter.largest
            if (
                shared and choice.candidate.by_size
            ):  # not fitted to its own column, which the reference's noise enlarges
                value = abs(choice.candidate.theta or 0.0) / size
            label = parameter.name if shared else f"{name} {parameter.name}"
            if i >= len(effect.parameters):
                label += f" in run {i // len(effect.parameters) + 1}"
            parameters[label] = Value(float(value * size), float(doubt * size), parameter.unit)
    theta = choice.candidate.theta
    if theta is not None and choice.candidate.start is not None and not choice.candidate.by_size:
        sd = traced.search.sharpness(choice, traced.found.terms)
        what = next((setting.name for setting in effect.record.settings if setting.name), "constant")
        parameters[what] = Value(float(theta), sd, choice.candidate.unit)
    elif choice.tone is not None and theta is not None:
        parameters["frequency"] = Value(float(theta), _tone_sd(traced, model, where), "Hz")
    gyros = tuple(model.names) if shared else tuple(shown or model.names)
    copies = traced.search.copies(choice, traced.found.terms) if choice.tone is None else []
    law = choice.candidate.law
    called = in_words(law) if law else choice.candidate.called
    return Added(called, gyros, choice.probability, parameters, told, tuple(copies), bool(law), law)


def _tone_sd(traced: Traced, model: Augmented, where: slice) -> float:
    """Return the standard deviation of a tone's frequency: sqrt(6) / (pi T) over its amplitude in sigmas."""
    span_s = max(float(run.t_s[-1] - run.t_s[0]) for run in traced.runs)
    told = sum(
        float(m[where] @ np.linalg.solve(c[where, where], m[where]))
        for m, c in zip(model.mean, model.covariance, strict=True)
    )
    return float(np.sqrt(6) / (np.pi * span_s * np.sqrt(max(told, 1.0))))


def _unexplained(residual: Residual | None) -> Unexplained:
    """Return what a residual depends on most, and the share of its power beyond the noise that this takes up."""
    power: dict[str, float] = {}
    total = 0.0
    for gyro in residual.gyros if residual else ():
        total += gyro.nis * gyro.beyond
        for dependence in gyro.dependences:
            taken = gyro.nis * gyro.beyond * dependence.share
            power[dependence.variable] = power.get(dependence.variable, 0.0) + taken
    most = max(power, key=lambda variable: power[variable], default="")
    if not power or power[most] <= 0:
        return Unexplained(NOTHING_MEASURED, 0.0)
    return Unexplained(most, float(np.clip(power[most] / total, 0.0, 1.0)))


def _beyond_noise(traced: Traced) -> Unexplained | None:
    """Return what no function of what was measured can explain, such as a chirp, if it tells beside the noise found.

    Beside another instrument that moves, that one's own errors are of the kind.
    """
    evidence = traced.search.evidence
    best = int(np.argmax(evidence.noise_weight([c.term for c in traced.found.choices if c.tone is None])))
    misfit = sum(evidence.misfit.values())
    noise = sum(
        float(evidence.shapes.density(s)[best] @ s.counts) * gyro.arw**2 / s.length_s
        for gyro in evidence.gyros
        for s in gyro.stretches
    )
    share = misfit / (misfit + noise)
    return Unexplained(NOTHING_MEASURED, share) if share > _UNLIKE_NOISE and _lawful(traced.runs) else None


def _surprised(
    traced: Traced, held_back: Sequence[Run], most: int, certain: Sequence[Choice], residual: Residual | None
) -> tuple[Finding, str, list[tuple[str, ...]], Unexplained | None]:
    """Return the verdict where the verification shows an error that the other recordings could not show.

    What would explain it is looked for with the verification runs among the rest, to be named, not to be added.
    """
    wider, _ = _trace([*traced.runs, *held_back], most)
    known = {c.candidate.called for c in certain}
    extra = [c for c in wider.found.choices if c.candidate.called not in known and c.probability >= CERTAIN]
    reason = "the verification run shows an error that the other recordings cannot show"
    if extra:
        would = ", ".join(c.candidate.called for c in extra)
        return (
            Finding.CANNOT_TELL,
            f"{reason}; it would fit {would}, which a run of its own must prove",
            _rivals(extra),
            None,
        )
    return Finding.PARTLY if certain else Finding.UNEXPLAINED, reason, [], _unexplained(residual)


def _rivals(choices: Sequence[Choice]) -> list[tuple[str, ...]]:
    """Return for each choice the effects with a name that could stand in its place, itself among them."""
    shown = [[r for r in c.rivals if r != "nothing" and not r.startswith("depends")] for c in choices]
    named = [tuple("a constructed law" if r == CONSTRUCTED.name else r for r in rivals) for rivals in shown]
    return [names for names in named if names]


def _suspects(found: Found) -> tuple[Suspect, ...]:
    best = {"nothing": Suspect("nothing", 0.0, found.nothing)}
    for candidate, log_evidence, probability in found.first:
        name = f"depends on {candidate.depends_on}" if candidate.depends_on else candidate.called
        old = best.get(name)
        if old is None:
            best[name] = Suspect(name, log_evidence, probability)
        else:
            best[name] = Suspect(name, max(old.log_evidence, log_evidence), old.probability + probability)
    return tuple(sorted(best.values(), key=lambda s: -s.probability))
