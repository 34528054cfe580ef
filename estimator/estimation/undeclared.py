"""Undeclared effects: those of the catalogue that may be there, at the sizes that it calls plausible.

A script may be saturated: what is constant within each of its steady rates leaves no residual, however wrong the states
are for it. Only expectation can speak there (JCGM 100:2008, 4.3: type B). Every law of the catalogue stands beside the
states with mean zero and one standard deviation, the same rule for all: a third of the largest plausible size, which is
thus three sigmas. Where the motion shows an effect the data decide; where it does not, the state stays that uncertain.
Powers of the rate are as large at the fastest rate of a recording as they plausibly are at 30 deg/s.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from estimator.calibration.budget import UNSEEN
from estimator.calibration.gyro import GyroCalibration
from estimator.calibration.values import UndeclaredEffect
from estimator.effects import drift
from estimator.effects.catalogue import records
from estimator.effects.conditions import REFERENCE_C, Axes, Conditions
from estimator.effects.constructed import readable
from estimator.effects.disturbances import TONE
from estimator.effects.drift import BIAS_STEP
from estimator.effects.effect import Effect, Kind
from estimator.effects.law import VARIABLES, variables_of
from estimator.effects.site import EARTH_RATE
from estimator.estimation.noise_evidence import Joint, Law
from estimator.estimation.runs.run import Run
from estimator.geometry.kinematics import GRAVITY_MPS2
from estimator.geometry.model import STATES, Prior
from estimator.packaged import sentence
from estimator.sensors.gyros import GYRO
from estimator.types import Floats

_SHARE = 1 / 3  # of the largest plausible size of a parameter is its expected standard deviation
_SPOKEN_OF_RPS = float(np.radians(30.0))  # rate at which these are as large as they plausibly are, in %
_WARMS_K, _WARMS_S = 10.0, 600.0  # after power-on, where no temperature was recorded
_LEAST_COLUMN = 1e-12
_MOST_NAMED, _NAMED = 3, 0.1  # effects that are named of a state, and the share of its variance that they make
_SHOWN = {"1": (1e6, "ppm"), "rad/s": (float(np.degrees(3600)), "deg/h"), "rad": (1e6, "urad")}
_TILTED = 0.05  # of gravity: a component that changes by less does so by vibration and drift
_OF_TIME = frozenset(record.name for record in drift.RECORDS)
_ASSUMED = frozenset({"temperature", "specific force"})  # assumed where it was not recorded
_OF_B_RPS = float(np.radians(20.0)) * _SHARE
"""Bias to which the sizes of the catalogue belong: those of temperature and gravity are of the sheet (MPU-6050) that
promises no more than 20 deg/s. A type that promises less is less sensitive to these, too."""


@dataclass(frozen=True, slots=True, eq=False)
class Undeclared:
    """Undeclared effects: ``laws`` that the recording can show, and ``assumed`` laws that it cannot show.

    The latter depend on a temperature or a pose that was not recorded, so that their influence on the states can only
    be computed. ``runs`` have the conditions that all of them depend on, as assumed.
    """

    laws: list[Law]
    assumed: list[Law]
    runs: list[Run]


def undeclared(runs: Sequence[Run], excluded: frozenset[str]) -> Undeclared:
    """Return the laws of the catalogue, except those excluded, that could act on the states unseen, with a share of
    their largest plausible sizes as expected ones.

    Laws whose temperature or pose was not recorded are assumed: a temperature that rises by 10 K, level axes of a body
    that turns. The runs of the result have the assumed conditions. Where temperature is unknown, the states hold for
    the mean over the recording, and laws of time stand for what the temperature does to the bias. Left out as well are
    tones, bias steps between several files, Earth rate beside a stated site or without a table, errors of a table that
    states its uncertainty, effects of specific force in a single pose, and laws that do not act in these runs.
    """
    offers = frozenset.intersection(*(run.grid.offers for run in runs))
    runs = [replace(run, grid=_completed(run.grid)) for run in runs]
    # The temperature nearest to that of data sheets at which the run was: the states are those there.
    warm = runs[0].grid.temperature_c
    assert warm is not None
    nearest_c = float(np.clip(REFERENCE_C, warm.min(), warm.max()))
    reference_c = nearest_c if "temperature" in offers else float(warm.mean())
    runs = [replace(run, grid=replace(run.grid, reference_c=reference_c)) for run in runs]
    grid = runs[0].grid
    table = runs[0].recording.table
    stated = {TONE.name}  # a line passes by steady rates that last many of its periods
    if runs[0].recording.several_files:
        stated.add(BIAS_STEP.name)  # that from file to file is in the noise
    if grid.site is not None or not grid.gimbals:
        stated.add(EARTH_RATE.name)
    if table is not None and table.uncertainty is not None:
        stated |= {record.name for record in records() if record.of_table}
    one_pose = all(_one_pose(run) for run in runs)
    turns = any(run.turns for run in runs)
    laws: list[Law] = []
    assumed: list[Law] = []
    for effect, share in _effects(grid):
        name = effect.record.name
        if not effect.parameters or name in excluded | stated:
            continue
        held = effect.needs & _ASSUMED <= offers
        if not held and not (of_rates(effect) if "temperature" in effect.needs else turns):
            continue
        if "specific force" in effect.needs and one_pose:
            continue
        size = 1.0 if held else _of_type(effect, runs[0].data.prior)
        sd = _SHARE * share * size * effect.largest
        if name in _OF_TIME and "temperature" not in offers:
            effect = _about_its_mean(effect)
        law = Law(called=readable(name), effect=effect, mean=np.zeros(len(effect.parameters)), sd=sd, line=UNSEEN)
        if _acts(law, runs):
            (laws if held else assumed).append(law)
    return Undeclared(laws, assumed, runs)


def _about_its_mean(effect: Effect) -> Effect:
    """Return an effect whose columns are taken about their mean over a run, so that the states hold for the whole
    run.
    """

    def about_mean(conditions: Conditions, axes: Axes) -> Floats:
        columns = effect.at(conditions, axes)
        return np.asarray(columns - columns.mean(axis=0))

    return replace(effect, regressors=about_mean)


def _one_pose(run: Run) -> bool:
    """Return whether a body that does not turn points the same way all the time.

    False for a body that turns. True also where the specific force is not known, or no block has weight.
    """
    if run.turns:
        return False
    force = run.grid.specific_force_mps2
    spread = np.ptp(run.fold(force)[run.weight > 0], axis=0) if (run.weight > 0).any() else np.zeros(3)
    return bool(np.nan_to_num(spread).max() < _TILTED * GRAVITY_MPS2)


def of_rates(effect: Effect) -> bool:
    """Return whether an effect is one of the rate, too: a sensitivity that changes, no bias."""
    return bool(effect.law) and any(VARIABLES[name][0] == "rate" for name in variables_of(effect.law))


def _of_type(effect: Effect, prior: Prior) -> float:
    """Return the share of its size in the catalogue that an effect may have on a device of this data sheet."""
    return 1.0 if of_rates(effect) else min(prior.b_rps / _OF_B_RPS, 1.0)


def moved_by(joint: Joint, undeclared: Undeclared) -> list[Floats]:
    """Return by gyro the covariance (4, 4) that the assumed laws add to the states (GUM 5.1.3).

    They depend on conditions that nobody measured, so that the residual says nothing about them, and they move no
    value. It is zero without assumed laws.
    """
    covariances = []
    for gyro in range(len(joint.means)):
        number, own = joint.place_of(gyro)
        run = undeclared.runs[number]
        columns = [run.columns(law.effect, own) * law.sd for law in undeclared.assumed]
        shifts = joint.shifts(gyro, np.hstack(columns)) if columns else np.zeros((4, 0))
        covariances.append(shifts @ shifts.T)
    return covariances


def effects_by_state(joint: Joint, covariances: Sequence[Floats]) -> tuple[UndeclaredEffect, ...]:
    """Return the undeclared effects that cause most of the variance of each state, as the mean over the gyros.

    They come by state, the largest share first: at most ``_MOST_NAMED`` a state, and none with a share below
    ``_NAMED``.
    """
    shares: dict[tuple[int, str], float] = {}
    shown_by: dict[str, str] = {}
    for number, law in enumerate(joint.laws):
        if law.line != UNSEEN:
            continue
        parts = [np.diag(joint.through(c, [number])) / np.diag(c)[:4] for c in covariances]
        for state, share in enumerate(np.mean(parts, axis=0).tolist()):
            shares[state, law.called] = shares.get((state, law.called), 0.0) + share
        shown_by[law.called] = law.effect.record.shown_by
    found: list[UndeclaredEffect] = []
    for state, name in enumerate(STATES):
        own = sorted(((share, called) for (s, called), share in shares.items() if s == state), reverse=True)
        found += [
            UndeclaredEffect(state=name, effect=called, share=min(share, 1.0), shown_by=shown_by[called])
            for share, called in own[:_MOST_NAMED]
            if share > _NAMED
        ]
    return tuple(found)


def undeclared_notes(effects: Sequence[UndeclaredEffect], gyros: Sequence[GyroCalibration]) -> list[str]:
    """Return one sentence on the undeclared effects that cause most of the sigmas and on the sigmas without them.

    An empty list without ``effects``.
    """
    if not effects:
        return []
    most: dict[str, float] = {}
    for one in effects:
        most[one.effect] = max(most.get(one.effect, 0.0), one.share)
    worst = sorted(most, key=lambda effect: -most[effect])[:_MOST_NAMED]
    sizes = np.sqrt(np.mean([gyro.sd_declared**2 for gyro in gyros], axis=0))
    texts = []
    for state, size in zip(GYRO.states, sizes.tolist(), strict=True):
        factor, unit = _SHOWN[state.unit]
        texts.append(f"{state.symbol} {size * factor:.2g} {unit}")
    without = ", ".join(texts)
    return [sentence("estimation.undeclared", effects=", ".join(worst), without=without)]


def _effects(grid: Conditions) -> list[tuple[Effect, float]]:
    """Return all laws of the catalogue, made for the axes of ``grid``, each with a share of its largest plausible size.

    None is left out: a law may have no parameters for these axes, or need data that ``grid`` does not have. A
    record with n alternative settings is spread over n laws with the share 1 / sqrt(n) each. The share of one that
    grows with power p of the rate is also multiplied by (30 deg/s / fastest rate)^(p - 1), the fastest rate counting as
    at least 30 deg/s. Records without alternatives come first. ``grid`` has at least one instant.
    """
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
    # Certain laws first, then those that stand for several: the order decides the last digits of figures.
    return [(effect, share) for _, effect, share in sorted(found, key=lambda one: one[0])]


def _completed(grid: Conditions) -> Conditions:
    """Return conditions with assumptions for unknown ones: gravity along z, and a temperature that rises.

    The specific force is assumed at each instant at which it is not finite, the temperature only if it is None. That
    rises by ``_WARMS_K`` from ``REFERENCE_C``, with a time constant of ``_WARMS_S``.
    """
    force = np.where(np.isfinite(grid.specific_force_mps2), grid.specific_force_mps2, [0.0, 0.0, GRAVITY_MPS2])
    temperature = grid.temperature_c
    if temperature is None:
        temperature = REFERENCE_C - _WARMS_K * np.expm1(-(grid.t_s - grid.t_s[0]) / _WARMS_S)
    return replace(grid, specific_force_mps2=force, temperature_c=temperature)


def _acts(law: Law, runs: Sequence[Run]) -> bool:
    """Return whether an effect does anything to a gyro of any run, under the conditions of that run."""
    return any(
        np.abs(run.columns(law.effect, i) * law.sd).max(initial=0.0) > _LEAST_COLUMN
        for run in runs
        for i in range(len(run.array))
    )
