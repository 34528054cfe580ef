"""Body rates from what a table reported: rates give the shape, angles the truth over seconds."""

from __future__ import annotations

import numpy as np
import pytest

from estimator.errors import RecordingError
from estimator.geometry.kinematics import Site, body_rate
from estimator.recordings.motion.body_rates import GAP_NS, BodyRates
from estimator.recordings.reference import TableReadings, TableUncertainty

DEG = np.pi / 180
COUNT_RAD = 2 * np.pi / 65536
SITE = Site(np.radians(50.0), 0.3)
STEP_NS = 50_000_000


def motion(t_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return angles and rates of three gimbals: one turns on and on, one swings, one stands."""
    angle = np.column_stack([20 * DEG * t_s, 0.8 * np.sin(0.5 * t_s), np.full_like(t_s, 0.4)])
    rate = np.column_stack([np.full_like(t_s, 20 * DEG), 0.4 * np.cos(0.5 * t_s), np.zeros_like(t_s)])
    return angle, rate


def readings(duration_s: float = 60.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    t_ns = np.arange(0, round(duration_s * 1e9) + 1, STEP_NS, dtype=np.int64)
    return t_ns, *motion(t_ns * 1e-9)


def fed(t_ns: np.ndarray, angle: np.ndarray, rate: np.ndarray, site: Site | None = SITE) -> BodyRates:
    rates = BodyRates("zyx", site)
    rates.add(t_ns, angle, rate)
    rates.finish()
    return rates


def asked(t_ns: np.ndarray) -> np.ndarray:
    return np.arange(t_ns[0], t_ns[-1] + 1, 7_000_000, dtype=np.int64)


def test_exact_readings_give_the_rate_of_the_kinematics() -> None:
    t_ns, angle, rate = readings()
    rates = fed(t_ns, angle, rate)
    wanted = body_rate(*motion(t_ns * 1e-9), "zyx", SITE)
    # A swing of 0.4 rad/s is not straight within 50 ms: 0.1 mrad/s2 times the step, and trapezoids of it.
    np.testing.assert_allclose(rates.at(t_ns), wanted, atol=3e-5)


@pytest.mark.parametrize("rows", [1, 2, 7, 400])
def test_fed_by_rows_or_at_once_gives_the_same(rows: int) -> None:
    t_ns, angle, rate = readings()
    rng = np.random.default_rng(1)
    rate = rate + 0.002 * rng.normal(size=rate.shape)
    half_width_ns = rng.integers(0, 20_000_000, len(t_ns))
    at_once, by_rows = BodyRates("zyx", SITE), BodyRates("zyx", SITE)
    at_once.add(t_ns, angle, rate, half_width_ns)
    at_once.finish()
    for start in range(0, len(t_ns), rows):
        part = slice(start, start + rows)
        by_rows.add(t_ns[part], angle[part], rate[part], half_width_ns[part])
    by_rows.finish()
    t = asked(t_ns)
    np.testing.assert_allclose(by_rows.at(t), at_once.at(t), atol=1e-12)


def test_what_is_final_stays_as_it_is() -> None:
    t_ns, angle, rate = readings()
    rate = rate + 0.002 * np.random.default_rng(2).normal(size=rate.shape)
    rates, early = BodyRates("zyx", SITE), []
    for i in range(len(t_ns)):
        rates.add(t_ns[i : i + 1], angle[i : i + 1], rate[i : i + 1])
        assert rates.final_until_ns < 0 or rates.final_until_ns <= t_ns[i] - 3_000_000_000
        if rates.final_until_ns >= t_ns[0]:
            early.append((rates.final_until_ns, rates.at(np.array([rates.final_until_ns]))[0]))
    rates.finish()
    assert rates.final_until_ns == t_ns[-1]
    assert rates.starts_ns == t_ns[0]
    times = np.array([t for t, _ in early])
    np.testing.assert_allclose(rates.at(times), np.array([w for _, w in early]), atol=1e-12)


@pytest.mark.parametrize("site", [None, SITE])
def test_earth_rate_is_in_the_result_only_with_a_site(site: Site | None) -> None:
    t_ns = np.arange(0, 10_000_000_001, STEP_NS, dtype=np.int64)
    still = np.zeros((len(t_ns), 3))
    wanted = np.zeros(3) if site is None else site.earth_rate_rps()
    np.testing.assert_allclose(fed(t_ns, still, still, site).at(t_ns), np.tile(wanted, (len(t_ns), 1)), atol=1e-15)


def test_a_rate_that_is_off_in_scale_is_corrected_by_the_angles() -> None:
    t_ns, angle, rate = readings()
    wanted = body_rate(angle, rate, "zyx", SITE)
    found = fed(t_ns, angle, 1.01 * rate).at(t_ns)
    inner = slice(100, -100)  # where the window is whole
    off = np.abs(found - wanted)[inner].max()
    uncorrected = np.abs(body_rate(angle, 1.01 * rate, "zyx", SITE) - wanted)[inner].max()
    assert uncorrected > 4e-3
    assert off < 0.3 * uncorrected
    steady = fed(t_ns, angle[:, :1] * [1, 0, 0], 1.01 * rate[:, :1] * [1, 0, 0], None).at(t_ns)[:, 2]
    np.testing.assert_allclose(steady, 20 * DEG, atol=1e-9)


def test_a_rate_readback_that_is_offset_is_corrected_by_the_angles() -> None:
    t_ns, angle, rate = readings()
    offset = np.array([0.003, -0.002, 0.001])
    np.testing.assert_allclose(fed(t_ns, angle, rate + offset).at(t_ns), fed(t_ns, angle, rate).at(t_ns), atol=1e-9)


def test_encoder_counts_cost_little() -> None:
    t_ns, angle, rate = readings()
    counted = np.round(angle / COUNT_RAD) * COUNT_RAD
    rounded = np.round(rate / (0.05 * DEG)) * 0.05 * DEG  # a coarse rate readback
    exact = fed(t_ns, angle, rate).at(t_ns)
    np.testing.assert_allclose(fed(t_ns, counted, rate).at(t_ns), exact, atol=1e-4)
    inner = slice(100, -100)
    steady = (fed(t_ns, counted, rounded).at(t_ns) - exact)[inner]
    # The rounding of a swinging rate stays within half a step; that of a steady one goes.
    assert np.abs(steady).max() < 0.03 * DEG
    mean_error = np.abs(np.mean(steady, axis=0)).max()
    assert mean_error < 1e-5


def test_whole_turn_jumps_of_the_angle_do_not_matter() -> None:
    t_ns, angle, rate = readings()
    wrapped = (angle + np.pi) % (2 * np.pi) - np.pi
    assert np.abs(np.diff(wrapped[:, 0])).max() > 6
    t = asked(t_ns)
    np.testing.assert_allclose(fed(t_ns, wrapped, rate).at(t), fed(t_ns, angle, rate).at(t), atol=1e-9)


def test_a_jump_between_two_calls_does_not_matter_either() -> None:
    t_ns, angle, rate = readings()
    wrapped = angle % (2 * np.pi)
    by_rows = BodyRates("zyx", SITE)
    for i in range(len(t_ns)):
        by_rows.add(t_ns[i : i + 1], wrapped[i : i + 1], rate[i : i + 1])
    by_rows.finish()
    t = asked(t_ns)
    np.testing.assert_allclose(by_rows.at(t), fed(t_ns, angle, rate).at(t), atol=1e-9)


def test_a_gap_in_which_nothing_surprising_happened_is_bridged() -> None:
    t_ns, angle, rate = readings()
    keep = (t_ns < 20_000_000_000) | (t_ns > 21_000_000_000)
    steady, steady_rate = angle * [1, 0, 0], rate * [1, 0, 0]
    found = fed(t_ns[keep], steady[keep], steady_rate[keep]).at(asked(t_ns))
    assert np.isfinite(found).all()
    np.testing.assert_allclose(found, fed(t_ns, steady, steady_rate).at(asked(t_ns)), atol=1e-9)


def test_nothing_is_said_of_a_gap_that_hides_a_motion() -> None:
    t_ns, _, _ = readings(20.0)
    t_s = t_ns * 1e-9
    angle, rate = np.zeros((len(t_ns), 3)), np.zeros((len(t_ns), 3))
    angle[t_s > 10.2, 0] = 1 * DEG  # it moved, and no reading saw a rate
    keep = (t_s < 10) | (t_s > 10.4)
    t = asked(t_ns)
    found = fed(t_ns[keep], angle[keep], rate[keep]).at(t)
    before, after = t_ns[keep][t_s[keep] < 10][-1], t_ns[keep][t_s[keep] > 10.4][0]
    assert after - before > GAP_NS
    np.testing.assert_array_equal(np.isnan(found).any(axis=1), (t > before) & (t <= after))


@pytest.mark.parametrize("bad", [[0, 50, 50, 100], [0, 50, 40, 100]])
def test_times_that_do_not_increase_are_refused(bad: list[int]) -> None:
    t_ns = np.array(bad, dtype=np.int64) * 1_000_000
    with pytest.raises(RecordingError, match="do not increase"):
        BodyRates("zyx", None).add(t_ns, np.zeros((4, 3)), np.zeros((4, 3)))


@pytest.mark.parametrize("later_ns", [0, -1])
def test_times_that_do_not_increase_from_call_to_call_are_refused(later_ns: int) -> None:
    t_ns, angle, rate = readings(5.0)
    rates = BodyRates("zyx", None)
    rates.add(t_ns, angle, rate)
    with pytest.raises(RecordingError, match="do not increase"):
        rates.add(t_ns[-1:] + later_ns, angle[-1:], rate[-1:])


def test_no_readings_at_all_are_no_readings() -> None:
    rates = BodyRates("z", None)
    rates.add(np.empty(0, dtype=np.int64), np.empty((0, 1)), np.empty((0, 1)))
    rates.finish()
    assert rates.final_until_ns < rates.starts_ns


# A table on a slow link: the instant of a reading is known to half of its round trip only.

HALF_WIDTH_S = 0.04


def one_axis(
    t_ns: np.ndarray,
    angle: np.ndarray,
    rate: np.ndarray,
    half_width_s: float | np.ndarray = 0.0,
    timing_s: float = 0.0,
) -> BodyRates:
    """Return body rates of a table with one axis, z, from readings (k,), on a base that stands still."""
    half_width_ns = np.broadcast_to(np.round(np.asarray(half_width_s) * 1e9).astype(np.int64), t_ns.shape)
    uncertainty = TableUncertainty(timing_s=timing_s)
    return BodyRates.of(
        TableReadings(
            t_ns=t_ns,
            angle_rad=angle[:, None],
            rate_rps=rate[:, None],
            gimbals=("z",),
            uncertainty=uncertainty,
            half_width_ns=half_width_ns,
        ),
        site=None,
    )


def steady(duration_s: float = 60.0, rate_rps: float = 80 * DEG) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return instants, angles and rates (k,) of an axis that turns on and on."""
    t_ns = np.arange(0, round(duration_s * 1e9) + 1, STEP_NS, dtype=np.int64)
    return t_ns, rate_rps * t_ns * 1e-9, np.full(len(t_ns), rate_rps)


def ramped(acceleration_rps2: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return instants, angles, rates (k,) of an axis that stands 5 s, gains 20 deg/s, turns 5 s; and whether it ramps.

    A ramp takes whole steps; its first and last reading are those of the corners.
    """
    ramp_s = 20 * DEG / acceleration_rps2
    t_ns = np.arange(0, round((10 + ramp_s) * 1e9) + 1, STEP_NS, dtype=np.int64)
    since_s = np.clip(t_ns * 1e-9 - 5, 0, ramp_s)
    rate = acceleration_rps2 * since_s
    angle = 0.5 * acceleration_rps2 * since_s**2 + rate * np.clip(t_ns * 1e-9 - 5 - ramp_s, 0, None)
    return t_ns, angle, rate, (t_ns * 1e-9 > 5 + 1e-6) & (t_ns * 1e-9 < 5 + ramp_s + 1e-6)


def test_angles_of_doubtful_instants_do_not_pull_the_rates() -> None:
    t_ns, angle, rate = steady()
    scattered = angle + rate * np.random.default_rng(3).uniform(-HALF_WIDTH_S, HALF_WIDTH_S, len(t_ns))
    taken_for_exact = one_axis(t_ns, scattered, rate).at(t_ns)[:, 2] - rate
    known_doubtful = one_axis(t_ns, scattered, rate, HALF_WIDTH_S).at(t_ns)[:, 2] - rate
    assert np.sqrt(np.mean(taken_for_exact**2)) > 1e-3
    assert np.sqrt(np.mean(known_doubtful**2)) < 1e-4


@pytest.mark.parametrize("exact", ["one in four", "all"])
def test_exact_instants_still_correct_a_rate_that_is_off_in_scale(exact: str) -> None:
    """Whether half widths say which they are, or it shows in how little the angles scatter."""
    t_ns, angle, rate = steady()
    doubtful = np.full(len(t_ns), True)
    if exact == "one in four":
        doubtful[::4] = False
        angle = angle + doubtful * rate * np.random.default_rng(4).uniform(-HALF_WIDTH_S, HALF_WIDTH_S, len(t_ns))
    found = one_axis(t_ns, angle, 1.001 * rate, HALF_WIDTH_S * doubtful).at(t_ns)[:, 2]
    assert 0.001 * rate[0] > 1e-3
    np.testing.assert_allclose(found, rate, atol=5e-5)


def test_a_gap_in_a_steady_turn_is_bridged_where_a_doubtful_instant_explains_the_angle() -> None:
    t_ns, angle, rate = steady(20.0)
    after = t_ns > 10_500_000_000
    keep = (t_ns < 10_000_000_000) | after
    angle = angle + rate * 1.5 * HALF_WIDTH_S * (t_ns == t_ns[after][0])  # one reading beside the gap, of two
    t = asked(t_ns)
    doubtful = one_axis(t_ns[keep], angle[keep], rate[keep], HALF_WIDTH_S).at(t)[:, 2]
    np.testing.assert_allclose(doubtful, rate[0], atol=2e-3)
    exact = one_axis(t_ns[keep], angle[keep], rate[keep]).at(t)[:, 2]
    np.testing.assert_array_equal(np.isnan(exact), (t > t_ns[~after & keep][-1]) & (t <= t_ns[after][0]))


def test_the_doubt_of_the_reading_before_a_gap_counts_when_readings_come_one_by_one() -> None:
    t_ns, angle, rate = steady(20.0)
    before, after = t_ns < 10_000_000_000, t_ns > 10_500_000_000
    last = t_ns == t_ns[before][-1]
    angle = angle + rate * 0.5 * HALF_WIDTH_S * last
    half_width_ns = np.where(last, round(HALF_WIDTH_S * 1e9), 0)
    rates = BodyRates("z", None)
    for i in np.flatnonzero(before | after):
        rates.add(t_ns[i : i + 1], angle[i : i + 1, None], rate[i : i + 1, None], half_width_ns[i : i + 1])
    rates.finish()
    assert np.isfinite(rates.at(asked(t_ns))).all()


def test_a_gap_in_a_steady_turn_is_not_bridged_where_no_doubt_explains_the_angle() -> None:
    t_ns, angle, rate = steady(20.0)
    after = t_ns > 10_500_000_000
    keep = (t_ns < 10_000_000_000) | after
    moved = angle + rate * 3 * HALF_WIDTH_S * after
    t = asked(t_ns)
    found = one_axis(t_ns[keep], moved[keep], rate[keep], HALF_WIDTH_S).at(t)[:, 2]
    np.testing.assert_array_equal(np.isnan(found), (t > t_ns[~after & keep][-1]) & (t <= t_ns[after][0]))


@pytest.mark.parametrize("half_width_s", [0.0, HALF_WIDTH_S])
def test_nothing_is_said_of_a_gap_that_may_hide_the_corners_of_a_ramp(half_width_s: float) -> None:
    t_ns, angle, rate, ramp = ramped(50 * DEG)
    keep = ~ramp | (t_ns == t_ns[ramp][-1])  # the trapezoid of the readings beside it is this ramp to the last digit
    before, after = t_ns[~ramp & (rate == 0)][-1], t_ns[ramp][-1]
    assert after - before > GAP_NS
    t = asked(t_ns)
    found = one_axis(t_ns[keep], angle[keep], rate[keep], half_width_s).at(t)[:, 2]
    np.testing.assert_array_equal(np.isnan(found), (t > before) & (t <= after))


@pytest.mark.parametrize(
    ("acceleration_dps2", "half_width_s", "timing_s", "known"),
    [(50, 0.0, 0.0, True), (50, 0.0, 0.01, True), (1, 0.0, 0.01, True), (50, 0.02, 0.0, False), (1, 0.02, 0.0, True)],
    ids=["steep, well timed", "steep, badly timed", "gentle, badly timed", "steep, slow link", "gentle, slow link"],
)
def test_a_steep_ramp_whose_instants_are_not_known_is_left_out_and_a_gentle_one_is_kept(
    acceleration_dps2: float, half_width_s: float, timing_s: float, known: bool
) -> None:
    t_ns, angle, rate, ramp = ramped(acceleration_dps2 * DEG)
    scattered = angle + rate * np.random.default_rng(5).uniform(-half_width_s, half_width_s, len(t_ns))
    found = one_axis(t_ns, scattered, rate, half_width_s, timing_s).at(t_ns)[:, 2]
    np.testing.assert_array_equal(np.isnan(found), ramp & (not known))
    np.testing.assert_allclose(found[np.isfinite(found)], rate[np.isfinite(found)], atol=5e-4)


def test_the_acceleration_where_a_reading_and_a_corner_nearly_coincide_is_that_of_the_ramp() -> None:
    t_ns, angle, rate, _ = ramped(20 * DEG)
    counted = np.round(angle / COUNT_RAD) * COUNT_RAD
    noisy_rps = rate + 1e-4 * np.random.default_rng(5).normal(size=len(rate))
    rates = one_axis(t_ns, counted, noisy_rps)
    about_corners_ns = np.concatenate(
        [np.arange(t - 1_000_000, t + 1_000_000, 500, dtype=np.int64) for t in (5_000_000_000, 6_000_000_000)]
    )
    accelerations_rps2 = rates.accelerations_at(about_corners_ns)[:, 0]
    assert accelerations_rps2.min() > -1 * DEG
    assert accelerations_rps2.max() < 21 * DEG
