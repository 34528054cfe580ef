"""Closing the loop on recordings: residual, cause, better model, and the error before and after."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimator.recording import Recording
from estimator.tracing.augmented import Augmented, Part
from estimator.tracing.candidates import candidates_of
from estimator.tracing.evidence import Evidence, Term
from estimator.tracing.faults import Fault
from estimator.tracing.held_out import Mask, by_step, held, out_of_sample, without
from estimator.tracing.investigation import (
    Added,
    Errors,
    Finding,
    Investigation,
    InvestigationError,
    ModelStep,
    OutOfSample,
    Suspect,
    Unexplained,
    Value,
)
from estimator.tracing.residual import Residual, residuals
from estimator.tracing.runs import BLOCK_S, Run, runs_of, same_devices
from estimator.tracing.search import CERTAIN, Choice, Found, Search
from estimator.tracing.spectra import GyroSpectra, NoiseShapes, gyro_spectra
from estimator.tracing.verification import Judged, judge

Floats = NDArray[np.float64]
Progress = Callable[[float, str], None]

_SURPRISED = 8.0
"""Sigmas by which the error on a verification run exceeds chance before a verdict is taken back."""
_REST_RPS = 2e-3  # several times Earth rate
_VISIBLE = 3.0
_SHOWN = 2.0  # a gyro shows an effect if a parameter of it is so many sigmas from zero
_TONE_BLOCKS = 8.0  # blocks in a period of a tone, where its error is judged
_KIN = {
    "rate": frozenset({"scale_asymmetry", "scale_quadratic", "scale_cubic", "dead_band"}),
    "acceleration": frozenset({"latency", "bandwidth", "acceleration_sensitivity", "sample_hold"}),
    "temperature": frozenset(
        {"thermal_bias", "thermal_bias_quadratic", "thermal_gradient", "thermal_scale", "warm_up"}
    ),
    "time": frozenset({"bias_drift", "warm_up", "bias_step"}),
    "direction": frozenset({"scale_asymmetry", "bias_step"}),
    "angle": frozenset({"table_harmonic", "table_axes", "earth_rate"}),
    "gravity": frozenset({"g_sensitivity"}),
}
"""Effects that depend on the same as structure that none explains: they fit a part of it and are no cause then."""


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
    notes += more
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
    return replace(traced, found=traced.search.run(most, tell)), left_out


def _prepared(runs: Sequence[Run], only: Sequence[str] | None = None) -> tuple[Traced, dict[str, str]]:
    spectra = gyro_spectra(runs)
    span_s = max(float(run.t_s[-1] - run.t_s[0]) + run.length_s for run in runs)
    search = Search(runs, spectra, Evidence(spectra, NoiseShapes.over(span_s)))
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
    general = [c for c in choices if c.candidate.depends_on]
    kin = set().union(*(_KIN.get(c.candidate.depends_on, frozenset()) for c in general))
    named = [c for c in choices if not c.candidate.depends_on and c.candidate.called not in kin]
    if _at_rest(traced.runs):
        named = [_with_copies(traced, choice) for choice in named]
    weight = traced.search.evidence.noise_weight([c.term for c in choices])
    told = out_of_sample(traced.runs, _model(traced, choices, weight), traced.search.evidence.shapes)
    named = [_proven(choice, told.get(choice.term.name)) for choice in named]
    certain = [c for c in named if c.probability >= CERTAIN]
    doubtful = [c for c in named if c.probability < CERTAIN]
    before = _model(traced, [], weight)
    after = _model(traced, certain, weight)
    whole = _model(traced, [*certain, *doubtful], weight) if doubtful else after
    judged = _judged(traced, held_back, before, after, verification, certain)
    rivals = _rivals(doubtful)
    rivals = [names for names in rivals if len(names) > 1] or rivals
    unexplained = _unexplained(traced, general, weight) if general else None
    if doubtful:
        finding = Finding.CANNOT_TELL
        reason = "these recordings cannot tell apart " + "; nor ".join(" and ".join(names) for names in rivals)
    elif general:
        finding = Finding.UNEXPLAINED
        reason = (
            f"the residual depends on {general[0].candidate.depends_on}, and no effect of the catalogue explains it"
        )
    elif certain or _faulty(faults):
        names = [a.effect for a in _faulty(faults)] + [c.candidate.called for c in certain]
        finding, reason = Finding.ADDED, "added " + ", ".join(names)
    else:
        finding, reason = Finding.NOTHING, "the residual is that of the noise"
    if held_back and finding in (Finding.NOTHING, Finding.ADDED) and judged.surprise > _SURPRISED:
        finding, reason, rivals, unexplained = _taken_back(traced, held_back, most, certain)
    gained = traced.found.log_evidence[-1] - traced.found.log_evidence[0]
    models = [ModelStep((), 0.0, judged.before)]
    if certain:
        called = tuple(c.candidate.called for c in certain)
        models.append(ModelStep(called, gained, judged.after))
    if doubtful:
        called = tuple(c.candidate.called for c in [*certain, *doubtful])
        errors = _judged(traced, held_back, before, whole, verification, [*certain, *doubtful]).after
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
        (*_faulty(faults), *(_added(traced, choice, after, told.get(choice.term.name)) for choice in certain)),
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
        judged.views,
        after,
        *_left(traced.runs, 0, before, after),
        *_left(held_back, len(traced.runs), before, after),
    )


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
    for kind in dict.fromkeys(fault.kind for fault in faults if fault.kind != "sample_hold"):
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
    return all(float(np.abs(run.w_rps).max(initial=0.0)) < _REST_RPS for run in runs)


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
    return replace(choice, probability=min(choice.probability, 1 / len(rivals)), rivals=rivals)


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
    if not held_back:
        return _cross_validated(traced, before, after, choices)
    tones = [c.tone.found.frequency_hz for c in choices if c.tone is not None]
    fine_s = min([BLOCK_S, *(1 / (_TONE_BLOCKS * hz) for hz in tones)])
    runs: list[Run] = list(held_back)
    if fine_s < BLOCK_S:
        runs = _all_runs(verification, held_back[0].order, fine_s)[0]
    return judge(runs, len(traced.runs), before, after, held_back=True)


def _cross_validated(traced: Traced, before: Augmented, after: Augmented, choices: Sequence[Choice]) -> Judged:
    """Return errors on each fifth of the steps of models fitted to the others, the noise as found on all."""
    if not choices:
        return judge(traced.runs, 0, before, after, held_back=False)
    # The models are those of all the data; errors by step hold what a fit without that step would have said.
    weight = traced.search.evidence.noise_weight([c.term for c in choices])
    full = _model(traced, choices, weight)
    judged = []
    for mask in by_step(traced.runs):
        old, new = _models_without(traced, full, mask, weight)
        judged.append(judge(held(traced.runs, mask), 0, old, new, held_back=False))
    whole = judge(traced.runs, 0, before, after, held_back=False)
    return replace(
        whole,
        before=_mean([j.before for j in judged]),
        after=_mean([j.after for j in judged]),
    )


def _mean(errors: Sequence[Errors]) -> Errors:
    known = [e for e in errors if np.isfinite(e.rms_rps)]
    return Errors(
        float(np.sqrt(np.mean([e.rms_rps**2 for e in known]))),
        max(e.max_rps for e in known),
        float(np.mean([e.coverage95 for e in known])),
    )


def _models_without(traced: Traced, full: Augmented, mask: Mask, weight: Floats) -> tuple[Augmented, Augmented]:
    """Return the first model and the last of all but what is left out, the noise as found on all."""
    terms, evidence = without(traced.runs, full, mask, traced.search.evidence.shapes)
    old, new = (
        Augmented.of(
            [gyro.name for gyro in evidence.gyros],
            evidence.posterior(chosen, weight),
            parts_of,
            full.prior,
            full.arw,
            (full.instability, full.walk),
        )
        for chosen, parts_of in (([], []), (terms, list(full.parts)))
    )
    return old, new


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
            if choice.candidate.by_size:  # what is late is what the gyro puts out, not the rate
                size /= 1 - float(model.mean[:, 0].mean() if shared else model.mean[g, 0])
            label = parameter.name if shared else f"{name} {parameter.name}"
            if i >= len(effect.parameters):
                label += f" in run {i // len(effect.parameters) + 1}"
            parameters[label] = Value(float(value * size), float(doubt * size), parameter.unit)
    theta = choice.candidate.theta
    if theta is not None and choice.candidate.start is not None and not choice.candidate.by_size:
        sd = traced.search.sharpness(choice, traced.found.terms)
        what = {"warm_up": "time constant", "bias_step": "instant", "dead_band": "width"}[choice.candidate.called]
        parameters[what] = Value(float(theta), sd, choice.candidate.unit)
    elif choice.tone is not None and theta is not None:
        parameters["frequency"] = Value(float(theta), _tone_sd(traced, model, where), "Hz")
    gyros = tuple(model.names) if shared else tuple(shown or model.names)
    copies = traced.search.copies(choice, traced.found.terms) if choice.tone is None else []
    return Added(choice.candidate.called, gyros, choice.probability, parameters, told, tuple(copies))


def _tone_sd(traced: Traced, model: Augmented, where: slice) -> float:
    """Return the standard deviation of a tone's frequency: sqrt(6) / (pi T) over its amplitude in sigmas."""
    span_s = max(float(run.t_s[-1] - run.t_s[0]) for run in traced.runs)
    told = sum(
        float(m[where] @ np.linalg.solve(c[where, where], m[where]))
        for m, c in zip(model.mean, model.covariance, strict=True)
    )
    return float(np.sqrt(6) / (np.pi * span_s * np.sqrt(max(told, 1.0))))


