"""The twins of effects outside the catalogue do what their names say, and the bench judges by the same truth."""

from __future__ import annotations

import numpy as np
import pytest
from open_worlds.answers import dependences
from open_worlds.cases import ARRAY, HALVES, STATES, Case, cases_of, made, scene_of, sizes_of
from open_worlds.clean import REFERENCES, CleanCase, clean_recording
from open_worlds.effects import KINDS, last_sign, played
from open_worlds.motion import DEG, motion_of
from open_worlds.oracle import oracle_of

from estimator.estimation.calibrate import calibrate
from estimator.geometry.model import predicted_output
from estimator.recordings.reference import TableReadings

CHANCE = 3.0


def column_of(case: Case, number: int) -> np.ndarray:
    """Return the effect of a case at size 1 in one run, as the first gyro feels it."""
    law = case.law.law
    shape = (len(motion_of(case.scripts[number]).t_s), len(ARRAY))
    return np.broadcast_to(law(scene_of(case, number, np.zeros(shape))), shape)[:, 0]


def test_a_lagged_temperature_obeys_the_equation_of_a_first_order_lag() -> None:
    case = Case("lagged_temperature", 1.0, 0)
    bias, temperature = column_of(case, 0) / (0.006 * DEG), scene_of(case, 0, np.empty((0, 4))).warmth_c
    slope = np.gradient(bias, 0.01)
    lag_s = (slope @ (temperature - bias)) / (slope @ slope)
    assert 20 < lag_s < 90
    np.testing.assert_allclose(bias + lag_s * slope, temperature, atol=2e-3)


def test_a_product_of_gravity_follows_from_the_angles_that_the_table_reports() -> None:
    case = Case("gravity_product_xy", 1.0, 0)
    world = made(case)
    table = world.verification.reference
    assert isinstance(table, TableReadings)
    t_s = world.verification.sources["array"].t_ns * 1e-9
    _, y, x = (np.interp(t_s, table.t_ns * 1e-9, column) for column in table.angle_rad.T)
    # Up in body axes, with y turned before x: (-sin y, cos y sin x, cos y cos x).
    expected = 0.05 * DEG * -np.sin(y) * np.cos(y) * np.sin(x)
    assert np.ptp(expected) > 0.03 * DEG
    np.testing.assert_allclose(world.columns[2][:, 0], expected, atol=2e-4 * DEG)


def test_an_eccentric_encoder_errs_by_a_harmonic_of_the_angle_and_by_nothing_after_whole_turns() -> None:
    case = Case("encoder_third", 1.0, 0)
    axis = scene_of(case, 1, np.empty((0, 4))).axis()  # the first thing that the law draws
    scene = scene_of(case, 1, np.empty((0, 4)))
    along = ARRAY.p[:, "xyz".index(axis)]
    gyro = int(np.argmax(np.abs(along)))
    error_rad = np.cumsum(case.law.law(scene)[:, gyro]) * 0.01 / along[gyro]
    angle = scene.angle(axis)
    waves = np.column_stack([np.ones_like(angle), np.cos(3 * angle), np.sin(3 * angle)])
    fitted = np.linalg.lstsq(waves, error_rad, rcond=None)[0]
    assert np.hypot(fitted[1], fitted[2]) == pytest.approx(1.5e-3 / 3, rel=1e-2)
    np.testing.assert_allclose(waves @ fitted, error_rad, atol=1e-5)


def test_a_play_moves_what_follows_only_when_its_gap_is_used_up() -> None:
    there_and_back = np.array([0.0, 1.0, 4.0, 3.0, 2.0, 1.0])
    np.testing.assert_array_equal(played(there_and_back, 1.0), [0.0, 0.0, 3.0, 3.0, 3.0, 2.0])


def test_the_last_direction_stays_through_a_rest() -> None:
    rates = np.array([[0.0], [1.0], [0.0], [-1.0], [0.0]])
    np.testing.assert_array_equal(last_sign(rates)[:, 0], [0, 1, 1, -1, -1])


def test_the_verification_run_without_noise_holds_what_the_noisy_one_holds() -> None:
    case = Case("popcorn", 1.0, 0)
    world = made(case)
    states = predicted_output(ARRAY, STATES, motion_of("verification").inertial_rps)
    effect = sizes_of(case) * world.columns[2]
    assert len(np.unique(np.sign(effect[:, 0]))) == 2
    without = world.clean.sources["array"].rate_rps - effect
    np.testing.assert_allclose(without, states, atol=2e-5)  # where a ramp begins, rates are those of half a step
    noise = world.verification.sources["array"].rate_rps - effect - states
    np.testing.assert_allclose(noise.std(axis=0), 0.05 * DEG, rtol=0.05)


def test_who_knows_the_law_is_wrong_by_chance_only() -> None:
    case = Case("rate_logarithm", 1.0, 0)
    world = made(case)
    oracle = oracle_of(case, world)
    assert oracle.error_rps < CHANCE * oracle.chance_rps < 0.5 * world.effect_rps


def test_every_kind_is_in_both_halves_and_no_case_is_in_two() -> None:
    halves = [set(cases_of(list(KINDS), [1.0, 0.3], 4, half)) for half in HALVES]
    assert not halves[0] & halves[1]
    assert halves[0] | halves[1] == set(cases_of(list(KINDS), [1.0, 0.3], 4))
    assert all({case.kind for case in half} == set(KINDS) for half in halves)
    assert sum(kind.measured for kind in KINDS.values()) >= 36


def test_a_law_in_words_tells_what_it_depends_on() -> None:
    law = "bias proportional to temperature lagged by 58 +- 4 s"
    assert dependences(law) == {"temperature", "time"}
    assert dependences("sign(rate) * acceleration") == {"direction", "rate", "acceleration"}


@pytest.mark.parametrize("reference", REFERENCES)
def test_clean_recordings_hold_the_true_motion_in_their_reference(reference: str) -> None:
    recording = clean_recording(CleanCase(reference, 4), 0)
    data = recording.sources["array"]
    assert len(data.t_ns) > 1000
    biases = np.array([gyro.states[1] for gyro in calibrate(recording, innovations=False).gyros])
    np.testing.assert_allclose(biases, STATES[:, 1], atol=0.02 * DEG)
