"""Laws that predict the same: which of them acts does not matter for what is compensated."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from estimator.estimation.runs.run import Run, with_gyro
from estimator.tracing.augmented import Augmented, Part
from estimator.tracing.candidates import Candidate
from estimator.tracing.judging.expected import expected_squares
from estimator.tracing.search import CERTAIN, Search


def with_alike_laws(search: Search, parts: Sequence[Part], held_back: Sequence[Run]) -> list[Part]:
    """Return the parts, with the share of each effect in doubt raised by those of rivals that predict the same.

    A law without a name says no more than what it predicts. Two predict the same if their predictions of the runs
    ``held_back`` differ by less than the error that the covariance of one lets expect. Such rivals are listed in
    ``alike`` and are no rivals any more; the probability grows as the share does. An effect with a name of which a law
    is such a rival becomes that law: what it is called remains open, and what it predicts does not. Effects without
    other rivals, shared effects, delays and tones stay as they are; so does everything without runs held back.
    """
    if not held_back:
        return list(parts)
    found = list(parts)
    for number, part in enumerate(parts):
        if _in_doubt(part):
            found[number] = _with_alike(search, found, part, held_back)
    return found


def _in_doubt(part: Part) -> bool:
    return part.tone is None and _of_one_gyro(part.candidate) and 0 < part.share < CERTAIN


def _of_one_gyro(candidate: Candidate) -> bool:
    """Return whether an effect acts in the gyros themselves, so that nothing but its prediction matters for them."""
    return not (candidate.effect.shared or candidate.by_size or candidate.depends_on)


def _with_alike(search: Search, parts: Sequence[Part], part: Part, held_back: Sequence[Run]) -> Part:
    """Return an effect with the shares of its rivals that predict the same added to its own, and its probability raised
    as much; these are listed in ``alike`` and are no rivals then.

    An effect with a name is replaced by the most probable law among these; without any it stays as it is.
    """
    others = [one for one in parts if one is not part and one.tone is None]
    terms, names = [one.term for one in others], [one.candidate.name for one in others]
    scores, shares = search.scores(terms, names), search.shares_beside(terms, names)
    own = Augmented.of(search.evidence, [part, *others])
    allowed = expected_squares(held_back, len(search.runs), own)
    alike: list[Part] = []
    for label in part.rivals:
        of_label = [name for name in scores if search.known[name][0].label == label]
        if label == part.candidate.label or not of_label:
            continue
        best = max(of_label, key=lambda name: scores[name][0])
        rival = replace(part, candidate=search.known[best][0], term=scores[best][1], share=shares[label])
        if not _of_one_gyro(rival.candidate):
            continue
        if _difference(held_back, len(search.runs), own, Augmented.of(search.evidence, [rival, *others])) < allowed:
            alike.append(rival)
    laws = [one for one in [part, *alike] if one.candidate.law]
    if not laws:
        return part
    share = min(sum(one.share for one in [part, *alike]), 1.0)
    stated = part if part.candidate.law else max(laws, key=lambda one: one.share)
    labels = [one.candidate.label for one in [part, *alike] if one is not stated]
    return replace(
        part,
        candidate=stated.candidate,
        term=stated.term,
        probability=part.probability * share / part.share,
        share=share,
        rivals=tuple(label for label in part.rivals if label not in labels),
        alike=tuple(labels),
    )


def _difference(runs: Sequence[Run], first: int, one: Augmented, other: Augmented) -> float:
    """Return the squared difference of two predictions of runs, (rad/s)^2, over all blocks with weight and gyros.

    ``first`` is the number of the first run among all.
    """
    squares = 0.0
    for name in one.names:
        for number, run, gyro in with_gyro(runs, name):
            said, otherwise = (model.predict(run, first + number, gyro)[0] for model in (one, other))
            squares += float(np.sum((said - otherwise)[run.weight > 0] ** 2))
    return squares
