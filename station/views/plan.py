"""A plan for display: which sizes of effects its run detects, and which effects would pass for errors of the states."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from drivers.types import Floats
from estimator.effects.constructed import readable
from estimator.planning.planning import EffectForecast, Forecast
from station.views.figures import StateUnit, shown_unit

MARKED = 1.0
"""Shifts of the states below so many of their sigmas are not worth a word."""
_STATES = ("k", "b", "sigma_j", "sigma_k")


@dataclass(kw_only=True, frozen=True, slots=True)
class DetectableSizes:
    """Sizes at which a run detects the parameters of an effect that have one unit, in this unit.

    ``least`` to ``most`` are the smallest sizes of those ``detected`` out of ``count``, None if none is detected. Each
    gyro counts for itself. ``largest`` is the largest plausible size. Parameters without ``has_influence`` do not
    change the states either.
    """

    effect: str
    unit: str
    least: float | None
    most: float | None
    detected: int
    count: int
    has_influence: bool
    largest: float


@dataclass(kw_only=True, frozen=True, slots=True)
class Shift:
    """A shift of a state of one gyro, in the unit of the state, and in predicted sigmas."""

    gyro: str
    size: float
    sigmas: float


@dataclass(kw_only=True, frozen=True, slots=True)
class StateShifts:
    """The marked shifts of one state."""

    state: str
    unit: str
    shifts: tuple[Shift, ...]


@dataclass(kw_only=True, frozen=True, slots=True)
class HiddenEffect:
    """An effect that would pass unnoticed for errors of the states, by the parameter that shifts them most.

    ``largest`` is the plausible size of the parameter in ``unit``, ``others`` the number of other parameters of the
    effect that matter.
    """

    effect: str
    parameter: str
    largest: float
    unit: str
    others: int
    shown_by: str
    states: tuple[StateShifts, ...]


def detectable_sizes(forecast: EffectForecast) -> Iterator[DetectableSizes]:
    """Yield the sizes at which an effect is detected, one record for each SI unit of its parameters, in the unit shown.

    All parameters of one unit and all gyros are counted together. ``least`` and ``most`` are None if none of them is
    detected at its largest plausible size. Nothing is yielded for an effect without parameters.
    """
    parameters = forecast.effect.parameters
    for si_unit in dict.fromkeys(parameter.unit for parameter in parameters):
        rows = [row for row, parameter in enumerate(parameters) if parameter.unit == si_unit]
        unit, factor = shown_unit(si_unit)
        seen = forecast.seen[rows]
        sizes = forecast.smallest[rows][seen] * factor
        yield DetectableSizes(
            effect=readable(forecast.effect.name),
            unit=unit,
            least=float(sizes.min()) if sizes.size else None,
            most=float(sizes.max()) if sizes.size else None,
            detected=int(seen.sum()),
            count=int(seen.size),
            has_influence=bool(forecast.shift[rows].any()),
            largest=float(forecast.largest[rows].max() * factor),
        )


def hidden_effects(forecast: Forecast, figures: tuple[StateUnit, ...]) -> list[HiddenEffect]:
    """Return the effects with an unseen parameter that shifts a state by ``MARKED`` sigmas, each with its worst
    parameter.

    Parameters have their largest plausible size. The number of other such parameters is given with an effect;
    ``figures`` are the units that shifts are given in.
    """
    gyros = [gyro.name for gyro in forecast.gyros]
    hidden = []
    for found in forecast.effects:
        if not found.effect.parameters:  # that of how axes lie to each other, on a table of one
            continue
        sigmas = unnoticed(found)
        largest = sigmas.max(axis=(1, 2), initial=0.0)
        worst = int(np.argmax(largest))
        if largest[worst] < MARKED:
            continue
        parameter = found.effect.parameters[worst]
        unit, factor = shown_unit(parameter.unit)
        hidden.append(
            HiddenEffect(
                effect=readable(found.effect.name),
                parameter=parameter.name,
                largest=parameter.largest * factor,
                unit=unit,
                others=int(np.sum(largest >= MARKED)) - 1,
                shown_by=found.effect.record.shown_by,
                states=tuple(_state_shifts(found.shift[worst], sigmas[worst], gyros, figures)),
            )
        )
    return hidden


def _state_shifts(
    shift: Floats, sigmas: Floats, gyros: list[str], figures: tuple[StateUnit, ...]
) -> Iterator[StateShifts]:
    """Yield by state the shifts of at least ``MARKED`` sigmas, in the units of ``figures``; none for other states.

    ``shift`` (gyros, 4) is in SI, ``sigmas`` (gyros, 4) in sigmas without a sign; ``gyros`` are their names.
    """
    for state, figure in enumerate(figures):
        shifts = [
            Shift(gyro=gyro, size=float(shift[row, state] * figure.factor), sigmas=float(sigmas[row, state]))
            for row, gyro in enumerate(gyros)
        ]
        marked = tuple(one for one in shifts if one.sigmas >= MARKED)
        if marked:
            yield StateShifts(state=figure.name, unit=figure.unit, shifts=marked)


def unnoticed(forecast: EffectForecast) -> Floats:
    """Return by how many sigmas each parameter shifts the states (P, gyros, 4); 0 where the parameter is seen."""
    # A gyro whose own parameter is seen is not corrupted unnoticed; a shared one is unseen by all or none.
    return np.where(forecast.seen[:, :, None], 0.0, np.abs(forecast.shift_sigmas))


def combination(direction: Floats) -> str:
    """Return a direction (4,) of the states in words, such as "k + 0.58 sigma_j"; a bias in it is in rad/s.

    A factor has three digits; factors of 1 and parts that are 0 are left out, so that a direction of zeros gives "".
    """
    text = ""
    for value, name in zip(direction, _STATES, strict=True):
        if value == 0:
            continue
        size = "" if math.isclose(abs(value), 1.0, rel_tol=5e-4) else f"{abs(value):.3g} "
        text += f"{_sign(value, first=not text)}{size}{name}"
    return text


def _sign(value: float, *, first: bool) -> str:
    """Return the sign before a term of a sum; the first term has none if it is positive."""
    if first:
        return "-" if value < 0 else ""
    return " - " if value < 0 else " + "
