"""The answer of `station plan`, as --json prints it and as the screen reads it back.

SI units; None for a number that is infinite or not known. States are by name.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from estimator.observations.coverage import AxisCoverage
from estimator.planning.planning import EffectForecast, Forecast, Pair
from station.opening.planned_forces import PlannedForces
from station.opening.planned_mountings import PlannedMountings
from station.scripts.plan import WARMING_TIME_S, Plan
from station.scripts.script import Timed
from station.views.accelerometers.planned import (
    PlannedAccelerometer,
    PlannedForcesView,
    planned_accelerometer,
    planned_forces_view,
)
from station.views.json_values import by_state, json_object
from station.views.typed_json import view_of

States = Mapping[str, float | None]
Span = tuple[float, float]


@dataclass(kw_only=True, frozen=True, slots=True)
class PlannedStep:
    """A step of a script. Its last turn is about ``axis`` at ``rate_rps``, None without one.

    It takes ``duration_s``, or up to ``longest_s`` if that is not known in advance; None if there is no limit.
    """

    label: str
    duration_s: float
    longest_s: float | None
    axis: str | None
    rate_rps: float | None


@dataclass(kw_only=True, frozen=True, slots=True)
class PlannedGyro:
    """Predicted standard deviations of the states of a gyro, the table's uncertainty included."""

    device: str
    name: str
    sd: States


@dataclass(kw_only=True, frozen=True, slots=True)
class PlannedMountingsView:
    """Predicted standard deviations of a device from runs with x, y and z along the one axis of a table, joined."""

    device: str
    gyros: tuple[PlannedGyro, ...]
    accelerometers: tuple[PlannedAccelerometer, ...]


@dataclass(kw_only=True, frozen=True, slots=True)
class JudgedGyro(PlannedGyro):
    """A planned gyro beside what the bench requires.

    ``sd_table`` is the table's part of ``sd``. ``reached``: no state has more than its required standard deviation.
    ``unseen`` are directions of the states that the script does not show.
    """

    sd_table: States
    reached: bool
    unseen: tuple[States, ...]


@dataclass(kw_only=True, frozen=True, slots=True)
class PlannedAxis:
    """Whether turns about an axis, early and late, would show a drift; see ``AxisCoverage``. Times since the start."""

    axis: str
    proved: bool
    covered_s: Span | None
    not_proved_s: tuple[Span, ...]
    length_s: float
    concerns: tuple[str, ...]


@dataclass(kw_only=True, frozen=True, slots=True)
class PlannedShift:
    """By how much an effect of the largest plausible size shifts the states of a gyro, in SI and in their sigmas."""

    gyro: str
    k: float | None
    b_rps: float | None
    sigma_j_rad: float | None
    sigma_k_rad: float | None
    sigmas: States


@dataclass(kw_only=True, frozen=True, slots=True)
class PlannedParameter:
    """What a script shows of a parameter of an effect; ``largest`` is its largest plausible size, in ``unit``.

    ``smallest`` is the size that is detected in 95 % of runs, by gyro, or for "all". ``seen``: every gyro would show
    the largest size.
    """

    name: str
    unit: str
    largest: float
    smallest: Mapping[str, float | None]
    seen: bool
    shift_of_largest: tuple[PlannedShift, ...]


@dataclass(kw_only=True, frozen=True, slots=True)
class PlannedEffect:
    """What a script shows of an effect; ``shared`` by all gyros, or each has its own. ``shown_by`` is in words."""

    name: str
    shared: bool
    shown_by: str
    parameters: tuple[PlannedParameter, ...]


@dataclass(kw_only=True, frozen=True, slots=True)
class PlannedPair:
    """Two effects that a script can hardly tell apart, by which parameter, for one gyro or (None) for all."""

    effects: tuple[str, str]
    correlation: float
    parameter: str
    gyro: str | None


@dataclass(kw_only=True, frozen=True, slots=True)
class Assumed:
    """What a prediction of thermal effects assumes: the bench warms up by so much, with this time constant."""

    temperature_rise_k: float
    warming_time_s: float