def _unexplained(traced: Traced, general: Sequence[Choice], weight: Floats) -> Unexplained:
    """Return what the residual depends on, and the share of its power beyond the noise that this takes up."""
    terms = traced.found.terms
    without = [t for t in terms if t.name not in {c.candidate.name for c in general}]
    power_with, power_without = _power(traced, terms, weight), _power(traced, without, weight)
    blocks = sum(len(s.band) for gyro in traced.spectra for s in gyro.stretches)
    # Where what is left is below the white noise found at high frequencies, all of it counts.
    noise = blocks if power_with > blocks else 0.0
    share = 1 - (power_with - noise) / max(power_without - noise, 1e-9)
    return Unexplained(general[0].candidate.depends_on, float(np.clip(share, 0.0, 1.0)))


def _power(traced: Traced, terms: Sequence[Term], weight: Floats) -> float:
    """Return the squares left beside a model, over the white noise."""
    posterior = traced.search.evidence.posterior(terms, weight)
    own = [c for t in terms if not t.shared for c in t.columns]
    shared = [c for t in terms if t.shared for c in t.columns]
    total = 0.0
    for gyro, mean in zip(traced.search.evidence.gyros, posterior.own, strict=True):
        whole = np.concatenate([mean, posterior.shared])
        for part in gyro.columns:
            rest = part[:, 4] - part[:, [*range(4), *own, *shared]] @ whole
            total += float(rest @ rest)
    return total


