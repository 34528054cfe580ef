"""What a plan says beforehand, against what then happens."""

from __future__ import annotations

from dataclasses import replace
from statistics import NormalDist

import numpy as np
from support import SITE, direct_recording

from estimator.effects.conditions import Conditions
from estimator.effects.drift import BIAS_DRIFT, WARM_UP
from estimator.effects.effect import Effect
from estimator.effects.scale import SCALE_ASYMMETRY
from estimator.effects.site import G_SENSITIVITY
from estimator.effects.thermal import THERMAL_BIAS
from estimator.estimation.calibrate import calibrate
from estimator.geometry.array import tetrahedron, triad
from estimator.geometry.model import Prior, regressor_maps
from estimator.geometry.noise import NoiseModel
from estimator.planning.planning import Forecast, PlannedDevice, forecast
from station.scripts.planned import planned_motion
from station.scripts.script import Rest, Rotate, Script, paper_script

DEG = np.pi / 180
ARW = 0.005 * DEG
DPH = DEG / 3600
WHITE = NoiseModel(ARW)


def turn(axis: str, rate_dps: float, duration_s: float = 30.0) -> Rotate:
    return Rotate(axis, rate_dps * DEG, duration_s, 20 * DEG, f"{axis} at {rate_dps} deg/s")


def conditions_of(script: Script, warmth: str = "rising") -> Conditions:
    motion = planned_motion(script, ("z", "y", "x"))
    share = motion.t_s / script.least_s
    temperature = 25 + 2 * (share if warmth == "rising" else np.sin(np.pi * share))
    return Conditions.on_table(
        motion.t_s,
        motion.angle_rad,
        motion.rate_rps,
        motion.acceleration_rps2,
        motion.gimbals,
        temperature_c=temperature,
        site=SITE,
    )


def plan(
    script: Script,
    *effects: Effect,
    noise: NoiseModel = WHITE,
    array: str = "tetrahedron",
    warmth: str = "rising",
) -> Forecast:
    device = PlannedDevice("array", triad() if array == "triad" else tetrahedron(), noise, Prior())
    return forecast(conditions_of(script, warmth), [device], effects)


def test_white_noise_on_the_paper_s_script_gives_the_cramer_rao_bounds() -> None:
    sd = np.array([gyro.sd for gyro in plan(paper_script()).gyros])
    assert 33e-6 < sd[:, 0].min() < sd[:, 0].max() < 41e-6
    assert np.allclose(sd[:, 1], 1.5 * DPH, rtol=0.05)
    assert 30e-6 < sd[:, 2:].min() < sd[:, 2:].max() < 43e-6


def test_the_estimate_states_the_predicted_sigma_and_its_doubt_about_the_noise() -> None:
    predicted = np.array([g.sd for g in plan(paper_script()).gyros])
    stated = [[g.sd for g in calibrate(direct_recording(seed), innovations=False).gyros] for seed in range(3)]
    ratio = np.sqrt(np.mean(np.square(stated), axis=(0, 1)) / np.mean(predicted**2, axis=0))
    # The plan is told that the noise is white; six minutes do not tell the estimate, and a drifting bias would matter.
    assert np.all(ratio > 0.97)
    assert np.all(ratio < [1.15, 1.45, 1.15, 1.15])


def test_asymmetry_is_invisible_to_the_paper_s_script_and_corrupts_what_the_plan_says() -> None:
    """The shift of the states that a plan predicts is what happens to an estimate whose data hold the effect."""
    (asymmetry,) = plan(paper_script(), SCALE_ASYMMETRY.effect()).effects
    assert not asymmetry.seen.any()
    size, recording = 2000e-6, direct_recording(1)
    source = recording.sources["array"]
    motion = planned_motion(paper_script(), ("z", "y", "x"), 0.01)  # half a period before each sample
    rates = Conditions.on_table(
        motion.t_s, motion.angle_rad, motion.rate_rps, motion.acceleration_rps2, motion.gimbals, site=SITE
    )
    effect = [SCALE_ASYMMETRY.effect().columns(rates, source.array, i)[:, 0] for i in range(4)]
    wrong = replace(source, rate_rps=source.rate_rps + size * np.column_stack(effect))
    shift = np.array(
        [
            after.states - before.states
            for after, before in zip(
                calibrate(replace(recording, sources={"array": wrong}), innovations=False).gyros,
                calibrate(recording, innovations=False).gyros,
                strict=True,
            )
        ]
    )
    predicted = asymmetry.shift[0] * size / asymmetry.largest[0]
    sd = np.array([g.sd for g in plan(paper_script()).gyros])
    assert np.abs(predicted / sd).max() > 30
    assert np.abs((shift - predicted) / sd).max() < 0.5


