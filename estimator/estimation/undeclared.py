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
from estimator.effects.catalogue import records
from estimator.effects.conditions import REFERENCE_C, Conditions
from estimator.effects.constructed import readable
from estimator.effects.disturbances import TONE
from estimator.effects.effect import Effect, Kind
from estimator.effects.law import variables_of
from estimator.effects.site import EARTH_RATE
from estimator.estimation.noise_evidence import Law
from estimator.estimation.runs.run import Run
from estimator.geometry.kinematics import GRAVITY_MPS2
from estimator.recordings.reference import TableReadings

_SHARE = 1 / 3  # of the largest plausible size of a parameter is its expected standard deviation
_SPOKEN_OF_RPS = float(np.radians(30.0))  # rate at which these are as large as they plausibly are, in %
_WARMS_K, _WARMS_S = 10.0, 600.0  # after power-on, where no temperature was recorded
_LEAST_COLUMN = 1e-12


def undeclared_laws(runs: Sequence[Run], excluded: frozenset[str]) -> tuple[list[Law], list[Run]]:
    """Return the laws of the catalogue but those excluded, and the runs under the conditions that they depend on.

    What a recording does not hold is assumed: a temperature that rises by 10 K, level axes. Beside a stated site Earth
    rate is no undeclared effect, nor are errors of a table's axes and rates beside its stated uncertainty.
    """
    runs = [replace(run, grid=_completed(run.grid)) for run in runs]
    # The temperature nearest to that of data sheets at which the run was: the states are those there.
    warm = runs[0].grid.temperature_c
    reference_c = REFERENCE_C if warm is None else float(np.clip(REFERENCE_C, warm.min(), warm.max()))
    runs = [replace(run, grid=replace(run.grid, reference_c=reference_c)) for run in runs]
    grid = runs[0].grid
    reference = runs[0].recording.reference
    stated = {TONE.name}  # a line passes by steady rates that last many of its periods
    if grid.site is not None or not grid.gimbals:
        stated.add(EARTH_RATE.name)
    if isinstance(reference, TableReadings) and reference.uncertainty is not None:
        stated |= {record.name for record in records() if record.of_table}
    laws = [
        Law(readable(name), effect, np.zeros(len(effect.parameters)), _SHARE * share * effect.largest, UNSEEN)
        for effect, share in _effects(grid)
        if effect.parameters and (name := effect.record.name) not in excluded | stated
    ]
    return [law for law in laws if _acts(law, runs)], runs


def _effects(grid: Conditions) -> list[tuple[Effect, float]]:
    """Return the effects, and the share of its size that each stands for: what is not linear is spread over several."""
    first, last = float(grid.t_s[0]), float(grid.t_s[-1])
    fastest_rps = max(float(np.abs(grid.w_rps).max(initial=0.0)), _SPOKEN_OF_RPS)
    found: list[tuple[tuple[int, bool, bool], Effect, float]] = []
    for record in (record for record in records() if record.kind is Kind.LAW):
        several = record.assumed(first, last) if record.assumed else []
        share = (_SPOKEN_OF_RPS / fastest_rps) ** (record.power - 1) * max(len(several), 1) ** -0.5
        for settings in several or record.listed(last - first):
            effect = record.effect(grid.gimbals, **settings)
            of_temperature = bool(effect.law) and "T" in variables_of(effect.law)
            found.append(((-len(several) or -100, not record.planned, of_temperature), effect, share))
    # What is one law for certain first, then what several stand for: the order decides the last digits of figures.
    return [(effect, share) for _, effect, share in sorted(found, key=lambda one: one[0])]


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
