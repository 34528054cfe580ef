"""What an investigation says of the next devices of the same type."""

from collections.abc import Sequence

import numpy as np

from estimator.calibration.error_model import ErrorModel, KnownEffect, KnownForceEffect, Size
from estimator.effects.catalogue import record_of
from estimator.effects.effect import Settings
from estimator.tracing.accelerometers.trace_forces import ForceFinding, FoundEffect
from estimator.tracing.augmented import Augmented, Part
from estimator.types import Floats

_NEXT = 1.5  # the next gyros may be this much worse than the examined ones
_SAME = 0.05  # share by which errors caused by table, site or clock may differ on another day


def error_model_of(found: Augmented) -> ErrorModel:
    """Return the error model of a device type that the estimate of one device gives.

    Effects that each gyro has to itself get mean zero and 1.5 times the rms over the gyros (their sigmas included),
    since the next gyros have other signs. Effects that all gyros share get the estimate, with 1.5 times its sigma and a
    twentieth of its size. Effects not in the catalogue, or not kept in a model, are left out with a reason. Of two of
    the same name the larger one stays.
    """
    effects: dict[str, KnownEffect] = {}
    left_out = {}
    for part in found.effects:
        name = part.candidate.called
        record = part.candidate.effect.record
        if record_of(name) is None:
            left_out[name] = "not an effect of the catalogue"
        elif record.not_kept:
            left_out[name] = record.not_kept
        else:
            known = _known_effect(found, part)
            # A drift since the start of each run and one since the first are the same in one run.
            other = effects.get(known.called, known)
            effects[known.called] = max(known, other, key=lambda effect: float(effect.sd.sum()))
    return ErrorModel(tuple(effects.values()), left_out)


def force_effects_of(findings: Sequence[ForceFinding]) -> tuple[KnownForceEffect, ...]:
    """Return the effects that were added to accelerometers, as the next device of the type is expected to have them.

    Their size is 1.5 times the rms over the accelerometers of all sources (their sigmas included), as the next ones
    have other signs.
    """
    every: dict[str, list[tuple[ForceFinding, FoundEffect]]] = {}
    for finding in findings:
        for found in finding.effects:
            every.setdefault(found.effect.name, []).append((finding, found))
    return tuple(_known_force_effect(name, found) for name, found in every.items())


def _known_force_effect(name: str, found: Sequence[tuple[ForceFinding, FoundEffect]]) -> KnownForceEffect:
    """Return an effect of accelerometers with its expected size, and the values found by "SOURCE NAME" of the
    accelerometer: value and sigma of each parameter.
    """
    effect = found[0][1].effect
    squares = np.concatenate([one.values**2 + one.sd**2 for _, one in found])
    sd = _NEXT * np.sqrt(squares.mean(axis=0))
    sizes = zip(effect.parameters, sd.tolist(), strict=True)
    return KnownForceEffect(
        name=name,
        sizes=tuple(Size(parameter, effect.unit, 0.0, size) for parameter, size in sizes),
        found={
            f"{finding.source} {who}": _pairs(values, sigmas)
            for finding, one in found
            for who, values, sigmas in zip(finding.names, one.values, one.sd, strict=True)
        },
    )


def _known_effect(found: Augmented, part: Part) -> KnownEffect:
    """Return an effect of the estimate ``found`` with its expected sizes, its settings and the values found by gyro.

    If all gyros share it, it is expected as estimated; else with mean zero and the rms over gyros. Values are pairs of
    value and sigma, by gyro or "all gyros"; of a tone in each run only those of the first.
    """
    effect, p = part.candidate.effect, len(part.candidate.effect.parameters)
    where = found.slice_of(part.candidate.name)
    largest = part.candidate.effect.largest
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
        if effect.record.any_phase:
            squares = np.full(p, squares.mean())
        sd = _NEXT * np.sqrt(squares)
        of_gyros = {n: _pairs(v[0], s[0]) for n, v, s in zip(found.names, values, sigmas, strict=True)}
    expected = zip(effect.parameters, mean.tolist(), sd.tolist(), strict=True)
    sizes = tuple(Size(parameter.name, parameter.unit, m, s) for parameter, m, s in expected)
    return KnownEffect(part.candidate.called, part.term.shared, sizes, _fixing_settings(part), of_gyros)


def _pairs(values: Floats, sigmas: Floats) -> tuple[tuple[float, float], ...]:
    return tuple(zip(values.tolist(), sigmas.tolist(), strict=True))


def _fixing_settings(part: Part) -> Settings:
    """Return the settings that fix an effect in a model file.

    They are those of its candidate, else its law, else its nonlinear parameter where the effect keeps that; may be
    empty.
    """
    candidate = part.candidate
    if candidate.settings:
        return candidate.settings
    if candidate.law:
        return {"law": candidate.law}
    kept = candidate.effect.record.kept_settings
    return {setting.key: float(candidate.theta) for setting in kept if candidate.theta is not None}