@dataclass(kw_only=True, frozen=True, slots=True)
class EarlyLateView:
    """A script of the same length that turns each axis early and late."""

    script: str
    duration_s: float
    steps: tuple[PlannedStep, ...]
    gyros: tuple[PlannedGyro, ...]
    constancy: tuple[PlannedAxis, ...]


@dataclass(kw_only=True, frozen=True, slots=True)
class PlanView:
    """What a script will show on a bench. ``reached``: nothing misses a required standard deviation.

    ``steady_conditions`` counts different rests and rates, ``saturated``: a rate is beyond the range of a gyro.
    ``version`` counts changes of the JSON object that break its readers.
    """

    version: int = 1
    script: str
    duration_s: float
    longest_s: float | None
    steps: tuple[PlannedStep, ...]
    reached: bool
    required: States
    gyros: tuple[JudgedGyro, ...]
    steady_conditions: int
    saturated: bool
    constancy: tuple[PlannedAxis, ...]
    effects: tuple[PlannedEffect, ...]
    alike: tuple[PlannedPair, ...]
    assumed: Assumed
    early_late: EarlyLateView | None = None
    accelerometers: tuple[PlannedForcesView, ...] = ()
    mountings: tuple[PlannedMountingsView, ...] = ()

    @property
    def missed(self) -> list[str]:
        """Names of the gyros, accelerometers and lever arms that do not reach the required standard deviations."""
        gyros = [gyro.name for gyro in self.gyros if not gyro.reached]
        return [*gyros, *(name for device in self.accelerometers for name in device.missed)]

    @property
    def accelerometer_sds(self) -> list[tuple[str, States]]:
        """Name and standard deviations of each accelerometer; with several devices, the name begins with the device."""
        several = len(self.accelerometers) > 1
        return [
            (f"{device.device} {one.name}" if several else one.name, one.sd)
            for device in self.accelerometers
            for one in device.accelerometers
        ]


def plan_view_of(data: Mapping[str, Any]) -> PlanView:
    """Return the answer in an object of JSON; KeyError, TypeError or ValueError if it is none."""
    view = view_of(PlanView, data)
    if not view.gyros:
        raise ValueError("a plan without gyros")
    return view


def plan_view(
    plan: Plan,
    *,
    early_late: Plan | None = None,
    forces: Sequence[PlannedForces] = (),
    mountings: Sequence[PlannedMountings] = (),
) -> PlanView:
    """Return the view of a plan.

    ``early_late`` is the plan of the script that turns each axis early and late, ``forces`` are the forecasts for
    accelerometers by device, ``mountings`` those for three mountings joined; their parts of the view are None or empty
    without. Infinite numbers become None.
    """
    forecast, limits = plan.forecast, plan.bench.limits.forces
    least_s, most_s = plan.script.span.least_s, plan.script.span.most_s
    return PlanView(
        script=plan.script.name,
        duration_s=least_s,
        longest_s=_finite(most_s),
        steps=_steps(plan),
        reached=bool(plan.reached.all()) and not any(one.missed(limits) for one in forces),
        required=by_state(plan.required),
        gyros=_judged_gyros(plan),
        steady_conditions=forecast.steady_conditions,
        saturated=forecast.saturated,
        constancy=tuple(map(_axis, plan.constancy)),
        effects=tuple(_effect(effect, forecast) for effect in forecast.effects),
        alike=tuple(_pair(pair, forecast) for pair in forecast.pairs),
        assumed=Assumed(temperature_rise_k=plan.temperature_rise_k, warming_time_s=WARMING_TIME_S),
        early_late=None if early_late is None else early_late_view(early_late),
        accelerometers=tuple(planned_forces_view(one, limits) for one in forces),
        mountings=tuple(map(_mountings_view, mountings)),
    )


def _mountings_view(planned: PlannedMountings) -> PlannedMountingsView:
    """Return the predicted sigmas in SI of a device's three mountings joined, by gyro and accelerometer.

    Without accelerometers there are only gyros.
    """
    return PlannedMountingsView(
        device=planned.device,
        gyros=tuple(
            PlannedGyro(device=planned.device, name=gyro.name, sd=by_state(gyro.sd))
            for gyro in planned.calibration.gyros
        ),
        accelerometers=tuple(
            planned_accelerometer(one) for force in planned.calibration.forces for one in force.accelerometers
        ),
    )


