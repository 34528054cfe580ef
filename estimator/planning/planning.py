"""The prediction for a motion before it is made: sigmas of the states, smallest effects, similar effects.

All of it is linear algebra on one information matrix a gyro, over the columns [four states | all effects], as the
estimate against a table weighs them but for rounding: means over a second and more under the covariance of coloured
noise, and what happens within these blocks at the weight of their noise there. Each column is scaled by the prior sigma
of its state or the largest plausible size of its effect, so that the prior information is one everywhere.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from estimator.effects.conditions import Conditions
from estimator.effects.effect import Effect
from estimator.geometry.array import SensorArray
from estimator.geometry.kinematics import body_rate
from estimator.geometry.model import Prior, regressor_maps
from estimator.geometry.noise import MeansCovariance, NoiseModel
from estimator.observations.rows import BLOCK_S
from estimator.types import Floats

POWER_SIGMAS = 2.576 + 1.645
"""An effect of so many sigmas is found in 95 % of runs by a test with 1 % of false alarms, two-sided."""
UNSEEN = 0.5
"""A posterior sigma above this share of the prior's: the motion does not show it, as ``calibrate`` says."""
ALIKE = 0.9
"""Correlation above which two effects are listed as not told apart."""
_FINEST_S, _MOST_BLOCKS = 1.0, 200  # of the blocks: the work grows with their third power
_LEAST_SHARE = 1e-12  # of an effect's information: a smaller rest is rounding
_LEADS = 0.1  # a state leads a direction from this share of the largest on; k before b before s_j before s_k
_ROUNDING = 1e-3
_SAME_RATE = 1e-6  # of the largest rate: steady rates closer than this are one condition


@dataclass(frozen=True, slots=True, eq=False)
class PlannedDevice:
    """A device under test: array, noise and data sheet."""

    source: str
    array: SensorArray
    noise: NoiseModel
    prior: Prior


@dataclass(frozen=True, slots=True, eq=False)
class GyroForecast:
    """Predicted sigmas of the states of one gyro (4,), and errors that no sample would show.

    ``unseen`` (c, 4): directions of [k, b, s_j, s_k] that change nothing visible, each with one coefficient of 1.
    """

    source: str
    name: str
    sd: Floats
    prior_sd: Floats
    unseen: Floats


@dataclass(frozen=True, slots=True, eq=False)
class EffectForecast:
    """What the run shows of one effect.

    ``smallest`` (P, g): size of each parameter, in its unit, that is detected in 95 % of runs if it is alone with the
    states; g is the number of gyros, 1 for a shared effect; infinite if the states absorb it. ``shift`` (P, gyros, 4):
    the shift of the states by the largest plausible size of each parameter if the model lacks it, and ``shift_sigmas``
    the same in predicted sigmas.
    """

    effect: Effect
    smallest: Floats
    shift: Floats
    shift_sigmas: Floats

    @property
    def largest(self) -> Floats:
        """Largest plausible size of each parameter (P,)."""
        return self.effect.largest

    @property
    def seen(self) -> NDArray[np.bool_]:
        """Whether each parameter (P, g) would be seen at its largest plausible size."""
        return np.asarray(self.smallest <= self.largest[:, None])


@dataclass(frozen=True, slots=True)
class Pair:
    """Two effects that look alike: the correlation of ``parameter`` of the first with its best copy by the second.

    ``gyro`` is the index, over all devices, of the gyro for which that is so; None if the first effect is shared.
    """

    first: str
    second: str
    correlation: float
    parameter: str
    gyro: int | None


@dataclass(frozen=True, slots=True, eq=False)
class Forecast:
    """The predictions for a planned motion. ``steady_conditions`` counts different rests and rates."""

    gyros: tuple[GyroForecast, ...]
    effects: tuple[EffectForecast, ...]
    pairs: tuple[Pair, ...]
    steady_conditions: int
    saturated: bool


