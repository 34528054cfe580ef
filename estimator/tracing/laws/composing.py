"""Composed laws that the catalogue does not hold: which ones are tried, and their prior probability.

The grammar is that of ``effects.law``, to a depth of two: a variable or a simple function of one; that through a lag,
or a play, each with one constant to be found; the product of two. Longer laws are the rarer: all laws of one length
together are expected as often as a shorter one less some (Rissanen 1983).
"""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations
from typing import Self

import numpy as np

from estimator.effects.constructed import constructed
from estimator.effects.effect import Effect
from estimator.effects.law import axes_of, needs_of, of_each_gyro
from estimator.estimation.evidence import Term
from estimator.estimation.runs.run import Run
from estimator.packaged import packaged_toml
from estimator.tracing.candidates import Candidate
from estimator.tracing.laws.common_shape import joined, shape_of, shape_of_needed, shaped
from estimator.tracing.laws.flexible import flexible_laws, values_of
from estimator.tracing.laws.needed import needed
from estimator.tracing.option_columns import stacks_of
from estimator.tracing.scan import Scan, at, first_of_best
from estimator.tracing.search import Found, Search
from estimator.types import Floats

Model = Sequence[tuple[Candidate, Term]]

_LARGEST_RPS = float(np.radians(0.5))
_LAW = "law: "  # before the text of a law in the name of its candidate
_RARE = -3.0  # log prior of a law without a name, relative to the catalogue's
_LONGER = -1.5  # of each further element of it
_LAGS_S = np.geomspace(4.0, 400.0, 6)
_SHARES = np.array([0.05, 0.2, 0.5])  # of the range of a variable: start values of plays and bends
_LIMITS = np.array([0.002, 0.02, 0.2])  # of the range of a variable: where its last direction begins to count
_BENDS = np.geomspace(0.001, 0.5, 5)  # of the range of a rate: near standstill as well as over all of it
_STARTS = {"share": _SHARES, "limit": _LIMITS, "bend": _BENDS, "small": _SHARES}
_LARGEST_SCALE = 1e9
_MOST_LAWS, _LAWS_TRIED = 2, 12
_MOST_PRUNED = 6  # terms of a law that are tried to be left out; of more, ``needed`` has left out some
_BETWEEN = 1.3  # factor by which a law may explain more with a constant between its start values
_CLEARLY = 3.0  # natural logarithm by which a law must be the more probable
_TRIES = 9.2  # natural logarithm that the choice of a constant costs at most
_RIVAL = -6.0  # natural logarithm of how much less probable laws may be and still be rivals, a few together
_LAWS = packaged_toml("estimator.tracing.laws", "laws.toml")["length"]


def laws_of(runs: Sequence[Run]) -> list[Candidate]:
    """Return the composed laws that can be tried on runs, as candidates.

    A law with a constant begins at one of several start values. Longer laws have less prior probability, flexible ones
    that of the longest. Laws whose quantities the runs lack, or whose terms do not vary, are left out.
    """
    offers = frozenset.intersection(*(run.grid.offers for run in runs))
    gimbals = runs[0].grid.gimbals if len(runs[0].grid.gimbals) > 1 else ()
    found: list[Candidate] = []
    for length, listed in enumerate(_listed(offers, gimbals), 1):
        prior = _RARE + _LONGER * (length - 1) - float(np.log(max(len(listed), 1)))
        found += [c for law, kind in listed if (c := _candidate(runs, law, kind, prior)) is not None]
    flexible = flexible_laws(runs, offers, runs[0].grid.gimbals)
    prior = _RARE + _LONGER * len(_LAWS) - float(np.log(max(len(flexible), 1)))
    for law, kind in flexible:
        candidate = _candidate(runs, law, kind, prior, whole=False)
        if candidate is not None:
            found.append(replace(candidate, flexible=True, family=candidate.name))
    return found


