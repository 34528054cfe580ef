"""What an investigation says of the next devices of the same type."""

from __future__ import annotations

import numpy as np

from estimator.calibration.error_model import MAKERS, SETTINGS, ErrorModel, KnownEffect, Size
from estimator.effects.constructed import NAME as CONSTRUCTED
from estimator.tracing.augmented import Augmented, Part
from estimator.types import Floats

_NEXT = 1.5  # the next gyros may be this much worse than those that were looked at
_SAME = 0.05  # share by which what has its cause in table, site or clock may differ on another day
_ANY_PHASE = frozenset({"tone", "table_harmonic"})  # cosine and sine are of one size: it is the phase that differs

_WHY_NOT = {
    "bias_step": "it happened once, in one recording",
    "reference_lag": "it is the reference that lags, not the gyros",
}


def error_model_of(found: Augmented) -> ErrorModel:
    """Return what the estimate of one device says of its type.

    Sizes of effects that each gyro has to itself: mean zero, 1.5 times the rms over the gyros, since the next
    gyros have other signs. Of effects that all gyros share: the value found, with 1.5 times its sigma and 5 %.
    """
    effects: dict[str, KnownEffect] = {}
    left_out = {}
    for number, part in enumerate(found.parts):
        name = part.candidate.called
        if name in MAKERS:
            known = _known(found, part, found.slice_of(number))
            # A drift since the start of each run and one since the first are the same in one run.
            other = effects.get(known.called, known)
            effects[known.called] = max(known, other, key=lambda effect: float(effect.sd.sum()))
        else:
            left_out[name] = _WHY_NOT.get(name, "it is not an effect of the catalogue")
    return ErrorModel(tuple(effects.values()), left_out)


def _known(found: Augmented, part: Part, where: slice) -> KnownEffect:
    effect, p = part.candidate.effect, len(part.candidate.effect.parameters)
    largest = part.candidate.largest
    # A tone whose phase differs from run to run has its parameters once for each run.
    values = found.mean[:, where].reshape(len(found.names), -1, p) * largest
    sigmas = np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2))[:, where].reshape(values.shape) * largest
    if part.term.shared:
        mean = values[0, 0]
        sd = np.hypot(_NEXT * sigmas[0, 0], _SAME * mean)
        of_gyros = {"all gyros": _pairs(values[0, 0], sigmas[0, 0])}
    else:
        mean = np.zeros(p)
        squares = (values**2 + sigmas**2).mean(axis=(0, 1))
        if effect.name in _ANY_PHASE:
            squares = np.full(p, squares.mean())
        sd = _NEXT * np.sqrt(squares)
        of_gyros = {n: _pairs(v[0], s[0]) for n, v, s in zip(found.names, values, sigmas, strict=True)}
    expected = zip(effect.parameters, mean.tolist(), sd.tolist(), strict=True)
    sizes = tuple(Size(parameter.name, parameter.unit, m, s) for parameter, m, s in expected)
    return KnownEffect(part.candidate.called, part.term.shared, sizes, _settings_of(part), of_gyros)


def _pairs(values: Floats, sigmas: Floats) -> tuple[tuple[float, float], ...]:
    return tuple(zip(values.tolist(), sigmas.tolist(), strict=True))


def _settings_of(part: Part) -> dict[str, float | int | str]:
    name, theta = part.candidate.called, part.candidate.theta
    if name == "table_harmonic":
        order, axis = part.candidate.name.split()[1:]
        return {"axis": axis, "order": int(order)}
    if name == CONSTRUCTED:
        return {"law": part.candidate.law}
    return {key: float(theta) for key in SETTINGS.get(name, ()) if theta is not None}
