"""One shape for all gyros: a law of several terms of which the gyros differ by one size each.

Gyros of one type have the same mechanism, so what it makes of a temperature or of an angle has one shape, and each gyro
its size. A law of p terms then has p - 1 numbers of its shape and one size a gyro in place of p numbers a gyro: the
matrix of its coefficients has rank one. Where the gyros differ, the free coefficients are the more probable.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from estimator.effects.constructed import constructed
from estimator.effects.effect import Effect
from estimator.effects.law import LawError
from estimator.estimation.evidence import SCALES
from estimator.tracing.candidates import Candidate
from estimator.tracing.laws.needed import Needed, log_choices
from estimator.types import Floats

_ROUNDS = 200
_STILL = 1e-5  # change of a shape of length 1 at which it is found


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class Shape(Needed):
    """Shape of a law: its terms, and ``along`` (p,), of length 1, by how much of each.

    ``log_tries`` holds the share of all shapes that would do, too; it is that alone if the terms were not chosen.
    """

    along: Floats


def shape_of(products: Floats, with_rest: Floats) -> Shape:
    """Return the most probable shape of a law of p terms.

    ``products`` (gyros, p, p) are those of the columns of its terms, ``with_rest`` (gyros, p) those with what is to be
    explained, both beside the rest of the model and over the noise. The columns are scaled to the largest plausible
    coefficients. The sizes are expected to be as they are on average; all shapes are as probable.
    """
    along, sizes, variance, scale = _fitted(products, with_rest)
    beside = products - np.einsum("g,gi,gj->gij", variance, products @ along, products @ along)
    across = others(along)
    known = across.T @ np.tensordot(sizes**2, beside, 1) @ across
    return Shape(
        terms=tuple(range(len(along))),
        along=along,
        log_evidence=0.5 * float(np.sum((with_rest @ along) ** 2 * variance + np.log(variance / scale**2))),
        log_tries=0.5 * float(np.linalg.slogdet(np.eye(len(known)) + known)[1]),
    )


def shape_of_needed(products: Floats, with_rest: Floats) -> Shape:
    """Return the most probable shape of those terms of a law that the data need, as ``shape_of`` does for all terms.

    With the sizes of the shape of all terms the shape is linear, so that terms are cheaply left out: that which is
    known worst again and again. Of all choices of terms the most probable counts.
    """
    count = products.shape[1]
    sizes = _fitted(products, with_rest)[1]
    inner, across = np.tensordot(sizes**2, products, 1) + np.eye(count), sizes @ with_rest
    terms = np.arange(count)
    choices = []
    while len(terms):
        covariance = np.linalg.inv(inner[np.ix_(terms, terms)])
        numbers = covariance @ across[terms]
        log_evidence = 0.5 * float(across[terms] @ numbers + np.linalg.slogdet(covariance)[1])
        choices.append((log_evidence - log_choices(count, len(terms)), terms))
        terms = np.delete(terms, np.argmin(numbers**2 / np.diag(covariance)))
    chosen = max(choices, key=lambda choice: choice[0])[1]
    shape = shape_of(products[:, chosen[:, None], chosen], with_rest[:, chosen])
    log_tries = shape.log_tries + log_choices(count, len(chosen))
    return replace(shape, terms=tuple(chosen.tolist()), log_tries=log_tries)


def _fitted(products: Floats, with_rest: Floats) -> tuple[Floats, Floats, Floats, float]:
    """Return the shape (p,) of length 1, the sizes (gyros,) of it, their variances (gyros,) and what is expected of
    them.

    Sizes and shape are found in turn, each beside the other.
    """
    count = products.shape[1]
    free = np.linalg.solve(products + np.eye(count), with_rest[..., None])[..., 0]
    along, scale = np.linalg.svd(free, full_matrices=False)[2][0], 1.0
    for _ in range(_ROUNDS):
        before = along
        sizes, variance = _sizes(products, with_rest, along, scale)
        expected = sizes**2 + variance
        scale = float(np.clip(np.sqrt(expected.mean()), SCALES[-1], SCALES[0]))
        along = np.linalg.solve(np.tensordot(expected, products, 1) + np.eye(count), sizes @ with_rest)
        along /= np.linalg.norm(along)
        if np.abs(along - before).max() < _STILL:
            break
    return along, *_sizes(products, with_rest, along, scale), scale


def others(along: Floats) -> Floats:
    """Return orthonormal directions (p, p - 1) at right angles to ``along`` (p,), which has length 1.

    They need not be the same for ``along`` and its opposite.
    """
    return np.asarray(np.linalg.svd(along[None])[2][1:].T)


def _sizes(products: Floats, with_rest: Floats, along: Floats, scale: float) -> tuple[Floats, Floats]:
    """Return the sizes (gyros,) of a shape that are expected to be ``scale``, and their variances (gyros,)."""
    variance = 1 / (products @ along @ along + 1 / scale**2)
    return variance * (with_rest @ along), variance


def shaped(candidate: Candidate, shape: Shape) -> Candidate | None:
    """Return a law of one term: the p terms of a law, each times its number in a shape, and their sum.

    Its constant stays open. None if the text would be longer than a law may be, at any start value of the constant.
    """

    def of_one_term(effect: Effect) -> Effect:
        factors = shape.along * effect.largest
        largest = float(np.abs(factors).max())
        terms = zip((factors / largest).tolist(), effect.law.split(";"), strict=True)
        return constructed("+".join(f"({factor:.6g})*({term.strip()})" for factor, term in terms), (largest,))

    of = candidate.of
    try:
        effect = of_one_term(candidate.effect)
        if of is not None and candidate.start is not None:
            for value in candidate.start.tolist():
                of_one_term(of(value))
    except LawError:
        return None
    return replace(
        candidate,
        name=f"{candidate.name} of one shape",
        effect=effect,
        of=None if of is None else lambda value: of_one_term(of(value)),
        log_choices=candidate.log_choices + shape.log_tries,
        pieces=candidate,
        along=tuple(shape.along.tolist()),
    )


def joined(laws: Sequence[Candidate]) -> Candidate | None:
    """Return one law with the terms of several, as one of the same prior probability as all; its constant stays open.

    None if a law is of one shape already, if several have a constant, or if the text would be longer than a law may be.
    """
    tuned = [law for law in laws if law.of is not None]
    if len(tuned) > 1 or any(law.pieces is not None for law in laws):
        return None

    def with_terms_of(effects: Sequence[Effect]) -> Effect:
        largest = tuple(parameter.largest for effect in effects for parameter in effect.parameters)
        return constructed("; ".join(effect.law for effect in effects), largest)

    def of(value: float) -> Effect:
        return with_terms_of([law.of(value) if law.of is not None else law.effect for law in laws])

    try:
        effect = with_terms_of([law.effect for law in laws])
        for value in tuned[0].start.tolist() if tuned and tuned[0].start is not None else ():
            of(value)
    except LawError:
        return None
    return replace(
        tuned[0] if tuned else laws[0],
        name=" and ".join(law.name for law in laws),
        effect=effect,
        of=of if tuned else None,
        log_prior=sum(law.log_prior for law in laws),
        log_tries=sum(law.log_tries for law in laws),
        log_choices=sum(law.log_choices for law in laws),
        flexible=any(law.flexible for law in laws),
        family="",
    )
