"""What is said at the end: the verdict and its reason, and the effects that were added with their numbers."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from estimator.effects.disturbances import SAMPLE_HOLD
from estimator.effects.law import in_words
from estimator.estimation.evidence import Term
from estimator.estimation.noise_evidence import bias_notes
from estimator.observations.defects.faults import Fault
from estimator.packaged import sentence
from estimator.tracing.augmented import Augmented, Part
from estimator.tracing.investigation import COMMON_CAUSE, Added, Finding, OutOfSample, Unexplained, Value
from estimator.tracing.residuals.residual import Residual
from estimator.tracing.search import CERTAIN, Found, Search
from estimator.tracing.tones.causes import faint, images
from estimator.types import Floats

_SHOWN = 2.0  # a gyro shows an effect if a parameter of it is so many sigmas from zero
_UNLIKE_NOISE = 0.1  # share of the residual's power beyond the noise: less is 5 % of a sigma
NOTHING_MEASURED = "nothing that was measured"


@dataclass(frozen=True, slots=True)
class Verdict:
    """Result of an investigation: finding, reason, sets of effects that cannot be told apart, the unexplained part."""

    finding: Finding
    reason: str
    rivals: tuple[tuple[str, ...], ...] = ()
    unexplained: Unexplained | None = None

    @property
    def leaves_nothing_open(self) -> bool:
        """Whether all that depends on measured values is explained, without rivals."""
        if self.finding is Finding.PARTLY:
            return self.unexplained is not None and self.unexplained.depends_on == NOTHING_MEASURED
        return self.finding is Finding.ADDED


def verdict_of(added: Sequence[str], doubtful: Sequence[Part], unexplained: Unexplained | None) -> Verdict:
    """Return the verdict for the ``added`` effects, the ``doubtful`` ones and the unexplained part.

    CANNOT_TELL if doubtful effects have rivals, or nothing is unexplained beside them; else PARTLY or UNEXPLAINED for
    an unexplained part, by whether something was added; else ADDED or NOTHING. A doubtful effect that leaves as much of
    its kind as it explains has no rivals.
    """
    # An effect that leaves as much of its kind as it explains is a part of the unexplained, and no rival.
    open_ones = [part for part in doubtful if part.share < CERTAIN and part.probability >= CERTAIN * part.share]
    rivals = tuple(names for names in rivals_of(open_ones) if len(names) > 1)
    if rivals or (doubtful and not unexplained):
        rivals = rivals or rivals_of(doubtful)
        apart = [" and ".join(names) for names in rivals if len(names) > 1]
        unproved = [names[0] for names in rivals if len(names) == 1]
        told = [f"cannot tell apart {'; nor '.join(apart)}"] if apart else []
        told += [f"suggest but do not prove {', '.join(unproved)}"] if unproved else []
        return Verdict(Finding.CANNOT_TELL, f"these recordings {' and '.join(told)}", rivals, unexplained)
    reasons = [f"added {', '.join(added)}"] if added else []
    if unexplained:
        reasons.append(_unexplained(unexplained))
        likely = [part.called for part in doubtful if part.share >= CERTAIN]
        if likely:
            reasons.append(f"{', '.join(likely)} would explain a part of it, which held-out data do not confirm")
        return Verdict(Finding.PARTLY if added else Finding.UNEXPLAINED, "; ".join(reasons), (), unexplained)
    return (
        Verdict(Finding.ADDED, reasons[0])
        if added
        else Verdict(Finding.NOTHING, "the residual is consistent with noise")
    )


def _unexplained(unexplained: Unexplained) -> str:
    """Return what of the residual is unexplained, in words."""
    if unexplained.depends_on == COMMON_CAUSE:
        return f"{unexplained.share:.0%} of the slow residual comes from {COMMON_CAUSE}, unexplained"
    beyond = "is beyond the noise and " if unexplained.depends_on == NOTHING_MEASURED else ""
    return f"{unexplained.share:.0%} of the residual {beyond}depends on {unexplained.depends_on}, unexplained"


def surprised(certain: Sequence[Part], wider: Found, residual: Residual | None) -> Verdict:
    """Return the verdict if the verification run shows an error that the other recordings do not show.

    ``wider`` was found with the verification runs included: certain effects in it that are not among ``certain`` are
    named, not added (CANNOT_TELL). Without any it is PARTLY or UNEXPLAINED, by whether there are certain effects, with
    what ``residual`` depends on.
    """
    known = {part.candidate.called for part in certain}
    extra = [p for p in wider.parts if p.candidate.called not in known and p.probability >= CERTAIN]
    reason = "the verification run shows an error that the other recordings do not show"
    if not extra:
        return Verdict(Finding.PARTLY if certain else Finding.UNEXPLAINED, reason, (), unexplained_of(residual))
    would = ", ".join(part.called for part in extra)
    reason += f"; {would} would explain it, which a separate run must prove"
    return Verdict(Finding.CANNOT_TELL, reason, rivals_of(extra))


def rivals_of(parts: Sequence[Part]) -> tuple[tuple[str, ...], ...]:
    """Return for each part the effects with a name that could stand in its place, itself among them."""
    named = [tuple(rival for rival in part.rivals if rival != "nothing") for part in parts]
    return tuple(names for names in named if names)


def unexplained_of(residual: Residual | None) -> Unexplained | None:
    """Return the variable that a residual depends on most, and its share of the power beyond the noise.

    If it depends on none, the share is that of all power which is beyond the noise. None if that is next to nothing, or
    without a residual.
    """
    power: dict[str, float] = {}
    total = whole = 0.0
    for gyro in residual.gyros if residual else ():
        total += gyro.nis * gyro.beyond
        whole += gyro.nis
        for dependence in gyro.dependences:
            taken = gyro.nis * gyro.beyond * dependence.share
            power[dependence.variable] = power.get(dependence.variable, 0.0) + taken
    most = max(power, key=lambda variable: power[variable], default="")
    if power and power[most] > 0:
        return Unexplained(most, float(np.clip(power[most] / total, 0.0, 1.0)))
    share = total / whole if whole else 0.0
    return Unexplained(NOTHING_MEASURED, share) if share > _UNLIKE_NOISE else None


def file_notes(search: Search, terms: Sequence[Term]) -> list[str]:
    """Return a sentence if biases differ from file to file of an import, beside the effects ``terms``; else an empty
    list.
    """
    if not any(run.recording.several_files for run in search.runs):
        return []
    evidence = search.evidence
    weight = evidence.noise_weight(terms)
    arw = float(np.mean([gyro.arw for gyro in evidence.gyros]))
    return bias_notes(search.runs[0].recording, weight, evidence.shapes.turn_on, arw)


def beyond_noise(search: Search, found: Found) -> Unexplained | None:
    """Return the part of the residual that no function of measured values explains, such as a chirp.

    None if it is small, or if the reference is another moving instrument, whose own errors are of this kind.
    """
    evidence = search.evidence
    best = int(np.argmax(evidence.noise_weight(found.terms)))
    misfit = sum(evidence.misfit.values())
    noise = sum(
        float(evidence.shapes.density(s)[best] @ s.counts) * gyro.arw**2 / s.length_s
        for gyro in evidence.gyros
        for s in gyro.stretches
    )
    share = misfit / (misfit + noise)
    told = share > _UNLIKE_NOISE and not any(run.by_another for run in search.runs)
    return Unexplained(NOTHING_MEASURED, share) if told else None


def faults_added(faults: Sequence[Fault]) -> list[Added]:
    """Return faults of the data as effects of probability 1, one for each kind, with the gyros and values that show it.

    A value is named "GYRO NAME"; those of further faults of a gyro have a number, from "(2)" on. Held samples are left
    out: they are searched for as an effect.
    """
    found = []
    for kind in dict.fromkeys(fault.kind for fault in faults if fault.kind != SAMPLE_HOLD.name):
        own = [fault for fault in dict.fromkeys(faults) if fault.kind == kind]
        parameters = {}
        for at, fault in enumerate(own):
            number = sum(other.gyro == fault.gyro for other in own[: at + 1])
            for name, value, unit in fault.values:
                label = f"{fault.gyro} {name}" + (f" ({number})" if number > 1 else "")
                parameters[label] = Value(value, 0.0, unit)
        found.append(
            Added(effect=kind, gyros=tuple(dict.fromkeys(f.gyro for f in own)), probability=1.0, parameters=parameters)
        )
    return found


def added_of(search: Search, found: Found, part: Part, model: Augmented, told: OutOfSample | None) -> Added:
    """Return an effect of the last model with its numbers; ``told`` is what data left out of the fit say of it.

    Numbers are of all gyros as "GYRO PARAMETER", shared ones once as "PARAMETER", with " in run 2" and so on for a tone
    that is not locked. A tone has its "frequency", a nonlinear effect its setting. ``gyros`` are those that show it,
    all if none does. A composed law is named in words.
    """
    where = model.slice_of(part.candidate.name)
    candidate, shared = part.candidate, part.term.shared
    effect = candidate.effect
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
            if shared and candidate.by_size:  # not fitted to its own column, which the reference's noise enlarges
                value = abs(candidate.theta or 0.0) / size
            label = parameter.name if shared else f"{name} {parameter.name}"
            if i >= len(effect.parameters):
                label += f" in run {i // len(effect.parameters) + 1}"
            parameters[label] = Value(float(value * size), float(doubt * size), parameter.unit)
    if part.tone is not None:
        frequency_hz = part.tone.found.frequency_hz
        parameters["frequency"] = Value(frequency_hz, _tone_sd(search, model, where), "Hz")
    elif candidate.theta is not None and not candidate.by_size:
        what = next((setting.name for setting in effect.record.settings if setting.name), "constant")
        parameters[what] = Value(float(candidate.theta), search.sharpness(part, found.terms), candidate.unit)
    gyros = tuple(model.names) if shared else tuple(shown or model.names)
    law = candidate.law
    called = in_words(law) if law else candidate.called
    copies = tuple(dict.fromkeys([*search.copies(part, found.terms), *part.alike]))
    return Added(
        effect=called,
        gyros=gyros,
        probability=part.probability,
        parameters=parameters,
        out_of_sample=told,
        same=copies,
        constructed=bool(law),
        expression=law,
    )


def rival_sizes(
    search: Search, found: Found, certain: Sequence[Part], doubtful: Sequence[Part], weight: Floats
) -> tuple[Added, ...]:
    """Return the doubtful effects and their rivals with their numbers, each as if it alone acted beside the certain
    ones.

    ``weight`` (G,) are the probabilities of the noise models. The probability is that of the chosen effect, NaN for its
    rivals. Each effect is listed once; tones are left out.
    """
    terms = [part.term for part in certain if part.tone is None]
    names = [part.candidate.name for part in certain]
    sizes: dict[str, Added] = {}
    for part in doubtful:
        if part.tone is not None:
            continue
        scores = search.scores(terms, names)
        tried = {part.candidate.called: (part, part.probability)}
        for name, (_, term) in sorted(scores.items(), key=lambda item: -item[1][0]):
            candidate = search.known[name][0]
            if candidate.called in part.rivals and candidate.called not in tried:
                other = replace(part, candidate=candidate, term=term, rivals=())
                tried[candidate.called] = (other, float("nan"))
        for called, (own, probability) in tried.items():
            model = Augmented.of(search.evidence, [*certain, own], weight)
            shown = added_of(search, replace(found, parts=(*certain, own)), own, model, None)
            sizes.setdefault(called, replace(shown, probability=probability, same=()))
    return tuple(sizes.values())


@dataclass(frozen=True, slots=True, eq=False)
class Causes:
    """The effects added, each cause once: without tones that are ``echoes`` of another, by its name, or ``weak``."""

    parts: list[Part]
    echoes: dict[str, list[Part]]
    weak: list[Part]

    @classmethod
    def among(
        cls, search: Search, certain: Sequence[Part], model: Augmented, left: Residual | None, unexplained: object
    ) -> "Causes":
        """Return the causes among the certain parts of a model: without tones that are images of others, or weak.

        ``model`` leaves the residual ``left``. Weak tones are removed only if something is left unexplained. They are
        kept in ``weak`` for the notes, images in ``echoes`` by the name of their tone.
        """
        weak = faint(certain, search.evidence, search.runs, model, left) if unexplained and left else []
        echoes = images(certain, search.runs)
        others = [*weak, *(part for own in echoes.values() for part in own)]
        return cls([part for part in certain if all(part is not other for other in others)], echoes, weak)

    def less_probable(self, most: Mapping[str, float]) -> "Causes":
        """Return the same with parts no more probable than ``most`` says, by the names of their candidates."""
        parts = [
            replace(part, probability=min(part.probability, most.get(part.candidate.name, 1.0))) for part in self.parts
        ]
        return replace(self, parts=parts)

    def added(
        self, search: Search, found: Found, model: Augmented, told: Mapping[str, OutOfSample]
    ) -> tuple[Added, ...]:
        """Return the causes with their numbers; tones also have the frequencies of their images.

        ``told`` is by name what data left out of the fit say of them.
        """
        return tuple(
            with_images(
                added_of(search, found, part, model, told.get(part.term.name)),
                self.echoes.get(part.candidate.name, ()),
            )
            for part in self.parts
        )

    @property
    def notes(self) -> list[str]:
        """Sentences on weak tones."""
        return [sentence("tracing.faint_tone", frequency_hz=part.candidate.theta) for part in self.weak]


def with_images(added: Added, others: Sequence[Part]) -> Added:
    """Return a tone with the frequencies at which the sampling shows it once more."""
    parameters = dict(added.parameters)
    for number, part in enumerate(others):
        label = "its alias by the sampling" + (f" {number + 1}" if number else "")
        parameters[label] = Value(float(part.candidate.theta or 0.0), 0.0, "Hz")
    return replace(added, parameters=parameters)


def _tone_sd(search: Search, model: Augmented, where: slice) -> float:
    """Return the standard deviation of a tone's frequency in Hz: sqrt(6) / (pi T) over its amplitude in sigmas.

    T is the length of the longest run; ``where`` is the place of the tone among the numbers of ``model``.
    """
    span_s = max(float(run.t_s[-1] - run.t_s[0]) for run in search.runs)
    told = sum(
        float(m[where] @ np.linalg.solve(c[where, where], m[where]))
        for m, c in zip(model.mean, model.covariance, strict=True)
    )
    return float(np.sqrt(6) / (np.pi * span_s * np.sqrt(max(told, 1.0))))