def forecast(conditions: Conditions, devices: Sequence[PlannedDevice], effects: Sequence[Effect] = ()) -> Forecast:
    """Return what a motion will show: sigmas of the states of each gyro, and the smallest visible size of each effect.

    ``conditions`` are those of the motion at N even instants. Gyros come device by device, effects in the order given.
    The forecast also has what each effect shifts the states by, pairs of visible effects that look alike, and whether
    there are too few different rates.
    """
    scales: list[Floats] = []
    names: list[tuple[str, str]] = []
    matrices: list[Floats] = []
    for device in devices:
        matrices += _information(conditions, device, effects)
        scales += [np.sqrt(device.prior.variances())] * len(device.array)
        names += [(device.source, name) for name in device.array.names]
    information, scale = np.stack(matrices), np.stack(scales)
    covariance = np.linalg.inv(information[:, :4, :4] + np.eye(4))
    sd = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    gyros = tuple(
        GyroForecast(source, name, sd[i] * scale[i], scale[i], _unseen(covariance[i], scale[i]))
        for i, (source, name) in enumerate(names)
    )
    cross = information[:, :4, 4:]
    response = covariance @ cross
    left = information[:, 4:, 4:] - cross.transpose(0, 2, 1) @ response
    edges = np.cumsum([0, *(len(effect.parameters) for effect in effects)])
    slices = [slice(start, stop) for start, stop in pairwise(edges.tolist())]
    total = np.diagonal(information[:, 4:, 4:], axis1=1, axis2=2)
    forecasts = tuple(
        _effect_forecast(effect, left[:, own, own], total[:, own], response[:, :, own], scale, sd)
        for effect, own in zip(effects, slices, strict=True)
    )
    count, saturated = _different_steady_states(conditions)
    return Forecast(gyros, forecasts, _imitating_pairs(forecasts, slices, left), count, saturated)


def _information(conditions: Conditions, device: PlannedDevice, effects: Sequence[Effect]) -> list[Floats]:
    """Return the information (4 + E, 4 + E) of each gyro of a device on its 4 states and the E parameters of
    ``effects``.

    States are in units of their prior sigma, parameters in units of their largest plausible size. What is expected of
    them is not included.
    """
    products = weighing(conditions.t_s, conditions.period_s, device.noise)
    regressors = np.column_stack([np.ones(len(conditions.t_s)), conditions.w_rps])
    found = []
    for gyro, gyro_map in enumerate(regressor_maps(device.array)):
        columns = [regressors @ (gyro_map.T * np.sqrt(device.prior.variances()))]
        columns += [effect.columns(conditions, device.array, gyro) * effect.largest for effect in effects]
        found.append(products(np.hstack(columns)))
    return found


def weighing(t_s: Floats, period_s: float, noise: NoiseModel) -> Callable[[Floats], Floats]:
    """Return a function that gives the weighted products (c, c) of columns (N, c) at N even instants, as in the
    estimate.

    Block means are weighted by the inverse of their covariance under ``noise``, deviations from them by the noise
    density there.
    """
    since_s = t_s - t_s[0] + 0.5 * period_s
    length_s = _block_length(float(since_s[-1]))
    number = np.floor(since_s / length_s).astype(np.intp)
    first = np.flatnonzero(np.diff(number, prepend=-1))
    rows = np.diff(np.append(first, len(number)))
    blocks = MeansCovariance.of((number[first] + 0.5) * length_s, length_s, np.minimum(rows * period_s, length_s))
    circle = 2 * np.pi * (0.5 / length_s)  # as in the estimate: the lowest frequency that fits into a block
    density = noise.arw**2 + noise.instability**2 / circle + (noise.walk / circle) ** 2
    inverse = np.asarray(np.linalg.inv(blocks.under(noise)), dtype=np.float64)

    def products(columns: Floats) -> Floats:
        means = np.add.reduceat(columns, first, axis=0) / rows[:, None]
        about = columns - np.repeat(means, rows, axis=0)
        return np.asarray(means.T @ inverse @ means + period_s / density * (about.T @ about))

    return products


def _block_length(duration_s: float) -> float:
    factor = round(_FINEST_S / BLOCK_S)
    while duration_s / (factor * BLOCK_S) > _MOST_BLOCKS:
        factor = int(np.ceil(factor * 1.25))
    return factor * BLOCK_S


def _unseen(covariance: Floats, scale: Floats) -> Floats:
    """Return directions (c, 4) of the states along which the posterior sigma stays above half the prior's."""
    values, vectors = np.linalg.eigh(covariance)
    # Where the scaled covariance has an eigenvalue of 1 the information is 0: an error along it changes nothing.
    rows, leads = _echelon_form(vectors.T[values > UNSEEN**2])
    return np.asarray(rows * scale / scale[leads][:, None])


def _echelon_form(rows: Floats) -> tuple[Floats, list[int]]:
    """Return the same span (c, n) of rows in echelon form, and the leading column of each row.

    A row has 1 in its leading column, and all others have 0 there. That is the first free column with a value of at
    least a tenth of the largest one left. Small values become 0.
    """
    rows = np.array(rows)
    leads: list[int] = []
    for i in range(len(rows)):
        free = [c for c in range(rows.shape[1]) if c not in leads]
        sizes = np.abs(rows[i:][:, free])
        column = free[int(np.argmax(sizes.max(axis=0) > _LEADS * sizes.max()))]
        pivot = i + int(np.argmax(np.abs(rows[i:, column])))
        rows[[i, pivot]] = rows[[pivot, i]]
        rows[i] /= rows[i, column]
        others = np.arange(len(rows)) != i
        rows[others] -= np.outer(rows[others, column], rows[i])
        leads.append(column)
    return np.where(np.abs(rows) > _ROUNDING, rows, 0.0), leads


