"""The twins of effects outside the catalogue do what their names say, and the bench judges by the same truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from open_worlds.answers import Addition, Answer, error_of_states
from open_worlds.cases import ARRAY, HALVES, KINDS, NEWER, STATES, Case, cases_of, made, scene_of, sizes_of
from open_worlds.clean import REFERENCES, CleanCase, clean_recording
from open_worlds.effects import Scene, last_sign, played
from open_worlds.fresh_sealed import relayed
from open_worlds.judging import (
    Outcome,
    by_error_alone,
    dependences,
    outcome_of,
    raised,
    raised_as_told,
    ratio_claims_too_much,
    ratio_holds,
)
from open_worlds.motion import DEG, motion_of
from open_worlds.oracle import oracle_of
from open_worlds.stored import compared, load, store

from estimator.estimation.calibrate import calibrate
from estimator.geometry.model import predicted_output
from estimator.recordings.reference import TableReadings

CHANCE = 3.0


def answer(kind: str, name: str, *, true_after: float, told_after: float = 1.0, expression: str = "") -> Answer:
    """Return an answer with one addition, where the error was 10 and an oracle's is 2; stated: 10 to 20 times less."""
    return Answer(
        case=Case(kind, 1.0, 0),
        verdict="added",
        reason="",
        added=(Addition(name, 0.99, bool(expression), expression),),
        rivals=(),
        depends_on="",
        true_before=10.0,
        true_after=true_after,
        oracle=2.0,
        chance=0.5,
        told_before=10.0,
        told_after=told_after,
        ratio=10.0 / told_after,
        low=5.0 / told_after,
        high=20.0 / told_after,
        scales=12,
        biases=4,
        biases_met=4,
        effect=10.0,
        cpu_s=1.0,
        peak_mb=100.0,
    )


def scene_without_noise(case: Case, number: int) -> Scene:
    """Return what the effect of a case sees of one run, with an output of nothing."""
    return scene_of(case, number, np.zeros((len(motion_of(case.scripts[number]).t_s), len(ARRAY))))


def columns_of(case: Case, number: int) -> np.ndarray:
    """Return the effect of a case at size 1 in one run, as each gyro feels it."""
    scene = scene_without_noise(case, number)
    return np.broadcast_to(case.law.law(scene), scene.output_rps.shape)


def column_of(case: Case, number: int) -> np.ndarray:
    """Return the effect of a case at size 1 in one run, as the first gyro feels it."""
    return columns_of(case, number)[:, 0]


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


def test_a_relay_holds_between_its_two_limits() -> None:
    up_and_down = np.array([0.0, 3.0, 5.0, 3.0, 1.0, 3.0])
    np.testing.assert_array_equal(relayed(up_and_down, 2.0, 4.0), [1, 1, 0, 0, 1, 1])


def test_a_ring_laser_without_dither_beats_by_the_root_of_squares_beyond_its_threshold_and_not_within() -> None:
    case = Case("lock_in", 1.0, 0)
    rate = scene_without_noise(case, 2).u_rps[:, 0]
    output = rate + column_of(case, 2)
    turning = np.abs(rate) > 2 * DEG
    threshold_rps = np.sqrt(rate[turning] ** 2 - output[turning] ** 2)
    np.testing.assert_allclose(threshold_rps, threshold_rps[0])
    within = np.abs(rate) < 0.99 * threshold_rps[0]
    assert (within & (rate != 0)).sum() > 10
    np.testing.assert_allclose(output[within], 0.0, atol=1e-12)


def test_heat_comes_through_a_plate_as_the_equation_of_diffusion_says() -> None:
    case = Case("diffused_temperature", 1.0, 0)
    scene = scene_without_noise(case, 1)
    diffusion_s = scene.fixed.uniform(120, 270)  # the first thing that the law draws
    cells = 40
    share = 0.01 * cells**2 / diffusion_s  # that neighbours exchange of their difference within a sample
    plate_c = np.zeros(cells)
    far_c = []
    for face_c in scene.warmth_c[:10000].tolist():
        outer = np.concatenate([[2 * face_c - plate_c[0]], plate_c, plate_c[-1:]])
        plate_c = plate_c + share * np.diff(outer, 2)
        far_c.append(plate_c[-1])
    assert far_c[-1] > 1.0
    np.testing.assert_allclose(column_of(case, 1)[: len(far_c)] / (0.008 * DEG), far_c, atol=0.01)


def test_a_fixture_rings_as_a_spring_and_a_damper_do_and_ends_where_it_was() -> None:
    case = Case("ringing_fixture", 1.0, 0)
    scene = scene_without_noise(case, 0)
    twist_rps = column_of(case, 0) / 0.1
    twist_rad = np.cumsum(twist_rps) * 0.01
    push = np.gradient(twist_rps, 0.01) + scene.udot_rps2[:, 0]
    steady = np.abs(np.gradient(scene.udot_rps2[:, 0])) == 0
    stiffness, drag = np.linalg.lstsq(np.column_stack([twist_rad, twist_rps])[steady], -push[steady], rcond=None)[0]
    assert 1.5 < np.sqrt(stiffness) / (2 * np.pi) < 4.0
    assert 0.02 < drag / (2 * np.sqrt(stiffness)) < 0.15
    assert abs(twist_rad[-1]) < 1e-3 * np.abs(twist_rad).max()