def _listed(offers: frozenset[str], gimbals: Sequence[str]) -> Iterable[list[tuple[str, str]]]:
    """Yield the laws by length, as pairs (text, kind of the constant {c} in it, "" without one)."""
    for one in _LAWS:
        kinds = [(law, "") for law in one["plain"]]
        kinds += [(law, kind) for kind, texts in one.get("bent", {}).items() for law in texts]
        kinds += [(law, "lag") for law in one.get("without_temperature", ()) if "temperature" not in offers]
        yield [(law, _on_its_axis(kind, law)) for text, kind in kinds for law in _on_axes(text, offers, gimbals)]


def _on_its_axis(kind: str, law: str) -> str:
    """Return the kind of a constant, with the axis of the table that the law is about."""
    return kind.format(axis=axes_of(law.replace("{c}", "1"))[0]) if "{axis}" in kind else kind


def _on_axes(text: str, offers: frozenset[str], gimbals: Sequence[str]) -> list[str]:
    """Return the laws that a text with placeholders gives for the table's axes ``gimbals``.

    ``{axis}`` gives one law for each axis, ``{one}`` and ``{other}`` one for each pair, ``{rates}`` the sum over all
    axes; a text without these is one law. Laws that need quantities which are not in ``offers`` are left out.
    """
    laws = [text]
    if "{one}" in text:
        laws = [text.replace("{one}", one).replace("{other}", other) for one, other in combinations(gimbals, 2)]
    elif "{axis}" in text:
        laws = [text.replace("{axis}", axis) for axis in gimbals]
    elif "{rates}" in text:
        laws = [text.replace("{rates}", "+".join(f"abs(rate_{axis})" for axis in gimbals))] if gimbals else []
    return [law for law in laws if needs_of(law.replace("{c}", "1")) <= offers]


def _candidate(runs: Sequence[Run], law: str, kind: str, prior: float, *, whole: bool = True) -> Candidate | None:
    """Return the candidate of a law, with a search for its constant {c} if ``kind`` is not empty.

    ``kind`` is "lag", or a key of ``_STARTS`` and, after a blank, the variable whose range scales the start values.
    None if a term of the law does not vary in the runs, or the constant has no range. With ``whole`` false the terms
    that do not vary are left out instead; None if none does. ``prior`` is the logarithm of the prior probability.
    """
    start = _LAGS_S
    if kind != "lag":
        what, _, name = kind.partition(" ")
        start = _STARTS[what or "share"] * (_range(runs, name) if name else 0.2)
    if not start[0] > 0:
        return None
    varies = _largest_coefficients(runs, law.format(c=f"{start[1]:.6g}"))
    largest = tuple(size for size in varies if size is not None)
    if not largest or (whole and len(largest) < len(varies)):
        return None
    law = "; ".join(term.strip() for term, size in zip(law.split(";"), varies, strict=True) if size is not None)
    if not kind:
        return Candidate(f"{_LAW}{law}", constructed(law, largest), prior)

    def of(constant: float) -> Effect:
        return constructed(law.format(c=f"{constant:.4g}"), largest)

    range_log = float(np.log(start[-1] / start[0]))
    return Candidate.among(f"{_LAW}{law}", of, start, 1, log_prior=prior, range_log=range_log)


def _largest_coefficients(runs: Sequence[Run], law: str) -> list[float | None]:
    """Return for each term of a law the coefficient at which its largest rms in a run is 0.5 deg/s.

    None for a term that is zero, or not finite, in all runs; a constant one has a coefficient.
    """
    effect = constructed(law)
    squares = np.zeros(len(effect.parameters))
    for run in runs:
        of_run = run.grid.once(("mean squares", law), partial(_mean_squares, run, effect))
        squares = np.maximum(squares, np.nan_to_num(of_run, nan=0.0, posinf=0.0))
    return [_LARGEST_RPS / float(np.sqrt(one)) if one > _LARGEST_SCALE**-2 else None for one in squares]


def _mean_squares(run: Run, effect: Effect) -> Floats:
    """Return the mean squares (p,) of an effect's columns."""
    gyros = range(len(run.array) if of_each_gyro(effect.law) else 1)
    with run.grid.sharing_memories():
        columns = [effect.columns(run.grid, run.array, gyro) for gyro in gyros]
    return np.asarray(np.max([np.einsum("np,np->p", one, one) / len(one) for one in columns], axis=0))