def test_asymmetry_is_seen_when_axes_turn_both_ways() -> None:
    both = Script("both", (Rest(30), *(turn(axis, rate) for axis in "xyz" for rate in (30, -30)), Rest(30)))
    found = plan(both, SCALE_ASYMMETRY.effect())
    assert found.effects[0].seen.all()
    assert not found.saturated


def test_an_effect_of_the_smallest_size_is_found_as_often_as_promised() -> None:
    """By least squares on all samples, 95 % of its estimates are beyond what 1 % of those without it reach."""
    found = plan(paper_script(), G_SENSITIVITY.effect(), WARM_UP.effect(time_constant_s=120.0))
    conditions, array = conditions_of(paper_script()), tetrahedron()
    states = np.column_stack([np.ones(len(conditions.t_s)), conditions.w_rps]) @ regressor_maps(array)[1].T
    for effect, column in ((found.effects[0], 2), (found.effects[1], 0)):
        columns = np.hstack([states, effect.effect.columns(conditions, array, 1)[:, [column]]])
        sigma = np.sqrt(np.linalg.inv(columns.T @ columns)[4, 4] / conditions.period_s) * ARW
        threshold = NormalDist().inv_cdf(0.995) * sigma
        power = 1 - NormalDist(effect.smallest[column, 1], sigma).cdf(threshold)
        assert abs(power - 0.95) < 0.001


def test_a_shared_effect_is_seen_by_all_gyros_together() -> None:
    own, shared = G_SENSITIVITY.effect(), replace(G_SENSITIVITY, shared=True).effect()
    found = plan(paper_script(), own, shared)
    together = np.sum(found.effects[0].smallest ** -2.0, axis=1) ** -0.5
    assert found.effects[1].smallest.shape == (3, 1)
    assert np.allclose(found.effects[1].smallest[:, 0], together)


def test_turning_about_one_axis_leaves_combinations_unobservable() -> None:
    found = plan(Script("x only", (Rest(30), turn("x", 20))), array="tetrahedron")
    gyro1, gyro2 = found.gyros[0], found.gyros[1]
    assert gyro1.unseen.tolist() == [[1, 0, 0, 0], [0, 0, 1, 0]]  # along -z: k is unseen, and the tilt across x
    # gyro2 lies in the plane of x and z: of its scale factor and its tilt in that plane only one mixture is seen.
    p, j = tetrahedron().p[1], tetrahedron().j[1]
    assert np.allclose(gyro2.unseen, [[1, 0, 0, -p[0] / j[0]], [0, 0, 1, 0]], atol=1e-2)
    for direction in gyro2.unseen:  # such an error changes no output while x turns
        assert abs(regressor_maps(tetrahedron())[1].T[1] @ direction) < 1e-2


def test_a_script_with_as_many_conditions_as_states_is_saturated() -> None:
    assert plan(paper_script()).saturated
    assert plan(paper_script()).steady_conditions == 4
    more = Script("more", (*paper_script().steps, turn("x", 40)))
    assert not plan(more).saturated
    assert plan(more).steady_conditions == 5


def test_drift_and_temperature_are_told_apart_only_if_it_is_not_monotone() -> None:
    rising = plan(paper_script(), BIAS_DRIFT.effect(), THERMAL_BIAS.effect(), warmth="rising")
    there_and_back = plan(paper_script(), BIAS_DRIFT.effect(), THERMAL_BIAS.effect(), warmth="there and back")
    assert [(p.first, p.second) for p in rising.pairs] == [("bias_drift", "thermal_bias")]
    assert rising.pairs[0].correlation > 0.99
    assert not there_and_back.pairs


def test_the_correlation_is_that_of_the_estimates() -> None:
    """With both effects in the model, the sigma of one grows by 1 / sqrt(1 - r^2)."""
    conditions = conditions_of(paper_script(), "there and back")
    effects = BIAS_DRIFT.effect(), WARM_UP.effect(time_constant_s=60.0)
    found = plan(paper_script(), *effects, warmth="there and back")
    regressors = np.column_stack([np.ones(len(conditions.t_s)), conditions.w_rps])
    drift, warm = (effect.columns(conditions, tetrahedron(), 0) for effect in effects)
    alone, both = np.hstack([regressors, drift]), np.hstack([regressors, warm, drift])
    growth = np.sqrt(np.linalg.inv(both.T @ both)[-1, -1] / np.linalg.inv(alone.T @ alone)[-1, -1])
    (pair,) = found.pairs
    assert abs(pair.correlation - np.sqrt(1 - growth**-2)) < 0.005