def test_one_gyro_changes_the_range_of_all_and_a_smaller_rate_changes_it_back() -> None:
    case = Case("shared_auto_range", 1.0, 0)
    largest_dps = np.abs(scene_without_noise(case, 1).u_dps).max(axis=1)
    wide = columns_of(case, 1) != 0
    assert wide.any(axis=0).all()
    assert np.array_equal(wide.all(axis=1), wide.any(axis=1))
    changes = np.diff(wide[:, 0].astype(int))
    up_dps, down_dps = (largest_dps[1:][changes == way] for way in (1, -1))
    assert len(up_dps) > 4
    assert up_dps.min() > down_dps.max() + 1.0


def test_a_gyro_is_at_zero_where_it_has_been_still_and_drifts_with_the_temperature_while_it_turns() -> None:
    case = Case("zero_rate_update", 1.0, 0)
    scene = scene_without_noise(case, 1)
    turning = np.abs(scene.u_dps[:, 0]) > 1.0
    column = column_of(case, 1)
    both = turning[1:] & turning[:-1]
    np.testing.assert_allclose(np.diff(column)[both], 0.01 * DEG * np.diff(scene.warmth_c)[both], atol=1e-12)
    assert abs(column[-1]) < 0.1 * np.abs(column).max()  # after the rest at the end


def test_a_wobbling_axis_leans_as_it_did_when_it_has_come_round() -> None:
    case = Case("axis_wobble", 1.0, 0)
    scene = scene_without_noise(case, 0)
    in_body = columns_of(case, 0) @ np.linalg.pinv(ARRAY.p).T
    in_base = np.einsum("nij,nj->ni", scene.motion.attitude, in_body)
    tilt_rad = np.cumsum(in_base, axis=0) * 0.01
    spun = scene.rate("z") > 0
    angle, leaning = scene.angle("z")[spun], tilt_rad[spun]
    rounds = [np.argmin(np.abs(angle - 2 * np.pi * turn)) for turn in range(4)]
    assert np.ptp(leaning[:, :2], axis=0).min() > 1e-3
    np.testing.assert_allclose(leaning[rounds], 0.0, atol=2e-5)


def test_a_table_on_isolators_leans_in_proportion_to_the_moment_of_its_load() -> None:
    case = Case("soft_isolators", 1.0, 0)
    attitude = scene_without_noise(case, 1).motion.attitude
    in_body = columns_of(case, 1) @ np.linalg.pinv(ARRAY.p).T
    in_base = np.einsum("nij,nj->ni", attitude, in_body)
    tilt_rad = np.cumsum(in_base, axis=0) * 0.01
    moved = attitude - attitude[0]
    moments = np.vstack([moved[:, 1], -moved[:, 0]])  # about x and y, of a weight in each direction of the body
    leaning = np.concatenate([tilt_rad[:, 0], tilt_rad[:, 1]])
    loads_rad = np.linalg.lstsq(moments, leaning, rcond=None)[0]
    np.testing.assert_allclose(moments @ loads_rad, leaning, atol=2e-5)
    assert 1.2e-3 < np.linalg.norm(loads_rad) < 2.0e-3
    assert np.abs(tilt_rad[:, 2]).max() < 2e-5


def test_a_bruised_ring_reads_right_again_beyond_its_bruise() -> None:
    case = Case("bruised_encoder_ring", 1.0, 0)
    motion = scene_without_noise(case, 0).motion
    in_body = columns_of(case, 0) @ np.linalg.pinv(ARRAY.p).T
    readings_deg = np.einsum("ngi,ni->ng", motion.axes, np.cumsum(in_body, axis=0) * 0.01) / DEG
    swings_deg = np.sort(np.ptp(readings_deg, axis=0))
    assert swings_deg[-1] == pytest.approx(0.12, rel=0.02)
    assert swings_deg[1] < 1e-9
    np.testing.assert_allclose(readings_deg[-1], 0.0, atol=1e-3)
    assert 0.02 < np.mean(np.abs(in_body).max(axis=1) > 1e-3 * DEG) < 0.2


def test_a_brake_lets_its_axis_go_the_same_while_after_it_stops_in_every_run() -> None:
    case = Case("holding_brake", 1.0, 0)
    waits_s = []
    for number in range(3):
        turning = np.abs(scene_without_noise(case, number).motion.rate_rps).max(axis=1) > 0.05 * DEG
        released = column_of(case, number) != 0.0
        assert not released[: np.flatnonzero(turning)[0]].any()
        assert released[turning].all()
        waits_s.append(0.01 * (np.flatnonzero(released)[-1] - np.flatnonzero(turning)[-1]))
    np.testing.assert_allclose(waits_s, waits_s[0], atol=1e-9)
    assert 2 < waits_s[0] < 8


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