def early_late_view(plan: Plan) -> EarlyLateView:
    """Return the view of the plan of a script that turns each axis early and late; its duration is the shortest."""
    return EarlyLateView(
        script=plan.script.name,
        duration_s=plan.script.least_s,
        steps=_steps(plan),
        gyros=planned_gyros(plan),
        constancy=tuple(map(_axis, plan.constancy)),
    )


def planned_gyros(plan: Plan) -> tuple[PlannedGyro, ...]:
    """Return the predicted standard deviations of each gyro."""
    gyros = zip(plan.forecast.gyros, plan.sd, strict=True)
    return tuple(PlannedGyro(device=gyro.source, name=gyro.name, sd=by_state(sd)) for gyro, sd in gyros)


def _judged_gyros(plan: Plan) -> tuple[JudgedGyro, ...]:
    """Return for each gyro the predicted sigmas, the part of the table, and whether all required ones are reached.

    With them are the directions of the states that the script does not show.
    """
    rows = zip(plan.forecast.gyros, plan.sd, plan.table_sd, plan.reached, strict=True)
    return tuple(
        JudgedGyro(
            device=gyro.source,
            name=gyro.name,
            sd=by_state(sd),
            sd_table=by_state(table),
            reached=bool(reached.all()),
            unseen=tuple(by_state(direction) for direction in gyro.unseen),
        )
        for gyro, sd, table, reached in rows
    )


def _steps(plan: Plan) -> tuple[PlannedStep, ...]:
    return tuple(_step(timed) for timed in plan.script.timeline())


def _step(timed: Timed) -> PlannedStep:
    """Return the view of a step with its shortest and longest duration, and axis and rate of its last turn.

    The longest is None if it has no end, axis and rate are None without a turn.
    """
    turn = timed.last_turn
    return PlannedStep(
        label=timed.step.label,
        duration_s=timed.span.least_s,
        longest_s=_finite(timed.span.most_s),
        axis=None if turn is None else turn.axis,
        rate_rps=None if turn is None else turn.rate_rps,
    )


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _axis(axis: AxisCoverage) -> PlannedAxis:
    """Return the view of whether turns about an axis, early and late, would show a drift."""
    return PlannedAxis(
        axis=axis.axis,
        proved=axis.proved,
        covered_s=axis.covered_s,
        not_proved_s=tuple(axis.not_proved_s),
        length_s=axis.length_s,
        concerns=tuple(axis.concerns),
    )


def _pair(pair: Pair, forecast: Forecast) -> PlannedPair:
    return PlannedPair(
        effects=(pair.first, pair.second),
        correlation=pair.correlation,
        parameter=pair.parameter,
        gyro=None if pair.gyro is None else forecast.gyros[pair.gyro].name,
    )


def _effect(effect: EffectForecast, forecast: Forecast) -> PlannedEffect:
    return PlannedEffect(
        name=effect.effect.name,
        shared=effect.effect.shared,
        shown_by=effect.effect.record.shown_by,
        parameters=tuple(_parameter(effect, row, forecast) for row in range(len(effect.effect.parameters))),
    )


def _parameter(effect: EffectForecast, row: int, forecast: Forecast) -> PlannedParameter:
    """Return the forecast of parameter number ``row`` of an effect: its smallest visible size by gyro, and shifts.

    An effect that is the same for all gyros has one size, under the name "all". Shifts are those of each gyro at the
    largest plausible size, in SI and in sigmas. Sizes and shifts that are not finite are None.
    """
    parameter = effect.effect.parameters[row]
    gyros = [gyro.name for gyro in forecast.gyros]
    names = ["all"] if effect.effect.shared else gyros
    shifts = zip(gyros, effect.shift[row], effect.shift_sigmas[row], strict=True)
    return PlannedParameter(
        name=parameter.name,
        unit=parameter.unit,
        largest=parameter.largest,
        smallest=dict(zip(names, json_object(effect.smallest[row]), strict=True)),
        seen=bool(effect.seen[row].all()),
        shift_of_largest=tuple(
            PlannedShift(gyro=gyro, **by_state(shift), sigmas=by_state(sigmas)) for gyro, shift, sigmas in shifts
        ),
    )