def _effect_forecast(
    effect: Effect, information: Floats, total: Floats, response: Floats, scale: Floats, sd: Floats
) -> EffectForecast:
    """Return the forecast of an effect with P parameters for g gyros: smallest visible sizes, and shifts of the states.

    ``information`` (g, P, P) is its scaled information with the states eliminated, ``total`` (g, P) the diagonal of its
    own information, ``response`` (g, 4, P) what the scaled states absorb of it, ``scale`` and ``sd`` (g, 4) their units
    and scaled sigmas. Sizes are (P, g), or (P, 1) if all gyros share the effect; shifts are (P, g, 4). A parameter that
    the states absorb has an infinite smallest size.
    """
    kept = np.diagonal(information, axis1=1, axis2=2).T
    alone = total.T
    if effect.shared:
        kept, alone = kept.sum(axis=1, keepdims=True), alone.sum(axis=1, keepdims=True)
    shows = kept > _LEAST_SHARE * alone
    smallest = np.where(shows, POWER_SIGMAS / np.sqrt(np.where(shows, kept, 1.0)), np.inf) * effect.largest[:, None]
    shift = response.transpose(2, 0, 1)
    return EffectForecast(effect, smallest, shift * scale, shift / sd)


def _different_steady_states(conditions: Conditions) -> tuple[int, bool]:
    """Return the number of different rests and steady rates, and whether the states can absorb all of them.

    With no more of these than states that they determine, whatever is constant within each is absorbed, without
    residual. (0, False) if the motion is never steady.
    """
    w = body_rate(conditions.angle_rad, conditions.rate_rps, conditions.gimbals)
    still = ~np.any(conditions.acceleration_rps2, axis=1)
    if not still.any():
        return 0, False
    steps = np.round(w[still] / max(_SAME_RATE * float(np.abs(w).max()), np.finfo(float).tiny))
    levels = np.unique(steps, axis=0)
    rank = int(np.linalg.matrix_rank(np.column_stack([np.ones(len(levels)), levels * _SAME_RATE])))
    return len(levels), len(levels) <= rank


def _imitating_pairs(
    forecasts: Sequence[EffectForecast], slices: Sequence[slice], information: Floats
) -> tuple[Pair, ...]:
    """Return the pairs of visible effects of which one copies a parameter of the other by more than 0.9, worst first.

    ``slices`` are their places in ``information`` (g, E, E), the scaled information of g gyros with the states
    eliminated.
    """
    seen = [(f, own) for f, own in zip(forecasts, slices, strict=True) if f.seen.any()]
    pairs = []
    for number, (a, own_a) in enumerate(seen):
        for b, own_b in seen[number + 1 :]:
            ways = (_share_copied(a, own_a, b, own_b, information), _share_copied(b, own_b, a, own_a, information))
            worst = max(ways, key=lambda pair: pair.correlation)
            if worst.correlation > ALIKE:
                pairs.append(worst)
    return tuple(sorted(pairs, key=lambda pair: -pair.correlation))


def _share_copied(a: EffectForecast, own_a: slice, b: EffectForecast, own_b: slice, information: Floats) -> Pair:
    """Return how well b, at plausible sizes, copies the parameter of a that it copies best, and the number of the gyro
    in which it does, None if all share a.

    ``own_a`` and ``own_b`` are their places in ``information`` (g, E, E), the scaled information of g gyros with the
    states eliminated. The correlation r is that of the information: with b in the model, the sigma of the parameter
    grows by the factor 1 / sqrt(1 - r^2).
    """
    cross, own = information[:, own_a, own_b], information[:, own_b, own_b]
    kept = np.diagonal(information[:, own_a, own_a], axis1=1, axis2=2)
    if b.effect.shared:
        own = np.broadcast_to(own.sum(axis=0), own.shape)
        if a.effect.shared:
            cross, kept, own = cross.sum(axis=0)[None], kept.sum(axis=0)[None], own[:1]
    copied = np.einsum("gab,gba->ga", cross, np.linalg.solve(own + np.eye(own.shape[1]), cross.transpose(0, 2, 1)))
    if a.effect.shared and not b.effect.shared:
        copied, kept = copied.sum(axis=0)[None], kept.sum(axis=0)[None]
    share = np.where(a.seen.T, copied / np.maximum(kept, np.finfo(float).tiny), 0.0)
    gyro, parameter = np.unravel_index(int(np.argmax(share)), share.shape)
    return Pair(
        a.effect.name,
        b.effect.name,
        float(np.sqrt(min(share[gyro, parameter], 1.0))),
        a.effect.parameters[parameter].name,
        None if a.effect.shared else int(gyro),
    )