def test_true_states_leave_nothing_of_a_tilted_run_without_an_effect() -> None:
    without_effect = made(Case("anisoinertia", 0.0, 0)).clean
    assert error_of_states(STATES, without_effect) < 2 * DEG / 3600


def test_who_knows_the_law_is_wrong_by_chance_only() -> None:
    case = Case("rate_logarithm", 1.0, 0)
    world = made(case)
    oracle = oracle_of(case, world)
    assert oracle.error_rps < CHANCE * oracle.chance_rps < 0.5 * world.effect_rps
    assert oracle.gain > 3


def test_every_case_is_in_one_half_and_a_newer_kind_as_a_whole() -> None:
    halves = [set(cases_of(list(KINDS), [1.0, 0.3], 4, half)) for half in HALVES]
    everything = set(cases_of(list(KINDS), [1.0, 0.3], 4))
    assert sum(len(half) for half in halves) == len(everything)
    assert set().union(*halves) == everything
    development, sealed, *newer = ({case.kind for case in half} for half in halves)
    assert development == sealed
    assert [len(kinds) for kinds in newer] == [10, 10, 6, 6, 10, 10, 12, 16]
    assert sum(map(len, newer)) + len(development) == len(KINDS)
    assert set().union(development, *newer) == set(KINDS)


def test_constants_of_the_newer_laws_are_those_of_the_device_and_not_of_the_run() -> None:
    for kind in (kind for kinds in NEWER.values() for kind in kinds):
        case = Case(kind, 1.0, 0)
        drawn = []
        for number in range(3):
            scene = scene_without_noise(case, number)
            case.law.law(scene)
            drawn.append((scene.fixed.random(), scene.anew.random()))
        fixed, anew = zip(*drawn, strict=True)
        assert len(set(fixed)) == 1
        assert anew == tuple(np.random.default_rng(case.numbers(3, number)).random() for number in range(3))
        another = columns_of(Case(kind, 1.0, 1), 1)
        assert np.isfinite(another).all()
        assert not np.allclose(columns_of(case, 1), another)


def test_a_law_is_right_by_the_error_that_it_leaves_and_not_by_the_variables_that_it_names() -> None:
    near = answer("rate_root", "law", true_after=2.9, expression="sqrt(|rate|)")
    far = answer("rate_root", "law", true_after=3.1, expression="sqrt(|rate|)")
    assert (outcome_of(near), outcome_of(far)) == (Outcome.RIGHT, Outcome.WRONG)


def test_an_effect_of_the_catalogue_is_right_as_an_equivalent_or_by_its_error() -> None:
    assert outcome_of(answer("walk_of_one", "bias_walk", true_after=9.0)) is Outcome.RIGHT
    assert outcome_of(answer("rate_root", "scale_asymmetry", true_after=9.0)) is Outcome.WRONG
    lucky = answer("rate_root", "scale_asymmetry", true_after=2.0)
    assert outcome_of(lucky) is Outcome.RIGHT
    assert by_error_alone(lucky, lucky.added[0])


def test_errors_of_the_table_count_as_stated_and_nothing_is_right_that_no_oracle_can_know() -> None:
    assert outcome_of(answer("encoder_third", "law", true_after=9.0, told_after=2.0)) is Outcome.RIGHT
    assert outcome_of(answer("rate_root", "law", true_after=9.0, told_after=2.0)) is Outcome.WRONG


def test_growth_is_told_from_chance_and_a_claim_from_the_truth() -> None:
    assert raised(answer("rate_root", "law", true_after=10.5))
    assert not raised(answer("rate_root", "law", true_after=10.01))
    assert raised_as_told(answer("rate_root", "law", true_after=1.0, told_after=10.1))
    holds = answer("rate_root", "law", true_after=1.0, told_after=1.0)
    boasts = answer("rate_root", "law", true_after=2.5, told_after=1.0)
    assert (ratio_holds(holds), ratio_claims_too_much(holds)) == (True, False)
    assert (ratio_holds(boasts), ratio_claims_too_much(boasts)) == (False, True)


def test_stored_answers_are_judged_again_and_what_changed_is_named(tmp_path: Path) -> None:
    old = [answer("rate_root", "law", true_after=9.0), answer("lock_in", "law", true_after=9.0)]
    store(tmp_path / "old.json", old)
    read = load(tmp_path / "old.json")
    assert read == old
    now = [answer("rate_root", "law", true_after=2.0), answer("lock_in", "law", true_after=9.0)]
    lines = compared(read, now)
    assert "  wrong -> right: 1" in lines
    assert [line for line in lines if line.startswith("rate_root")]
    assert not [line for line in lines if line.startswith("lock_in")]


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
