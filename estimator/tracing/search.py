"""Which effects a model lacks: one is added at a time, and each is tried to be removed or exchanged again."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from estimator.effects.disturbances import TONE
from estimator.errors import InvestigationError
from estimator.estimation.evidence import SCALES, Base, Evidence, Term
from estimator.estimation.runs.run import Run
from estimator.estimation.runs.tone_columns import samples_of, tone_columns
from estimator.estimation.spectra import GyroSpectra
from estimator.observations.turned import by_turns
from estimator.tracing.candidates import Candidate
from estimator.tracing.open_world import OpenWorld
from estimator.tracing.scan import Scan, at
from estimator.tracing.tones.peaks import highest
from estimator.tracing.tones.tones import ToneFit, ToneFound, find_tone, fit_tone, without_tone
from estimator.types import Floats

CERTAIN = 0.95
"""Posterior probability from which an effect counts as found."""
_SET = 0.99  # rivals are as many as share this probability
_ROUNDS = 12
_STOP_LOG_PRIOR = 0.0  # nothing more: as likely as all effects together, several times over
_LOST = 0.3  # share by which the size of a lag may differ from that which it was worked out for
_UNEXCITED = 0.5  # sigmas of an effect of the largest plausible size, all gyros and runs together
_COPIED = 9.0  # squares over noise that a copy of an effect leaves in a gyro, within chance
_RICH = 0.1  # scale of all effects at once, when it is asked what the noise may be
_LIKE = 0.1  # share of a function's squares that an effect puts out: from then on they are of a kind
_CHANCE = 3.0  # natural logarithm by which functions without a name may be the more probable by chance
_RESOLVED = 0.1  # of the time between readings: shorter delays are not told from how they are interpolated
_MOST_SETS = 40
_MOST_LAWS, _LAWS_TRIED = 2, 12
_BETWEEN = 1.3  # by so much more a law may explain with a constant between those that it is tried with
_CLEARLY = 3.0  # natural logarithm by which a law must be the more probable
_RIVAL = -6.0  # natural logarithm of how much less probable laws may be and still be rivals, a few together
_MOST_TONES = 3


@dataclass(frozen=True, slots=True, eq=False)
class Choice:
    """One effect of the model found: its candidate, its term, how probable it is, what could stand in its place.

    ``share`` is its probability among its ``rivals`` alone, whatever else may be.
    """

    candidate: Candidate
    term: Term
    probability: float
    rivals: tuple[str, ...]
    tone: ToneFit | None = None
    share: float = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """What a search ends with. ``first``: log evidence and probability of each candidate beside the bare model.

    ``nothing`` is the probability that the bare model lacks none of them.
    """

    choices: tuple[Choice, ...]
    log_evidence: tuple[float, ...]
    first: tuple[tuple[Candidate, float, float], ...]
    nothing: float = 1.0

    @property
    def terms(self) -> list[Term]:
        """Terms of the model."""
        return [choice.term for choice in self.choices]


class Search:
    """A search among candidates on the spectra of some runs."""

    def __init__(self, runs: Sequence[Run], spectra: Sequence[GyroSpectra], evidence: Evidence) -> None:
        """Begin with no candidates: ``add`` brings them in."""
        self._runs, self._spectra, self.evidence = list(runs), list(spectra), evidence
        self._coarse = [run.coarse() for run in runs]
        self._known: dict[str, tuple[Candidate, Term]] = {}
        self._samples = [samples_of(run) for run in runs]
        self._tones: list[Choice] = []
        self._scored: dict[tuple[tuple[tuple[int, ...], float], ...], dict[str, tuple[float, Term]]] = {}
        self._barred: set[str] = set()
        self._turned: dict[tuple[str, float, str], Floats] = {}
        self._laws_kept: set[str] = set()

    def add(self, candidates: Sequence[Candidate]) -> None:
        """Bring in candidates: their columns are worked out for every gyro."""
        if not candidates:
            return
        fresh = not self._known
        self._scored.clear()
        start = self._spectra[0].columns[0].shape[1]
        for spectra in self._spectra:
            spectra.add(spectra.parts(self._runs, partial(self._columns, candidates)))
        for candidate in candidates:
            p = len(candidate.effect.parameters)
            term = Term(
                candidate.name,
                tuple(range(start, start + p)),
                candidate.effect.shared,
                log_tries=candidate.log_tries,
            )
            self._known[candidate.name] = (candidate, term)
            start += p
        self.evidence.refresh()
        if fresh:
            rich = [term.scaled(_RICH) for c, term in self._known.values() if not c.depends_on and not term.shared]
            self.evidence.narrow([[], rich])

    def leave_out_unexcited(self) -> list[Candidate]:
        """Leave out the candidates of which not even the largest plausible size would show; return them."""
        out = []
        for name, (candidate, term) in list(self._known.items()):
            columns = np.array(term.columns, dtype=np.intp)
            if not len(columns):
                continue
            shown = sum(float(gram[0, columns, columns].max()) for gram in self.evidence.grams)
            if shown < _UNEXCITED**2:
                out.append(candidate)
                del self._known[name]
        self._scored.clear()
        return out

    def run(self, most: int, progress: Callable[[float], None] | None = None) -> Found:
        """Return the most probable model of at most so many effects."""
        chosen: list[str] = []
        terms: dict[str, Term] = {}
        first: tuple[tuple[Candidate, float, float], ...] = ()
        chain = [self.evidence.of([])]
        heard, nothing = 0.0, 1.0
        for turn in range(_ROUNDS):
            model = [terms[name] for name in chosen]
            self._refine(model, chosen)
            self._allow_for_misfit(terms)
            chain[-1] = self.evidence.of(model) + heard
            scores = self._scores(model, chosen)
            stop = self.evidence.of(model) + _STOP_LOG_PRIOR
            tone = self._tone(model)
            options = {name: score for name, (score, _) in scores.items()}
            if tone is not None:
                options[TONE.name] = stop + tone.log_evidence + max(c.log_prior for c, _ in self._known.values())
            total = float(np.logaddexp.reduce([stop, *options.values()]))
            if not first:
                first = self._first(options, chain[0], total, tone)
                nothing = float(np.exp(stop - total))
            best = max(options, key=lambda name: options[name], default=None)
            if progress is not None:
                progress((turn + 1) / (most + 2))
            full = len(chosen) + len(self._tones) >= most
            if best is None or np.exp(stop - total) > 1 - CERTAIN or full:
                break
            if best != TONE.name and not self._sensible(best, scores[best][1], model):
                self._barred.add(best)
                self._scored.clear()
                if not chosen and not self._tones:
                    first = ()  # what cannot be is no suspect
                continue
            if best == TONE.name:
                assert tone is not None
                heard += tone.log_evidence
                self._take(tone, float(np.exp(options[TONE.name] - total)), model)
            else:
                chosen.append(best)
                terms[best] = scores[best][1]
            chosen, terms = self._exchanged(chosen, terms)
            chain.append(self.evidence.of([terms[name] for name in chosen]) + heard)
        choices = [*(self._judge(name, chosen, terms) for name in chosen), *self._tones]
        return Found(tuple(self._beside_open(choices)), tuple(chain), first, nothing)

    def composed(self, found: Found, laws: Sequence[Candidate], most: int) -> Found:
        """Return what was found with laws that have no name, where they explain more than names do, or beside these."""
        named = [c for c in found.choices if c.tone is None]
        tones = [c for c in found.choices if c.tone is not None]
        model = [(c.candidate, c.term) for c in named]
        best = self._worth(model)
        for _ in range(_MOST_LAWS):
            # A law may stand beside what was found, or in the place of some of it.
            bases = [model, [], *([pair for pair in model if pair is not one] for one in model)]
            tried = []
            for n, base in enumerate(bases):
                if base not in bases[:n] and len(base) + len(tones) < most:
                    tried.append([*base, *self._best_law(base, laws, model)])
            worths = [self._worth(one) for one in tried]
            if not worths or max(worths) < best + _CLEARLY:
                break
            best = max(worths)
            model = tried[worths.index(best)]
        for one in [pair for pair in model if not pair[0].law]:
            rest = [pair for pair in model if pair is not one]
            self._laws_kept.update(self._likely(rest, laws, model, _RIVAL))
        if not any(candidate.law for candidate, _ in self._known.values()):
            return found
        names, terms = [c.name for c, _ in model], {c.name: term for c, term in model}
        judged = [self._judge(name, names, terms) for name in names]
        while judged and (least := min(judged, key=lambda c: c.share)).rivals[0] == "nothing":  # a law took its place
            names.remove(least.candidate.name)
            del terms[least.candidate.name]
            judged = [self._judge(name, names, terms) for name in names]
        chain = (*found.log_evidence, self.evidence.of(list(terms.values())))
        return replace(found, choices=tuple(self._beside_open([*judged, *tones])), log_evidence=chain)

    def _worth(self, model: Sequence[tuple[Candidate, Term]], noise: int | None = None) -> float:
        """Return the log evidence of a model, under all noise models or one, and how much it was expected."""
        expected = sum(candidate.log_prior - term.log_tries for candidate, term in model)
        terms = [term for _, term in model]
        return (self.evidence.of(terms) if noise is None else float(self.evidence.by_noise(terms)[noise])) + expected

    def _best_law(
        self, base: Sequence[tuple[Candidate, Term]], laws: Sequence[Candidate], known: Sequence[tuple[Candidate, Term]]
    ) -> list[tuple[Candidate, Term]]:
        """Return the law that explains most beside a model; none if none can explain more than what is ``known``."""
        chosen = self._likely(base, laws, known, _CLEARLY)
        terms = [term for _, term in base]
        scores = self._scores(terms, [candidate.name for candidate, _ in base]) if chosen else {}
        found = [name for name in chosen if self._sensible(name, scores[name][1], terms)]
        best = max(found, key=lambda name: scores[name][0], default=None)
        if best is None:
            return []
        self._laws_kept.add(best)
        return [(self._known[best][0], scores[best][1])]

    def _likely(
        self,
        base: Sequence[tuple[Candidate, Term]],
        laws: Sequence[Candidate],
        known: Sequence[tuple[Candidate, Term]],
        least: float,
    ) -> list[str]:
        """Bring in the laws that may be more probable beside a model than what is ``known``, by ``least``; name them.

        The noise is that beside what is known: beside less, it would hold what slow laws explain.
        """
        noise = int(np.argmax(self.evidence.noise_weight([term for _, term in known])))
        scan = Scan(self._coarse, self._spectra, self.evidence, [term for _, term in base], self._turned, noise)
        taken = {candidate.name for candidate, _ in base}
        ranked, missing = [], self._worth(known, noise) + least - self._worth(base, noise)
        for law in (law for law in laws if law.name not in taken):
            options = [law] if law.start is None else [at(law, theta) for theta in law.start.tolist()]
            gains = [scan.gain(option) for option in options]
            reach = max(gains) * (1.0 if law.start is None else _BETWEEN)
            if reach + law.log_prior > missing:  # by no more can it be the more probable
                ranked.append((max(gains) + law.log_prior, options[int(np.argmax(gains))]))
        ranked.sort(key=lambda pair: -pair[0])
        chosen = [self._tuned(law, scan) if law.start is not None else law for _, law in ranked[:_LAWS_TRIED]]
        for name in [n for n, (c, _) in self._known.items() if c.law and n not in self._laws_kept]:
            del self._known[name]
        self.add([law for law in chosen if law.name not in self._laws_kept])
        self._scored.clear()
        return [law.name for law in chosen]

    def open_world(self, model: Sequence[Term]) -> OpenWorld:
        """Return how probable it is beside a model that something acts that has no name."""
        columns, sizes = self._open_columns()
        return OpenWorld.beside(self.evidence, model, columns, sizes)

    def open_term(self, size_rps: float) -> Term:
        """Return the sum of functions that may act without a name, of this size, as a term."""
        columns, sizes = self._open_columns()
        return Term("open", tuple(columns), False, size_rps, sizes=tuple(sizes.tolist()))

    def alternatives(self, choices: Sequence[Choice]) -> list[tuple[list[Term], float]]:
        """Return the sets of terms that may be true where choices are open, each with its log evidence and expectation.

        In the place of each that is not certain stands nothing, itself, or one of its rivals.
        """
        kept = [c for c in choices if c.tone is None and c.probability >= CERTAIN]
        sets = [kept]
        for choice in (c for c in choices if c.tone is None and c.probability < CERTAIN):
            scores = self._scores([c.term for c in kept], [c.candidate.name for c in kept])
            rivals = [n for n, _ in scores.items() if self._known[n][0].called in choice.rivals]
            swapped = [replace(choice, candidate=self._known[n][0], term=scores[n][1]) for n in rivals]
            sets = [[*own, *more] for own in sets for more in ([], *([one] for one in [choice, *swapped]))][:_MOST_SETS]
        found = []
        for own in sets:
            terms = list({c.candidate.name: c.term for c in own}.values())
            prior = sum(c.candidate.log_prior for c in own if c not in kept)
            found.append((terms, self.evidence.of(terms) + prior))
        return found

    def _open_columns(self) -> tuple[list[int], Floats]:
        """Return columns that stand for any function of what was measured, and how each is scaled to 1 rad/s rms."""
        columns = [c for candidate, term in self._known.values() if not _one_of_many(candidate) for c in term.columns]
        squares, seconds = np.zeros(len(columns)), 0.0
        for gyro in self._spectra:
            for stretch, part in zip(gyro.stretches, gyro.columns, strict=True):
                squares += np.sum(part[1:, columns] ** 2, axis=0) * gyro.arw**2
                seconds += len(part) * stretch.length_s
        rms = np.sqrt(squares / seconds)
        seen = rms > 1e-9 * rms.max(initial=1e-30)
        return [c for c, there in zip(columns, seen, strict=True) if there], 1 / rms[seen]

    def _beside_open(self, choices: Sequence[Choice]) -> list[Choice]:
        """Return choices no more probable than the structure beside them allows.

        An effect that only imitates another leaves a part of it, in functions that are like itself. Who explains a
        residual leaves nothing of the kind. Beside a moving reference that has errors of its own, all functions count
        for all effects but the delay between the two.
        """
        foreign = any(by_turns(run.recording.reference) and run.turns for run in self._runs)
        terms = [choice.term for choice in choices if choice.tone is None]
        judged = []
        for choice in choices:
            if choice.tone is None:
                others = [term for term in terms if term is not choice.term]
                columns, sizes = self._open_columns()
                least = 0.0 if foreign and not choice.candidate.by_size else _LIKE
                like = self._likeness(choice.term, np.array(columns, dtype=np.intp), others) > least
                kept = [c for c, is_like in zip(columns, like, strict=True) if is_like], sizes[like]
                left = OpenWorld.beside(self.evidence, terms, *kept)
                explained = max(left.closed - self.evidence.of(others), 0.0)
                beside = max(float(left.by_size.max()) - left.closed - _CHANCE, 0.0)
                choice = replace(choice, probability=choice.probability * explained / max(explained + beside, 1e-9))
            judged.append(choice)
        return judged

    def _likeness(self, term: Term, columns: NDArray[np.intp], beside: Sequence[Term]) -> Floats:
        """Return the share of the squares of columns (c,) that a term's own put out beside others, over all gyros."""
        best = int(np.argmax(self.evidence.noise_weight(beside)))
        mine = np.array(term.columns)
        base = Base(self.evidence, beside)
        shown, whole = np.zeros(len(columns)), np.full(len(columns), 1e-300)
        for reduced in base.reduced:
            own = reduced[best]
            across = own[np.ix_(mine, columns)]
            inner = own[np.ix_(mine, mine)] + (1e-12 * np.trace(own[np.ix_(mine, mine)]) + 1e-30) * np.eye(len(mine))
            whole += own[columns, columns]
            shown += np.sum(across * np.linalg.solve(inner, across), axis=0)
        return np.asarray(shown / whole)

    def _allow_for_misfit(self, chosen: Mapping[str, Term]) -> None:
        """Count as noise what neither the effects chosen nor all others together explain."""
        self.evidence.allow_for_misfit([chosen.get(name, term) for name, (_, term) in self._known.items()])
        self._scored.clear()

    def _tone(self, model: Sequence[Term]) -> ToneFound | None:
        """Return the strongest line beside a model."""
        if len(self._tones) >= _MOST_TONES:
            return None
        return find_tone(self._runs, self._samples, self._slow(model))

    def _slow(self, model: Sequence[Term]) -> list[Floats]:
        """Return what a model says of the blocks of each run (b, m)."""
        posterior = self.evidence.posterior(model)
        own = [c for t in model if not t.shared for c in t.columns]
        shared = [c for t in model if t.shared for c in t.columns]
        predicted = [np.zeros(run.z_rps.shape) for run in self._runs]
        for gyro, mean in zip(self.evidence.gyros, posterior.means, strict=True):
            columns = self._time_columns(gyro, [*range(4), *own, *shared])
            for stretch, part in zip(gyro.stretches, columns, strict=True):
                run = self._runs[stretch.run]
                predicted[stretch.run][stretch.blocks, run.array.names.index(gyro.name)] = part @ mean
        return predicted

    def _time_columns(self, gyro: GyroSpectra, columns: Sequence[int]) -> list[Floats]:
        """Return columns of each stretch back in the time domain, in rad/s."""
        from scipy.fft import idct

        return [
            np.asarray(idct(part[:, columns], axis=0, norm="ortho")) * (gyro.arw / np.sqrt(stretch.length_s))
            for part, stretch in zip(gyro.columns, gyro.stretches, strict=True)
        ]

    def _take(self, tone: ToneFound, probability: float, model: Sequence[Term]) -> None:
        """Take a tone off the samples and off the blocks: from now on all is beside it."""
        fit = fit_tone(tone, self._runs, self._samples, self._slow(model))
        waves = [tone_columns(tone.frequency_hz, run, own) for run, own in zip(self._runs, self._samples, strict=True)]

        def heard(number: int, own: int) -> Floats:
            return waves[number] @ fit.at(self._runs[number].array.names[own], number)[:, None]

        for gyro in self._spectra:
            gyro.subtract(gyro.parts(self._runs, heard))
        self._samples = without_tone(fit, self._samples)
        self.evidence.refresh()
        self._scored.clear()
        candidate = Candidate(
            f"{TONE.name} {tone.frequency_hz:.4f} Hz",
            TONE.effect(frequency_hz=tone.frequency_hz),
            0.0,
            theta=tone.frequency_hz,
            of=lambda frequency_hz: TONE.effect(frequency_hz=frequency_hz),
            unit="Hz",
        )
        self._tones.append(Choice(candidate, Term(candidate.name, (), False), probability, (TONE.name,), tone=fit))

    def _scores(self, terms: Sequence[Term], chosen: Sequence[str]) -> dict[str, tuple[float, Term]]:
        """Return for each candidate not chosen its log evidence with its prior, and its term at its best scale."""
        key = tuple((t.columns, t.scale) for t in terms)
        if key not in self._scored:
            self._scored[key] = self._score(terms)
        return {name: score for name, score in self._scored[key].items() if name not in chosen}

    def _score(self, terms: Sequence[Term]) -> dict[str, tuple[float, Term]]:
        base = Base(self.evidence, terms)
        found = {}
        taken = {t.name for t in terms}
        for name, (candidate, term) in self._known.items():
            if name not in taken and name not in self._barred and not candidate.depends_on:
                value, scaled = base.with_term(term)
                likelier = candidate.likelier if candidate.beside in taken else 0.0
                found[name] = (value + candidate.log_prior + likelier, scaled)
        return found

    def _first(
        self, options: dict[str, float], bare: float, total: float, tone: ToneFound | None
    ) -> tuple[tuple[Candidate, float, float], ...]:
        listed = []
        for name, score in options.items():
            if name == TONE.name:
                assert tone is not None
                candidate = Candidate(TONE.name, TONE.effect(frequency_hz=tone.frequency_hz), 0.0)
            else:
                candidate = self._known[name][0]
            listed.append((candidate, score - bare, float(np.exp(score - total))))
        return tuple(sorted(listed, key=lambda item: -item[2]))

    def _sensible(self, name: str, term: Term, model: Sequence[Term]) -> bool:
        """Return whether an effect came out as something that it can be.

        A lag is as long as the lag that it was worked out for.
        """
        candidate = self._known[name][0]
        steps_s = [run.step_s for run in self._runs if by_turns(run.recording.reference)]
        if candidate.by_size and steps_s and abs(candidate.theta or 0.0) < _RESOLVED * max(steps_s):
            return False  # what happens between two readings of another instrument is not known as well as that
        if candidate.by_size and candidate.theta:
            of_it = self._sizes(candidate, term, model) / abs(candidate.theta)
            return bool(np.abs(np.median(of_it) - 1) < _LOST)
        posterior = self.evidence.posterior([*model, term])
        at = 4 + sum(len(t.columns) for t in model if not t.shared)
        where = slice(-len(term.columns), None) if term.shared else slice(at, at + len(term.columns))
        return candidate.effect.record.plausible(np.array([mean[where] for mean in posterior.means]))

    def _sizes(self, candidate: Candidate, term: Term, model: Sequence[Term]) -> Floats:
        """Return the first parameter of an effect beside a model, by gyro."""
        posterior = self.evidence.posterior([*model, term])
        if term.shared:
            return np.asarray(posterior.means[0][-len(term.columns) :][:1] * candidate.largest[0])
        at = 4 + sum(len(t.columns) for t in model if not t.shared)
        return np.asarray(np.array([mean[at] for mean in posterior.means]) * candidate.largest[0])

    def _exchanged(self, chosen: list[str], terms: dict[str, Term]) -> tuple[list[str], dict[str, Term]]:
        """Try to remove and to exchange each effect, until nothing makes the model more probable."""
        for _ in range(_ROUNDS):
            changed = False
            for name in list(chosen):
                others = [other for other in chosen if other != name]
                kept = [terms[other] for other in others]
                scores = self._scores(kept, others)
                without = self.evidence.of(kept) + _STOP_LOG_PRIOR
                best = max(scores, key=lambda n: scores[n][0])
                terms[name] = scores[name][1]
                if without > scores[best][0]:
                    chosen, changed = others, True
                    break
                if best != name and scores[best][0] > scores[name][0] + 0.1:
                    chosen = [best if n == name else n for n in chosen]
                    terms[best] = scores[best][1]
                    changed = True
                    break
            if not changed:
                break
        return chosen, terms

    def best_of(self, effect: str, chosen: Sequence[Choice]) -> Choice:
        """Return the most probable of the candidates that are called so, beside those chosen."""
        model = [c.term for c in chosen if c.tone is None]
        if effect == TONE.name:
            tone = self._tone(model)
            if tone is None:
                raise InvestigationError("no tone can be looked for in these recordings")
            self._take(tone, 1.0, model)
            return self._tones[-1]
        self._refine(model, [c.candidate.name for c in chosen])
        scores = self._scores(model, [c.candidate.name for c in chosen])
        named = [name for name in scores if self._known[name][0].called == effect]
        if not named:
            raise InvestigationError(f"the catalogue holds no effect {effect} for these recordings")
        best = max(named, key=lambda name: scores[name][0])
        return Choice(self._known[best][0], scores[best][1], 1.0, (effect,))

    def rescaled(self, choices: Sequence[Choice]) -> list[Choice]:
        """Return the same choices, the prior scale of each as is most probable beside the others."""
        done = list(choices)
        for n, choice in enumerate(done):
            if choice.tone is not None:
                continue
            others = [c.term for m, c in enumerate(done) if m != n and c.tone is None]
            _, term = Base(self.evidence, others).with_term(choice.term)
            done[n] = replace(choice, term=term)
        return done

    def copies(self, choice: Choice, terms: Sequence[Term]) -> list[str]:
        """Return the effects that could put out what this one does, within chance, whatever was expected of them."""
        others = [t for t in terms if t.name != choice.candidate.name]
        posterior = self.evidence.posterior(terms)
        base = Base(self.evidence, others)
        best = int(np.argmax(self.evidence.noise_weight(terms)))
        own = [t for t in terms if not t.shared]
        if choice.term.shared:
            return []
        at = 4 + sum(len(t.columns) for t in own[: own.index(choice.term)])
        mine = np.array(choice.term.columns)
        found = []
        for name, (candidate, term) in self._known.items():
            if term.shared or candidate.depends_on or name == choice.candidate.name:
                continue
            theirs = np.array(term.columns)
            left = 0.0
            for gram, mean in zip(base.reduced, posterior.means, strict=True):
                sizes = mean[at : at + len(mine)]
                cross = gram[best][np.ix_(theirs, mine)] @ sizes
                inner = gram[best][np.ix_(theirs, theirs)] + np.eye(len(theirs)) / SCALES[0] ** 2
                left += float(sizes @ gram[best][np.ix_(mine, mine)] @ sizes - cross @ np.linalg.solve(inner, cross))
            if left < _COPIED * len(base.reduced):
                found.append(candidate.called)
        return list(dict.fromkeys(found))

    def sharpness(self, choice: Choice, terms: Sequence[Term]) -> float:
        """Return the standard deviation of what is not linear in an effect, beside the other terms."""
        candidate = choice.candidate
        if candidate.of is None or candidate.theta is None or candidate.start is None:
            return 0.0
        others = [t for t in terms if t.name != candidate.name]
        return self._width(candidate, Scan(self._runs, self._spectra, self.evidence, others, {}))

    def _width(self, candidate: Candidate, scan: Scan) -> float:
        """Return by how much what is not linear may move before half a natural logarithm is lost."""
        assert candidate.theta is not None
        top = scan.gain(candidate)
        step = 0.02 * candidate.theta
        while step < candidate.theta:
            sides = [scan.gain(at(candidate, candidate.theta + sign * step)) for sign in (-1, 1)]
            fall = top - 0.5 * sum(sides)
            if fall > 0.5:
                return float(step / np.sqrt(2 * fall))
            step *= 2
        return float(candidate.theta)

    def _judge(self, name: str, chosen: Sequence[str], terms: dict[str, Term]) -> Choice:
        others = [other for other in chosen if other != name]
        kept = [terms[other] for other in others]
        scores = self._scores(kept, others)
        values = {other: score for other, (score, _) in scores.items()}
        values[""] = self.evidence.of(kept) + _STOP_LOG_PRIOR
        total = np.logaddexp.reduce(list(values.values()))
        shares: dict[str, float] = {}
        candidate = self._known[name][0]
        for other, value in values.items():
            label = self._label(other)
            shares[label] = shares.get(label, 0.0) + float(np.exp(value - total))
        order = sorted(shares, key=lambda label: -shares[label])
        rivals, sum_of = [], 0.0
        for label in order:
            if sum_of >= _SET:
                break
            rivals.append(label)
            sum_of += shares[label]
        share = shares[self._label(name)]
        return Choice(candidate, scores[name][1], share, tuple(rivals), share=share)

    def _label(self, name: str) -> str:
        if not name:
            return "nothing"
        candidate = self._known[name][0]
        return f"depends on {candidate.depends_on}" if candidate.depends_on else candidate.called

    def _columns(self, candidates: Sequence[Candidate], number: int, gyro: int) -> Floats:
        return np.hstack([candidate.columns(self._runs[number], gyro) for candidate in candidates])

    def _tuned(self, candidate: Candidate, scan: Scan) -> Candidate:
        """Return a candidate with the most telling value of what is not linear in it."""
        assert candidate.start is not None
        gains = [scan.gain(at(candidate, theta)) for theta in candidate.start.tolist()]
        best = int(np.argmax(gains))
        low = candidate.start[max(best - 1, 0)]
        high = candidate.start[min(best + 1, len(candidate.start) - 1)]
        theta = highest(lambda theta: scan.gain(at(candidate, theta)), float(low), float(high))
        if scan.gain(at(candidate, theta)) < gains[best]:
            theta = float(candidate.start[best])
        tuned = at(candidate, theta)
        # What it costs that the value was looked for: the share of its range that would do as well.
        width = np.sqrt(2 * np.pi) * self._width(tuned, scan)
        spread = float(candidate.start[-1] - candidate.start[0])
        share = width / spread if candidate.evenly else width / theta / candidate.range_log
        return replace(tuned, log_tries=float(-np.log(np.clip(share, 1e-4, 1.0))))

    def _refine(self, terms: Sequence[Term], chosen: Sequence[str]) -> None:
        """Look for the most telling time constants and instants beside the effects chosen so far."""
        open_ones = [c for c, _ in self._known.values() if c.of is not None and c.name not in chosen and not c.law]
        if not open_ones:
            return
        scan = Scan(self._runs, self._spectra, self.evidence, terms, self._turned)
        renewed = []
        for candidate in open_ones:
            if candidate.start is None or candidate.of is None:
                continue
            if candidate.by_size:
                renewed.append(at(candidate, scan.size(candidate)))
                continue
            renewed.append(self._tuned(candidate, scan))
        self.add(renewed)


def _one_of_many(candidate: Candidate) -> bool:
    """Return whether of an effect one of many is in the model: at some value of what is not linear, or some law."""
    return bool(candidate.law) or (candidate.start is not None and not candidate.by_size)
