"""Body rates from what a table reported: rates give the shape, angles the truth over seconds."""

from __future__ import annotations

import numpy as np
import pytest

from estimator.errors import RecordingError
from estimator.kinematics import Site, body_rate
from estimator.reference import GAP_NS, BodyRates

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
    rate = rate + 0.002 * np.random.default_rng(1).normal(size=rate.shape)
    at_once, by_rows = fed(t_ns, angle, rate), BodyRates("zyx", SITE)
    for start in range(0, len(t_ns), rows):
        part = slice(start, start + rows)
        by_rows.add(t_ns[part], angle[part], rate[part])
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
