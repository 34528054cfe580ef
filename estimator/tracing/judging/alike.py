"""Laws that predict the same: which of them acts does not matter for what is compensated."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from estimator.estimation.runs.run import Run, with_gyro
from estimator.tracing.augmented import Augmented, Part
from estimator.tracing.judging.expected import expected_squares
from estimator.tracing.search import CERTAIN, Search


def with_alike_laws(search: Search, parts: Sequence[Part], held_back: Sequence[Run]) -> list[Part]:
    """Return the parts, with the share of each law in doubt raised by those of rival laws that predict the same.

    A law without a name says no more than what it predicts. Two predict the same if their predictions of the runs
    ``held_back`` differ by less than the error that the covariance of one lets expect. Such rivals are listed in
    ``alike`` and are no rivals any more; the probability grows as the share does. Effects with names, tones, and laws
    that are certain among their rivals stay as they are; so does everything without runs held back.
    """
    if not held_back:
        return list(parts)
    return [_with_alike(search, parts, part, held_back) if _in_doubt(part) else part for part in parts]


def _in_doubt(part: Part) -> bool:
    return part.tone is None and bool(part.candidate.law) and 0 < part.share < CERTAIN


def _with_alike(search: Search, parts: Sequence[Part], part: Part, held_back: Sequence[Run]) -> Part:
    """Return a law with the shares of its rivals that predict the same added to its own, and its probability raised as
    much; these are listed in ``alike`` and are no rivals then.
    """
    others = [one for one in parts if one is not part and one.tone is None]
    terms, names = [one.term for one in others], [one.candidate.name for one in others]
    scores, shares = search.scores(terms, names), search.shares_beside(terms, names)
    own = Augmented.of(search.evidence, [part, *others])
    allowed = expected_squares(held_back, len(search.runs), own)
    share = part.share
    alike = []
    for label in part.rivals:
        of_label = [name for name in scores if search.known[name][0].label == label and search.known[name][0].law]
        if label == part.candidate.label or not of_label:
            continue
        best = max(of_label, key=lambda name: scores[name][0])
        rival = replace(part, candidate=search.known[best][0], term=scores[best][1])
        if _difference(held_back, len(search.runs), own, Augmented.of(search.evidence, [rival, *others])) < allowed:
            share += shares[label]
            alike.append(label)
    share = min(share, 1.0)
    return replace(
        part,
        probability=part.probability * share / part.share,
        share=share,
        rivals=tuple(label for label in part.rivals if label not in alike),
        alike=tuple(alike),
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