def _taken_back(
    traced: Traced, held_back: Sequence[Run], most: int, certain: Sequence[Choice]
) -> tuple[Finding, str, list[tuple[str, ...]], Unexplained | None]:
    """Return the verdict where the verification shows an error that the other recordings could not show.

    What would explain it is looked for with the verification runs among the rest, to be named, not to be added.
    """
    wider, _ = _trace([*traced.runs, *held_back], most)
    known = {c.candidate.called for c in certain}
    extra = [c for c in wider.found.choices if c.candidate.called not in known]
    named = [c for c in extra if not c.candidate.depends_on]
    said = "the verification run shows an error that the other recordings cannot show"
    if named:
        would = ", ".join(c.candidate.called for c in named)
        reason = f"{said}; it would fit {would}, which a run of its own must prove"
        return Finding.CANNOT_TELL, reason, _rivals(named), None
    if extra:
        weight = wider.search.evidence.noise_weight(wider.found.terms)
        return Finding.UNEXPLAINED, said, [], _unexplained(wider, extra, weight)
    return Finding.UNEXPLAINED, said, [], Unexplained("time", 0.0)


def _rivals(choices: Sequence[Choice]) -> list[tuple[str, ...]]:
    """Return for each choice the effects with a name that could stand in its place, itself among them."""
    named = [tuple(r for r in c.rivals if r != "nothing" and not r.startswith("depends")) for c in choices]
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
