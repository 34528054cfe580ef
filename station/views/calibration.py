"""A calibration for display: its noise, and what its uncertainties are made of, as means over the gyros."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from drivers.packaged import packaged_toml
from drivers.types import Floats
from estimator.calibration.values import Calibration
from estimator.geometry.model import STATES
from estimator.observations.allan.sensor import SensorNoise
from station.bench.units import Units
from station.views.figures import StateUnit, state_figures

_BUDGET_WORDS = packaged_toml("station.views", "budget.toml")["terminal"]


@dataclass(kw_only=True, frozen=True, slots=True)
class MeanNoise:
    """Noise, mean over the gyros whose noise is estimated: angle random walk, and the upper 95 % limits of bias
    instability and rate random walk (deg/h/rt h).
    """

    arw_dps_rthz: float
    instability_below_dph: float
    walk_below_dph_rth: float


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class RestNoise:
    """Noise of each gyro at rest, and where the mean of the Allan deviations is least."""

    noises: tuple[SensorNoise, ...]
    mean_span_s: float
    least_dph: float
    least_tau_s: float


@dataclass(kw_only=True, frozen=True, slots=True)
class UndeclaredShare:
    """What effects that nobody declared add to the sigma of a state, rms over the gyros in SI.

    ``mostly`` are the main effects with their share of the variance, ``shown_by`` what would show them.
    """

    figure: StateUnit
    sd: float
    sd_without: float
    mostly: str
    shown_by: str


def mean_noise(calibration: Calibration) -> MeanNoise | None:
    """Return the estimated noise as a mean over the gyros that have one; None if none is estimated.

    It is not in SI: deg/s/rt Hz, deg/h and deg/h/rt h.
    """
    found = [gyro.noise for gyro in calibration.gyros if gyro.noise is not None]
    if not found:
        return None
    noises = [(noise.mean.arw, 3600 * noise.instability_below, 3600 * 60 * noise.walk_below) for noise in found]
    arw, instability, walk = np.degrees(np.mean(noises, axis=0)).tolist()
    return MeanNoise(arw_dps_rthz=arw, instability_below_dph=instability, walk_below_dph_rth=walk)


def rest_noise(calibration: Calibration) -> RestNoise | None:
    """Return the noise of the gyros at rest, and where their mean Allan deviation is least; None without rest.

    Gyros without a rest are left out. The mean is over the averaging times that all curves have; its least value is in
    deg/h, the noise of each gyro in SI.
    """
    rests = [gyro.rest for gyro in calibration.gyros if gyro.rest is not None]
    if not rests:
        return None
    shortest = min((rest.curve for rest in rests), key=lambda curve: len(curve.tau_s))
    mean = np.mean([rest.curve.deviation[: len(shortest.tau_s)] for rest in rests], axis=0)
    least = int(np.argmin(mean))
    return RestNoise(
        noises=tuple(rests),
        mean_span_s=float(np.mean([rest.span_s for rest in rests])),
        least_dph=math.degrees(mean[least]) * 3600,
        least_tau_s=float(shortest.tau_s[least]),
    )


def budget_of(calibration: Calibration) -> Mapping[str, Floats]:
    """Return each contribution to the sigmas (4,), rms over the gyros, in SI, and last, as "combined", their total.

    They are by names for a reader, such as "noise (type A)"; one that has none keeps the name in the budget. Empty if
    there is one contribution only, or gyros differ in them.
    """
    budgets = [{c.name: c.u for c in gyro.budget} for gyro in calibration.gyros]
    names = list(budgets[0]) if budgets else []
    if len(names) < 2 or any(list(budget) != names for budget in budgets):
        return {}
    lines = {_BUDGET_WORDS.get(name, name): [budget[name] for budget in budgets] for name in names}
    lines["combined"] = [gyro.sd for gyro in calibration.gyros]
    return {name: np.sqrt(np.mean(np.square(u), axis=0)) for name, u in lines.items()}


def undeclared_shares(calibration: Calibration, units: Units) -> list[UndeclaredShare]:
    """Return for each state the sigma with and without undeclared effects, rms over the gyros in SI, and the effects
    that add most to it, if any.

    They are in the order of the states; a state that no such effect adds to has empty texts. ``units`` are those to
    show the states in, and only ``figure`` depends on them. Empty without such effects or gyros.
    """
    if not calibration.undeclared or not calibration.gyros:
        return []
    whole = np.sqrt(np.mean([gyro.sd**2 for gyro in calibration.gyros], axis=0)).tolist()
    without = np.sqrt(np.mean([gyro.sd_declared**2 for gyro in calibration.gyros], axis=0)).tolist()
    shares = []
    for figure, name, sd, sd_without in zip(state_figures(units), STATES, whole, without, strict=True):
        effects = [effect for effect in calibration.undeclared if effect.state == name]
        shares.append(
            UndeclaredShare(
                figure=figure,
                sd=sd,
                sd_without=sd_without,
                mostly="; ".join(f"{effect.effect} {effect.share:.0%}" for effect in effects),
                shown_by="; ".join(dict.fromkeys(effect.shown_by for effect in effects)),
            )
        )
    return shares