def _form(law: str) -> str:
    """Return a law without its sign and the name of its constant."""
    return re.sub(r"{\w+}", "{}", law.replace(" ", "")).removeprefix("-")


def _without(candidate: Candidate, number: int) -> Candidate:
    """Return a law without one of its terms."""
    return _with_terms(candidate, [n for n in range(len(candidate.effect.parameters)) if n != number])


def _with_terms(candidate: Candidate, numbers: Sequence[int]) -> Candidate:
    """Return a law with the terms of these ``numbers`` alone, for any constant, and the name that goes with it."""

    def shorter(effect: Effect) -> Effect:
        terms = [term.strip() for term in effect.law.split(";")]
        law = "; ".join(terms[n] for n in numbers)
        return constructed(law, tuple(effect.parameters[n].largest for n in numbers))

    of, effect = candidate.of, shorter(candidate.effect)
    name = f"{_LAW}{effect.law}"
    return replace(candidate, name=name, effect=effect, of=None if of is None else lambda value: shorter(of(value)))


def _range(runs: Sequence[Run], name: str) -> float:
    return max(float(np.ptp(one)) for one in values_of(name, runs))


class Composer:
    """Adds composed laws to the result of a search, beside its effects or in the place of some of them."""

    def __init__(self, search: Search, laws: Sequence[Candidate]) -> None:
        """Take the laws; none of them is among the candidates of the search yet.

        A law that an effect with a name has is no rival of it, and is left out.
        """
        self._search = search
        self._several_gyros = len(search.evidence.gyros) > 1
        named = {_form(law) for law in search.named_laws()}
        self._laws = _Tried.of([law for law in laws if _form(law.name.removeprefix(_LAW)) not in named])
        self._coarse = [columns.coarse for columns in search.columns]
        options = [option for law in self._laws for option in law.options]
        self._stacks = stacks_of(self._coarse, search.evidence, options)
        self._kept: set[str] = set()

    def composed(self, found: Found, most: int) -> Found:
        """Return the result of a search with composed laws added where they explain more than named effects do.

        A law may stand beside the effects found or replace some of them; at most ``most`` effects remain in all, two of
        them laws. Terms of laws that do not pay for themselves are removed, and so are effects that "nothing" replaces
        as well. Tones stay. ``log_evidence`` grows by one value. Where no law comes near, the result is ``found``
        itself.
        """
        search = self._search
        named = [part for part in found.parts if part.tone is None]
        tones = [part for part in found.parts if part.tone is not None]
        model = [(part.candidate, part.term) for part in named]
        best = self._worth(model)
        for _ in range(_MOST_LAWS):
            # A law may stand beside the effects found, or replace some of them.
            bases = [model, [], *([pair for pair in model if pair is not one] for one in model)]
            tried = []
            for n, base in enumerate(bases):
                if base not in bases[:n] and len(base) + len(tones) < most:
                    tried.append([*base, *self._best_law(base, model)])
            worths = [self._worth(one) for one in tried]
            if not worths or max(worths) < best + _CLEARLY:
                break
            model = self._search.settled(tried[worths.index(max(worths))])
            best = self._worth(model)
        model = self._of_one_shape(self._pruned(model))
        for one in [pair for pair in model if not pair[0].law]:
            rest = [pair for pair in model if pair is not one]
            self._kept.update(self._likely(rest, model, _RIVAL))
        if not any(candidate.law for candidate, _ in search.known.values()):
            return found
        names, terms = [c.name for c, _ in model], {c.name: term for c, term in model}
        judged = [search.judged(name, names, terms) for name in names]
        while judged and (least := min(judged, key=lambda c: c.share)).rivals[0] == "nothing":  # a law took its place
            names.remove(least.candidate.name)
            del terms[least.candidate.name]
            judged = [search.judged(name, names, terms) for name in names]
        chain = (*found.log_evidence, search.evidence.of(list(terms.values())))
        return replace(found, parts=(*judged, *tones), log_evidence=chain)

    def _pruned(self, model: Model) -> Model:
        """Return a model whose laws have lost each term without which the model is more probable.

        Laws with a single term, or more than ``_MOST_PRUNED``, stay as they are. Shorter laws are added to the search.
        """
        search, best = self._search, self._worth(model)
        pruned = list(model)
        for place, (law, _) in enumerate(model):
            while law.law and 1 < len(law.effect.parameters) <= _MOST_PRUNED:
                shorter = [_without(law, number) for number in range(len(law.effect.parameters))]
                search.add([one for one in shorter if one.name not in search.known])
                rest = [pair for n, pair in enumerate(pruned) if n != place]
                scores = search.scores([term for _, term in rest], [candidate.name for candidate, _ in rest])
                tried = [[*rest[:place], (one, scores[one.name][1]), *rest[place:]] for one in shorter]
                worths = [self._worth(one) for one in tried]
                if max(worths) <= best:
                    break
                best, pruned = max(worths), tried[worths.index(max(worths))]
                law = pruned[place][0]
                self._kept.add(law.name)
        return pruned

    def _of_one_shape(self, model: Model) -> list[tuple[Candidate, Term]]:
        """Return a model whose laws have one shape for all gyros where that is the more probable.

        Tried are all laws as one, then each law of several terms. Laws of one shape are added to the search.
        """
        search, best, chosen = self._search, self._worth(model), list(model)
        if not self._several_gyros:
            return chosen
        called = [candidate.name for candidate, _ in model if candidate.law]
        for names in [*([called] if len(called) > 1 else []), *([name] for name in called)]:
            own = [candidate for candidate, _ in chosen if candidate.name in names]
            rest = [pair for pair in chosen if pair[0].name not in names]
            if len(own) < len(names):
                continue
            candidate = own[0] if len(own) == 1 else joined(own)
            if candidate is None or len(candidate.effect.parameters) < 2:
                continue
            noise = int(np.argmax(search.evidence.noise_weight([term for _, term in chosen])))
            scan = Scan(search.columns, search.evidence, [term for _, term in rest], noise)
            law = shaped(candidate, shape_of(*scan.products(candidate)))
            if law is None:
                continue
            tried = [*rest, search.added_beside(law, rest)]
            if self._worth(tried) > best:
                chosen = search.settled(tried)
                best = self._worth(chosen)
                self._kept.add(law.name)
            else:
                search.forget([law.name])
        return chosen

    def _worth(self, model: Model, noise: int | None = None) -> float:
        """Return the log evidence of a model, under all noise models or one, and how much it was expected."""
        evidence, terms = self._search.evidence, [term for _, term in model]
        expected = sum(candidate.log_prior - term.log_tries for candidate, term in model)
        return (evidence.of(terms) if noise is None else float(evidence.by_noise(terms)[noise])) + expected

    def _best_law(self, base: Model, known: Model) -> Model:
        """Return the law that explains most beside ``base``, as a list of one pair, and keep it in the search.

        Empty if none may explain clearly more than ``known``, or if none that does has a sensible size.
        """
        search, chosen = self._search, self._likely(base, known, _CLEARLY)
        terms = [term for _, term in base]
        scores = search.scores(terms, [candidate.name for candidate, _ in base]) if chosen else {}
        found = [name for name in chosen if search.sensible(name, scores[name][1], terms)]
        best = max(found, key=lambda name: scores[name][0], default=None)
        if best is None:
            return []
        self._kept.add(best)
        return [(search.known[best][0], scores[best][1])]

    def _likely(self, base: Model, known: Model, least: float) -> list[str]:
        """Add to the search the laws that may exceed a model by ``least`` in log evidence; return their names.

        They stand beside ``base``, the model to exceed is ``known``. The noise is the one beside ``known``: beside
        less, the noise would hold what slow laws explain. Constants of the laws are tuned, at most ``_LAWS_TRIED`` laws
        are taken, the most promising first. Laws of an earlier call that are not kept are removed from the search.
        """
        search = self._search
        noise = int(np.argmax(search.evidence.noise_weight([term for _, term in known])))
        scan = Scan(self._coarse, search.evidence, [term for _, term in base], noise)
        taken = {candidate.family or candidate.name for candidate, _ in base}
        missing = self._worth(known, noise) + least - self._worth(base, noise)
        most, at_least = scan.bounds(self._stacks)
        promising: list[_Promising] = []
        for law in (one for one in self._laws if one.candidate.name not in taken):
            gains = most[law.first : law.first + len(law.options)]
            best = first_of_best(gains)
            open_constant = law.candidate.start is not None
            gain, prior = float(gains[best]), law.candidate.log_prior
            reach = gain * (_BETWEEN if open_constant else 1.0) + prior
            # This probability is certain for some law: laws that cannot come near it need no constant.
            floor = float(at_least[law.first + best])
            missing = max(missing, floor + prior - _TRIES * open_constant + _RIVAL)
            promising.append(_Promising(law=law, best=best, worth=gain + prior, reach=reach))
        promising = [one for one in promising if one.reach > missing]
        promising.sort(key=lambda one: -one.worth)
        chosen: list[Candidate] = []
        for one in promising:
            if one.law.candidate.flexible and one.law.candidate.start is not None:
                # Tuning its constant is dear, and in vain if the terms that it needs explain too little by far.
                products = scan.products_of(self._stacks, one.law.first + one.best)
                most_of_terms = max(needed(*products).log_evidence, shape_of_needed(*products).log_evidence)
                if _BETWEEN * most_of_terms + one.law.candidate.log_prior <= missing:
                    continue
            settled, worth = self._settled(scan, one)
            if worth > missing:  # with all its terms a flexible law seems to be worth more than it is
                chosen.append(settled)
            if len(chosen) == _LAWS_TRIED:
                break
        search.forget([name for name, (c, _) in search.known.items() if c.law and name not in self._kept])
        search.add([law for law in chosen if law.name not in self._kept])
        return [law.name for law in chosen]

    def _settled(self, scan: Scan, promising: "_Promising") -> tuple[Candidate, float]:
        """Return a law with its best constant, a flexible one with the terms that are needed, and its worth at most.

        The worth is what it adds to the log evidence, with its prior and the cost of the choice; inf for laws that are
        not flexible.
        """
        number, law = promising.law.first + promising.best, promising.law.options[promising.best]
        tuned = law if law.start is None else scan.tuned(law, promising.best)
        if not law.flexible:
            return tuned, float("inf")
        products = scan.products_of(self._stacks, number) if tuned is law else scan.products(tuned)
        free, shape = needed(*products), shape_of_needed(*products)
        settled = replace(_with_terms(tuned, free.terms), log_choices=free.log_tries)
        worth = free.worth + tuned.log_prior - tuned.log_tries
        if shape.worth > free.worth and self._several_gyros and len(shape.terms) > 1:
            of_shape = shaped(_with_terms(tuned, shape.terms), shape)
            if of_shape is not None:
                return of_shape, shape.worth + tuned.log_prior - tuned.log_tries
        return settled, worth


@dataclass(frozen=True, slots=True, eq=False)
class _Tried:
    """A law with the ``options`` that it is tried with: one for each start value of its constant.

    ``first`` is the number of the first option among those of all laws.
    """

    candidate: Candidate
    options: Sequence[Candidate]
    first: int

    @classmethod
    def of(cls, laws: Sequence[Candidate]) -> list[Self]:
        """Return laws with their options; one without start values is its only option."""
        found: list[Self] = []
        first = 0
        for law in laws:
            options = [law] if law.start is None else [at(law, theta) for theta in law.start.tolist()]
            found.append(cls(law, options, first))
            first += len(options)
        return found


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class _Promising:
    """A law that may explain enough, the number of its ``best`` option, and what that is worth, its prior included.

    ``reach`` is what the law may be worth at most.
    """

    law: _Tried
    best: int
    worth: float
    reach: float
