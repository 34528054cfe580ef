"""Which effects a model lacks: one is added at a time, and each is tried to be removed or exchanged again."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from estimator.effects.disturbances import TONE
from estimator.estimation.evidence import SCALES, Base, Evidence, Term
from estimator.estimation.runs.run import with_gyro
from estimator.tracing.augmented import Part
from estimator.tracing.candidates import Candidate
from estimator.tracing.investigation import Suspect
from estimator.tracing.run_columns import RunColumns, of_gyro
from estimator.tracing.scan import Scan
from estimator.tracing.tones.tone_search import Heard
from estimator.types import Floats

CERTAIN = 0.95
"""Posterior probability from which an effect counts as found."""
_SET = 0.99  # rivals are as many as share this probability
_ROUNDS = 12
_ROOM = 32  # columns for which room is made at once
_STOP_LOG_PRIOR = 0.0  # nothing more: as likely as all effects together, several times over
_LOST = 0.3  # share by which the size of a lag may differ from that of its columns
_UNEXCITED = 0.5  # sigmas of an effect of the largest plausible size, all gyros and runs together
_COPIED = 9.0  # squares over noise that a copy of an effect leaves in a gyro, within chance
_RICH = 0.1  # scale of all effects at once, when the possible noise is determined
_SETTLED = 3  # rounds in which constants are tuned beside each other
_RISEN = 0.02  # natural logarithm by which a better constant must explain more
_RESOLVED = 0.1  # of the time between readings: shorter delays are not distinguished from interpolation errors


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """Result of a search: effects, log evidence after each addition, and the suspects of the first round."""

    parts: tuple[Part, ...]
    log_evidence: tuple[float, ...]
    suspects: tuple[Suspect, ...]

    @property
    def terms(self) -> list[Term]:
        """Terms of the model."""
        return [part.term for part in self.parts]

    def with_parts(self, old: Sequence[Part], new: Sequence[Part]) -> Self:
        """Return the result with the effects ``new`` in the places of the effects ``old``, one for one; others stay."""
        places = {one.candidate.name: other for one, other in zip(old, new, strict=True)}
        return replace(self, parts=tuple(places.get(part.candidate.name, part) for part in self.parts))


class Search:
    """A search over candidates on the spectra of some runs.

    ``known`` are the candidates by name, each with its term; ``heard`` are the tones found.
    """

    def __init__(self, columns: Sequence[RunColumns], evidence: Evidence) -> None:
        """Begin without candidates on the runs of ``columns``; ``add`` adds candidates."""
        self.columns, self.runs, self.evidence = list(columns), [one.run for one in columns], evidence
        self.known: dict[str, tuple[Candidate, Term]] = {}
        self.heard = Heard(self.runs, evidence)
        self._scored: dict[tuple[tuple[tuple[int, ...], float], ...], dict[str, tuple[float, Term]]] = {}
        self._barred: set[str] = set()
        self._free: list[int] = []
        self._narrowed = False

    def add(self, candidates: Sequence[Candidate]) -> None:
        """Add candidates and compute their columns for every gyro; those of known names are replaced. Does nothing
        without candidates.

        The first call also limits the noise models to those that matter.
        """
        if not candidates:
            return
        self._scored.clear()
        for candidate, columns in zip(candidates, self._put(candidates), strict=True):
            tries = candidate.log_tries + candidate.log_choices
            term = Term(candidate.name, columns, candidate.effect.shared, log_tries=tries)
            self.known[candidate.name] = (candidate, term)
        if not self._narrowed:
            self._narrowed = True
            rich = [term.scaled(_RICH) for c, term in self.known.values() if not c.depends_on and not term.shared]
            self.evidence.narrow([[], rich])

    def spread_term(self, candidate: Candidate, term: Term) -> Term:
        """Return the term of the spread of a term's tuned numbers, which all gyros share; it is no candidate."""
        (columns,) = self._put([candidate])
        return Term(candidate.name, columns, shared=True, part_of=term.name)

    def _put(self, candidates: Sequence[Candidate]) -> list[tuple[int, ...]]:
        """Compute the columns of candidates for every gyro; return the numbers of these by candidate."""
        widths = [len(candidate.effect.parameters) for candidate in candidates]
        numbers = self._numbers(sum(widths))
        of_runs = [
            [columns.of(candidate, keep=not candidate.law) for candidate in candidates] for columns in self.columns
        ]
        for gyro in self.evidence.gyros:
            parts = [np.vstack([of_gyro(one, i) for one in of_runs[n]]) for n, _, i in with_gyro(self.runs, gyro.name)]
            ends = np.cumsum([len(stretch.band) for stretch in gyro.stretches])
            gyro.put(numbers, np.split(np.hstack(parts).T, ends[:-1]))
        return [tuple(own.tolist()) for own in np.split(numbers, np.cumsum(widths)[:-1])]

    def _numbers(self, count: int) -> NDArray[np.intp]:
        """Return ``count`` unused column numbers, which then count as used; make room if there are too few."""
        if count > len(self._free):
            first = self.evidence.gyros[0].columns[0].shape[1]
            last = first + max(count - len(self._free), _ROOM)
            self._free += range(first, last)
            for gyro in self.evidence.gyros:
                gyro.widen(last)
        taken, self._free = self._free[:count], self._free[count:]
        return np.array(taken, dtype=np.intp)

    def named_laws(self) -> set[str]:
        """Return the laws, with settings in braces, of the effects with a name that each gyro may have here.

        Barred effects are left out: the size that they seem to have is one that a law without a name may have.
        """
        named = (candidate for name, (candidate, _) in self.known.items() if name not in self._barred)
        return {one.effect.record.law for one in named if not (one.law or one.depends_on or one.effect.shared)}

    def forget(self, names: Sequence[str]) -> None:
        """Leave some candidates out from now on; columns of laws among them are free for others."""
        self._free += [c for name in names if self.known[name][0].law for c in self.known[name][1].columns]
        self.known = {name: pair for name, pair in self.known.items() if name not in names}
        self._scored.clear()

    def leave_out_unexcited(self) -> list[Candidate]:
        """Remove the candidates that would not show even at their largest plausible size; return them.

        Such an effect changes all runs by less than half a sigma of noise, all gyros together.
        """
        out = []
        for candidate, term in self.known.values():
            columns = np.array(term.columns, dtype=np.intp)
            squares = self.evidence.gram(columns, columns)[:, 0]  # (gyros, p), under the first noise model
            if len(columns) and float(squares.max(axis=1).sum()) < _UNEXCITED**2:
                out.append(candidate)
        self.forget([candidate.name for candidate in out])
        return out

    def run(self, most: int, progress: Callable[[float], None] | None = None) -> Found:
        """Return a probable model of at most ``most`` effects, tones included; ``progress`` is called with the share
        done.

        In each round the most probable candidate or tone is added, and after that the model's effects are exchanged
        where that helps. The search goes on only while "no more effects" has a probability of at most 5 %, the model is
        not full, and at most twelve rounds. A candidate whose fitted size it cannot have is barred, which takes a
        round. A tone is subtracted from the data. The suspects are those of the first round, or of the first after
        rounds that only barred candidates.
        """
        chosen: list[str] = []
        terms: dict[str, Term] = {}
        suspects: tuple[Suspect, ...] = ()
        chain = [self.evidence.of([])]
        tones = 0.0  # their contribution to the log evidence
        for turn in range(_ROUNDS):
            model = [terms[name] for name in chosen]
            self._refine(model, chosen)
            self._allow_for_misfit(terms)
            bare = self.evidence.of(model)
            chain[-1] = bare + tones
            scores = self.scores(model, chosen)
            tone = self.heard.strongest(model)
            options = {"": bare + _STOP_LOG_PRIOR} | {name: score for name, (score, _) in scores.items()}
            if tone is not None:
                prior = max((candidate.log_prior for candidate, _ in self.known.values()), default=_STOP_LOG_PRIOR)
                options[TONE.name] = options[""] + tone.log_evidence + prior
            total = float(np.logaddexp.reduce(list(options.values())))
            suspects = suspects or self._suspects(options, chain[0])
            best = max((name for name in options if name), key=lambda name: options[name], default="")
            if progress is not None:
                progress(min((turn + 1) / (most + 2), 1.0))
            full = len(chosen) + len(self.heard.parts) >= most
            if not best or np.exp(options[""] - total) > 1 - CERTAIN or full:
                break
            if best == TONE.name:
                assert tone is not None
                tones += tone.log_evidence
                self.heard.take(tone, float(np.exp(options[best] - total)), model)
                self._scored.clear()
            elif self.sensible(best, scores[best][1], model):
                chosen.append(best)
                terms[best] = scores[best][1]
            else:
                self._barred.add(best)
                self._scored.clear()
                if not chosen and not self.heard.parts:
                    suspects = ()  # an impossible effect is no suspect
                continue
            chosen, terms = self._exchanged(chosen, terms)
            terms = {c.name: term for c, term in self.settled([(self.known[name][0], terms[name]) for name in chosen])}
            chain.append(self.evidence.of([terms[name] for name in chosen]) + tones)
        parts = [*(self.judged(name, chosen, terms) for name in chosen), *self.heard.parts]
        return Found(tuple(parts), tuple(chain), suspects)

    def _allow_for_misfit(self, chosen: Mapping[str, Term]) -> None:
        """Count as noise what neither the chosen effects nor all others together explain."""
        self.evidence.allow_for_misfit([chosen.get(name, term) for name, (_, term) in self.known.items()])
        self._scored.clear()

    def scores(self, terms: Sequence[Term], chosen: Sequence[str]) -> dict[str, tuple[float, Term]]:
        """Return for each candidate not chosen its log evidence with its prior, and its term at its best scale."""
        key = tuple((t.columns, t.scale) for t in terms)
        if key not in self._scored:
            self._scored[key] = self._score(terms)
        return {name: score for name, score in self._scored[key].items() if name not in chosen}

    def _score(self, terms: Sequence[Term]) -> dict[str, tuple[float, Term]]:
        """Return by name the log evidence, with its log prior, of ``terms`` with each candidate added, and its scaled
        term.

        Candidates that are in the model, barred, or general dependences are left out. The prior of a candidate is
        raised if the effect that it goes with is in the model.
        """
        taken = {t.name for t in terms}
        tried = {
            name: (candidate, term)
            for name, (candidate, term) in self.known.items()
            if name not in taken and name not in self._barred and not candidate.depends_on
        }
        base = Base(self.evidence, terms, [column for _, term in tried.values() for column in term.columns])
        scores = base.with_each([term for _, term in tried.values()])
        found = {}
        for (name, (candidate, _)), (value, scaled) in zip(tried.items(), scores, strict=True):
            likelier = candidate.likelier if candidate.beside in taken else 0.0
            found[name] = (value + candidate.log_prior + likelier, scaled)
        return found

    def _suspects(self, options: Mapping[str, float], bare: float) -> tuple[Suspect, ...]:
        """Return the effects by name with their probability and gain in log evidence, most probable first.

        ``options`` are log evidences by candidate, "" for no effect, which is listed too; ``bare`` is that without
        effects.
        """
        most: dict[str, float] = {}
        for name, value in options.items():
            label = self._label(name)
            most[label] = max(most.get(label, -np.inf), value - bare if name else 0.0)
        found = [Suspect(label, most[label], share) for label, share in self._shares(options).items()]
        return tuple(sorted(found, key=lambda s: -s.probability))

    def sensible(self, name: str, term: Term, model: Sequence[Term]) -> bool:
        """Return whether the size of an effect, fitted beside ``model``, is one that it can have.

        The size of a delay or lag must agree with the one for which its columns were computed; a delay must be longer
        than the time between readings of another instrument can hide. Others must be plausible by their record.
        """
        candidate = self.known[name][0]
        steps_s = [run.step_s for run in self.runs if run.recording.reference.by_turns]
        if candidate.by_size and steps_s and abs(candidate.theta or 0.0) < _RESOLVED * max(steps_s):
            return False  # the motion between two readings of another instrument is not known well enough
        sizes = self.evidence.posterior([*model, term]).of(term)
        if candidate.by_size and candidate.theta:
            of_it = sizes[:, 0] * candidate.effect.largest[0] / abs(candidate.theta)
            return bool(np.abs(np.median(of_it) - 1) < _LOST)
        return candidate.effect.record.plausible(sizes)

    def _exchanged(self, chosen: list[str], terms: dict[str, Term]) -> tuple[list[str], dict[str, Term]]:
        """Return the effects and terms after each was removed or exchanged wherever that makes the model more probable.

        It goes on until nothing changes, but not without end: at most twelve changes. ``terms`` is changed in place.
        """
        for _ in range(_ROUNDS):
            changed = False
            for name in list(chosen):
                others = [other for other in chosen if other != name]
                kept = [terms[other] for other in others]
                scores = self.scores(kept, others)
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

    def copies(self, part: Part, terms: Sequence[Term]) -> list[str]:
        """Return the effects that could give the same output as this one within chance, whatever their prior is.

        They have their names among rivals; laws of its own variables are not listed. ``terms`` are those of the model.
        Empty for shared effects and tones; these and general dependences are no copies.
        """
        if part.term.shared or part.tone is not None:
            return []
        best = int(np.argmax(self.evidence.noise_weight(terms)))
        sizes = self.evidence.posterior(terms).of(part.term)[:, :, None]  # (gyros, p, 1)
        others = [
            (candidate, term)
            for name, (candidate, term) in self.known.items()
            if not (term.shared or candidate.depends_on or name == part.candidate.name)
        ]
        asked = [*part.term.columns, *(column for _, term in others for column in term.columns)]
        kept = [t for t in terms if t.name != part.candidate.name]
        base = Base(self.evidence.under(best), kept, asked)

        def products(one: Term, other: Term) -> Floats:
            columns = (np.array([term.columns], dtype=np.intp) for term in (one, other))
            return base.products(*columns)[:, 0, 0]

        mine = (sizes.swapaxes(1, 2) @ products(part.term, part.term) @ sizes).sum()
        found = []
        for candidate, term in others:
            cross = products(term, part.term) @ sizes
            inner = products(term, term) + np.eye(len(term.columns)) / SCALES[0] ** 2
            left = mine - (cross.swapaxes(1, 2) @ np.linalg.solve(inner, cross)).sum()
            if left < _COPIED * len(sizes) and candidate.label != part.candidate.label:
                found.append(candidate.label)
        return list(dict.fromkeys(found))

    def sharpness(self, part: Part, terms: Sequence[Term]) -> float:
        """Return the standard deviation of an effect's nonlinear parameter beside the other effects of a model.

        ``terms`` are those of the whole model, under whose most probable noise it is worked out.
        """
        others = [t for t in terms if t.name != part.candidate.name]
        noise = int(np.argmax(self.evidence.noise_weight([*others, part.term])))
        return Scan(self.columns, self.evidence, others, noise).width(part.candidate)

    def judged(self, name: str, chosen: Sequence[str], terms: Mapping[str, Term]) -> Part:
        """Return an effect of a model with its probability and its rivals, computed beside the model's other effects.

        ``chosen`` are the names of all effects of the model, ``terms`` theirs. Rivals are as many as share 99 % of the
        probability, most probable first; they may hold the effect itself, and "nothing" for no effect.
        """
        others = [other for other in chosen if other != name]
        kept = [terms[other] for other in others]
        scores, shares = self.scores(kept, others), self.shares_beside(kept, others)
        order = sorted(shares, key=lambda label: -shares[label])
        before = np.cumsum([0.0, *(shares[label] for label in order[:-1])])
        rivals = tuple(label for label, sum_of in zip(order, before.tolist(), strict=True) if sum_of < _SET)
        share = shares[self._label(name)]
        return Part(self.known[name][0], scores[name][1], share, rivals, share=share)

    def shares_beside(self, terms: Sequence[Term], chosen: Sequence[str]) -> dict[str, float]:
        """Return the probabilities, by name in results, of what may be added to a model, "nothing" among it.

        ``terms`` are those of the model's effects, ``chosen`` their names.
        """
        values = {name: score for name, (score, _) in self.scores(terms, chosen).items()}
        return self._shares(values | {"": self.evidence.of(terms) + _STOP_LOG_PRIOR})

    def _shares(self, values: Mapping[str, float]) -> dict[str, float]:
        """Return the probabilities by name in results; candidates with the same name there are added.

        ``values`` are log evidences by candidate, "" for no further effect.
        """
        total = np.logaddexp.reduce(list(values.values()))
        shares: dict[str, float] = {}
        for name, value in values.items():
            label = self._label(name)
            shares[label] = shares.get(label, 0.0) + float(np.exp(value - total))
        return shares

    def _label(self, name: str) -> str:
        if name == TONE.name:
            return name
        return self.known[name][0].label if name else "nothing"

    def added_beside(self, candidate: Candidate, model: Sequence[tuple[Candidate, Term]]) -> tuple[Candidate, Term]:
        """Add a candidate; return it with its term at the best scale beside the effects of a model."""
        self.add([candidate])
        scores = self.scores([term for _, term in model], [other.name for other, _ in model])
        return candidate, scores[candidate.name][1]

    def settled(self, model: Sequence[tuple[Candidate, Term]]) -> list[tuple[Candidate, Term]]:
        """Return the effects of a model with their constants tuned beside each other; the candidates known change too.

        The noise is the one most probable with the whole model: constants that were tuned before an effect was in the
        model were found under a noise that held what it explains. Sizes of delays and tones stay as they are.
        """
        settled = list(model)
        for _ in range(_SETTLED):
            moved = False
            for place, (candidate, term) in enumerate(settled):
                if candidate.start is None or candidate.by_size:
                    continue
                others = [pair for pair in settled if pair[0] is not candidate]
                noise = int(np.argmax(self.evidence.noise_weight([term for _, term in settled])))
                scan = Scan(self.columns, self.evidence, [term for _, term in others], noise)
                tuned = scan.tuned(candidate)
                if scan.gain(tuned) < scan.gain(candidate) + _RISEN:
                    continue
                settled[place] = self.added_beside(tuned, others)
                moved = True
            if not moved:
                break
        return settled

    def _refine(self, terms: Sequence[Term], chosen: Sequence[str]) -> None:
        """Tune time constants, instants and other nonlinear parameters beside the effects chosen so far."""
        open_ones = [c for c, _ in self.known.values() if c.start is not None and c.name not in chosen and not c.law]
        if open_ones:
            scan = Scan(self.columns, self.evidence, terms)
            self.add([scan.tuned(candidate) for candidate in open_ones])
