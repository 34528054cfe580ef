"""Effects that nobody has spoken of: what the catalogue says may be there, at the sizes that it calls plausible.

A script may be saturated: what is constant within each of its steady rates leaves no residual, however wrong the states
are for it. Only expectation can speak there (JCGM 100:2008, 4.3: type B). Every law of the catalogue stands beside the
states with mean zero and one standard deviation, the same rule for all: a third of the largest plausible size, which is
thus three sigmas. Where the motion shows an effect the data decide; where it does not, the state stays that uncertain.
Powers of the rate are as large at the fastest rate of a recording as they plausibly are at 30 deg/s.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from estimator.calibration.budget import UNSEEN
from estimator.effects.catalogue import catalogue
from estimator.effects.conditions import Conditions
from estimator.effects.drift import bias_step, warm_up
from estimator.effects.effect import Effect
from estimator.effects.scale import dead_band
from estimator.effects.thermal import REFERENCE_C, thermal_bias, thermal_bias_quadratic, thermal_scale
from estimator.estimation.noise_evidence import Law
from estimator.estimation.runs.run import Run
from estimator.geometry.kinematics import GRAVITY_MPS2
from estimator.recordings.reference import TableReadings
from estimator.types import Floats

WITHIN_TURNS = ("latency", "bandwidth", "acceleration_sensitivity")
"""Effects that come to nothing over a turn from rest to rest."""

_SHARE = 1 / 3  # of the largest plausible size of a parameter is its expected standard deviation
_STEPS = 8  # a step at an unknown instant is as good as several that share its variance
_TIMES_S = (20.0, 90.0, 400.0)  # of a warm-up, whose time constant is not known either
_POWERS = {"scale_quadratic": 2, "scale_cubic": 3}
_SPOKEN_OF_RPS = float(np.radians(30.0))  # rate at which these are as large as they plausibly are, in %
_DEAD_RPS = float(np.radians(0.1))
_WARMS_K, _WARMS_S = 10.0, 600.0  # after power-on, where no temperature was recorded
_LEAST_COLUMN = 1e-12


def undeclared_laws(runs: Sequence[Run], excluded: frozenset[str]) -> tuple[list[Law], list[Run]]:
    """Return the laws of the catalogue but those excluded, and the runs under the conditions that they depend on.

    What a recording does not hold is assumed: a temperature that rises by 10 K, level axes. Beside a stated site Earth
    rate is no undeclared effect, nor are errors of a table's axes and rates beside its stated uncertainty.
    """
    runs = [replace(run, grid=_completed(run.grid)) for run in runs]
    grid = runs[0].grid
    reference = runs[0].recording.reference
    stated = {"tone"}  # a line passes by steady rates that last many of its periods
    if grid.site is not None or not grid.gimbals:
        stated.add("earth_rate")
    if isinstance(reference, TableReadings) and reference.uncertainty is not None:
        stated |= {"table_axes", "table_rate"}
    laws = [
        Law(_called(effect), effect, np.zeros(len(effect.parameters)), _SHARE * share * _largest(effect), UNSEEN)
        for effect, share in _effects(grid)
        if effect.parameters and _kind(effect) not in excluded | stated
    ]
    return [law for law in laws if _acts(law, runs)], runs


def _effects(grid: Conditions) -> list[tuple[Effect, float]]:
    """Return the effects, and the share of its size that each stands for: what is not linear is spread over several."""
    first, last = float(grid.t_s[0]), float(grid.t_s[-1])
    known = grid.temperature_c if grid.temperature_c is not None else np.full(1, REFERENCE_C)
    # The temperature nearest to that of data sheets at which the run was: the states are those there.
    reference_c = float(np.clip(REFERENCE_C, known.min(), known.max()))
    fastest_rps = max(float(np.abs(grid.w_rps).max(initial=0.0)), _SPOKEN_OF_RPS)
    thermal = [make(reference_c) for make in (thermal_bias, thermal_bias_quadratic, thermal_scale)]
    spread = {"bias_step", "warm_up", *(effect.name for effect in thermal)}
    plain = [effect for effect in catalogue(grid.gimbals, last - first) if effect.name not in spread]
    steps = np.linspace(first, last, _STEPS + 2)[1:-1].tolist()
    return [
        *(
            (effect, (_SPOKEN_OF_RPS / fastest_rps) ** (_POWERS.get(effect.name, 1) - 1))
            for effect in (*plain, *thermal, dead_band(_DEAD_RPS))
        ),
        *((bias_step(at_s), _STEPS**-0.5) for at_s in steps),
        *((warm_up(tau_s), len(_TIMES_S) ** -0.5) for tau_s in _TIMES_S),
    ]


def _completed(grid: Conditions) -> Conditions:
    force = np.where(np.isfinite(grid.specific_force_mps2), grid.specific_force_mps2, [0.0, 0.0, GRAVITY_MPS2])
    temperature = grid.temperature_c
    if temperature is None:
        temperature = REFERENCE_C - _WARMS_K * np.expm1(-(grid.t_s - grid.t_s[0]) / _WARMS_S)
    return replace(grid, specific_force_mps2=force, temperature_c=temperature)


def _acts(law: Law, runs: Sequence[Run]) -> bool:
    """Return whether an effect does anything under these conditions."""
    run = runs[0]
    return any(
        np.abs(run.columns(law.effect, i) * law.sd).max(initial=0.0) > _LEAST_COLUMN for i in range(len(run.array))
    )


def _largest(effect: Effect) -> Floats:
    return np.array([parameter.largest for parameter in effect.parameters])


def _kind(effect: Effect) -> str:
    return "table_harmonic" if effect.name.startswith("table_harmonic") else effect.name


def _called(effect: Effect) -> str:
    return _kind(effect).replace("_", " ")
