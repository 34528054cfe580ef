"""States averaged over effects that may act beside the model, and differences between runs, with honest sigmas."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from estimator.estimation.evidence import Term
from estimator.estimation.repeatability import between_runs
from estimator.geometry.model import decode
from estimator.sensors.gyros import GYRO
from estimator.tracing.augmented import Augmented, Part
from estimator.tracing.investigation import GyroErrors
from estimator.tracing.judging.cross_validation import by_run
from estimator.tracing.open_world import OpenWorld, unnamed
from estimator.tracing.search import CERTAIN, Search
from estimator.types import Floats

_MOST_SETS = 40
_MATTERS = 1e-2  # share of the probability below which an alternative is not averaged over

_SHOWN = {"1": (1e6, "ppm"), "rad/s": (float(np.degrees(3600)), "deg/h"), "rad": (1e3, "mrad")}


def between_recordings(search: Search, terms: Sequence[Term]) -> Floats:
    """Return the standard deviation (4,) of the states from recording to recording, beside the effects ``terms``.

    Zero where it may be chance, with fewer than two complete recordings, or if the noise holds a turn-on bias that
    already allows for it.
    """
    evidence = search.evidence
    weight = evidence.noise_weight(terms) * (evidence.shapes.turn_on == 0)  # else runs are expected to differ
    alone = [part for part in by_run(evidence, search.runs) if all(gyro.stretches for gyro in part.gyros)]
    if len(alone) < 2 or not weight.any():
        return np.zeros(4)
    found = [part.posterior(terms, weight / weight.sum()) for part in alone]
    means = np.array([[mean[:4] for mean in one.means] for one in found])
    variances = np.array([[np.diag(c)[:4] for c in one.covariances] for one in found])
    return between_runs(means, np.sqrt(variances))


def between_notes(between: Floats) -> list[str]:
    """Return one sentence on the states that differ from run to run, or an empty list if none does.

    ``between`` (4,) are the standard deviations of the states between runs, in SI, 0 where a state does not differ.
    """
    told = []
    for state, size in zip(GYRO.states, between.tolist(), strict=True):
        factor, unit = _SHOWN[state.unit]
        if size:
            told.append(f"{state.symbol} differs by {size * factor:.2g} {unit}")
    return [f"{', '.join(told)} from run to run. The sigmas include this variation"] if told else []


def averaged(
    search: Search,
    gyros: Sequence[GyroErrors],
    after: Augmented,
    parts: Sequence[Part],
    opened: OpenWorld,
    between: Floats,
) -> tuple[GyroErrors, ...]:
    """Return the errors of gyros with their states averaged over the alternatives, and sigmas that cover these.

    Alternatives are rivals of the effects ``parts`` and effects without a name, whose probability is in ``opened``;
    improbable ones are left out. ``after`` is the model of the gyros' errors. ``between`` (4,) is the standard
    deviation of the states between runs, which the sigmas include. Only states after, their sigmas and ``moved``
    change. Tones are no alternatives.
    """
    closed = np.log1p(-min(opened.probability, 1 - 1e-12))
    sets = [(terms, value + closed) for terms, value in _alternatives(search, parts)]
    sure = [term for part in parts if part.probability >= CERTAIN for term in part.terms]
    if opened.probability > 0:  # not so without any function of measured values
        share = opened.by_size - np.logaddexp.reduce(opened.by_size) + np.log(max(opened.probability, 1e-30))
        base = np.logaddexp.reduce([value for _, value in sets]) - closed
        sets += [([*sure, term], base + w) for term, w in zip(unnamed(search), share, strict=True)]
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


def beside_suspect(gyros: Sequence[GyroErrors], with_it: Augmented) -> tuple[GyroErrors, ...]:
    """Return the errors of ``gyros`` with states that are the mean of the model's and those of ``with_it``, with a
    suspect.

    Both are equally probable; the sigmas cover both, and ``moved`` changes with the states. It applies if the
    verification run shows an error that the other recordings cannot.
    """
    known = []
    for gyro in gyros:
        g = with_it.names.index(gyro.name)
        states, covariance = decode(with_it.mean[g, :4], with_it.covariance[g, :4, :4])
        mean = (gyro.states_after + states) / 2
        variance = (gyro.sd_after**2 + np.diag(covariance)) / 2 + ((gyro.states_after - states) / 2) ** 2
        moved = gyro.moved + (mean - gyro.states_after) / gyro.sd_before
        known.append(replace(gyro, states_after=mean, moved=moved, sd_after=np.sqrt(variance)))
    return tuple(known)


def _alternatives(search: Search, parts: Sequence[Part]) -> list[tuple[list[Term], float]]:
    """Return the sets of terms that may be true, each with its log evidence plus log prior; tones are left out.

    Effects that are certain are in all; for each other effect a set has nothing, the effect, or one of its rivals. At
    most ``_MOST_SETS`` are returned, the first ones.
    """
    kept = [c for c in parts if c.tone is None and c.probability >= CERTAIN]
    sets = [kept]
    for part in (c for c in parts if c.tone is None and c.probability < CERTAIN):
        scores = search.scores([c.term for c in kept], [c.candidate.name for c in kept])
        rivals = [name for name in scores if search.known[name][0].label in part.rivals]
        swapped = [replace(part, candidate=search.known[name][0], term=scores[name][1], spread=None) for name in rivals]
        sets = [[*own, *more] for own in sets for more in ([], *([one] for one in [part, *swapped]))][:_MOST_SETS]
    found = []
    for own in sets:
        parts_of_set = {c.candidate.name: c for c in own}.values()
        prior = sum(c.candidate.log_prior for c in own if c not in kept)
        value = search.evidence.of([c.term for c in parts_of_set]) + prior
        found.append(([term for c in parts_of_set for term in c.terms], value))
    return found
