"""The live filter: the batch estimate by another road, and honest about its innovations."""

from __future__ import annotations

import numpy as np
import pytest

from estimator.estimation.gram import Gram, solve
from estimator.estimation.live.filter import LiveFilter
from estimator.geometry.array import SensorArray, cone, tetrahedron
from estimator.geometry.model import Prior, predicted_output, regressor_maps

DEG = np.pi / 180
RATE_HZ = 100
NOISE_RPS = 0.005 * DEG * np.sqrt(RATE_HZ)
TRUE_STATES = np.array([0.005, 0.1 * DEG, 0.1 * DEG, -0.1 * DEG])


def script(duration_s: float, rate_hz: float = RATE_HZ) -> np.ndarray:
    """Return body rates (rows, 3): rest, about x, y, z at 20 deg/s with ramps, rest, a fifth of the time each."""
    t = np.arange(round(duration_s * rate_hz)) / rate_hz
    fifth = duration_s / 5
    w = np.zeros((len(t), 3))
    for axis in range(3):
        since = t - (1 + axis) * fifth
        ramp = np.clip(np.minimum(since, fifth - since) / (0.04 * fifth), 0, 1)
        w[:, axis] = 20 * DEG * ramp
    return w


def outputs(array: SensorArray, w: np.ndarray, seed: int, noise_rps: float = NOISE_RPS) -> np.ndarray:
    states = np.tile(TRUE_STATES, (len(array), 1))
    noise = np.random.default_rng(seed).normal(0, noise_rps, (len(w), len(array)))
    return predicted_output(array, states, w) - noise


def run_live(
    array: SensorArray, w: np.ndarray, y: np.ndarray, rows: int = 20, noise_rps: float = NOISE_RPS
) -> LiveFilter:
    live = LiveFilter(array, np.full(len(array), noise_rps), Prior())
    for start in range(0, len(w), rows):
        live.update(w[start : start + rows], y[start : start + rows])
    return live


def differences_in_sigma(live: LiveFilter, array: SensorArray, w: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Return by how much state and sigma of the live filter are off the Gram solution, in its sigmas."""
    x, covariance = live.state()
    batch = solve(Gram.of(w, y), array, Prior(), np.full(len(array), NOISE_RPS))
    sd = np.sqrt(np.diagonal(batch.covariance, axis1=1, axis2=2))
    live_sd = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    return float(np.abs((x - batch.x) / sd).max()), float(np.abs(live_sd / sd - 1).max())


@pytest.mark.parametrize("array", [tetrahedron(), cone(6, 0.9)], ids=len)
def test_live_and_batch_agree_to_a_millionth_of_a_sigma(array: SensorArray) -> None:
    w = script(360)
    y = outputs(array, w, seed=1)
    state, sigma = differences_in_sigma(run_live(array, w, y), array, w, y)
    assert state < 1e-6
    assert sigma < 1e-6


@pytest.mark.parametrize("rows", [1, 2, 3, 7, 20, 100, 3000])
def test_how_the_rows_are_cut_into_blocks_does_not_matter(rows: int) -> None:
    array, w = tetrahedron(), script(20)
    y = outputs(array, w, seed=2)
    state, sigma = differences_in_sigma(run_live(array, w, y, rows), array, w, y)
    assert state < 1e-6
    assert sigma < 1e-6


def test_a_plain_filter_over_the_raw_samples_says_the_same() -> None:
    from filterpy.kalman import KalmanFilter  # a second of import: not of each worker that collects

    array, w = tetrahedron(), script(30)
    y = outputs(array, w, seed=3)
    maps, m = regressor_maps(array), len(array)
    plain = KalmanFilter(dim_x=4 * m, dim_z=m)
    plain.x = np.zeros((4 * m, 1))
    plain.P = np.diag(np.tile(Prior().variances(), m))
    plain.R = np.eye(m) * NOISE_RPS**2
    h = np.zeros((m, 4 * m))
    for w_row, y_row in zip(w, y, strict=True):
        for i in range(m):
            h[i, 4 * i : 4 * i + 4] = maps[i] @ [1.0, *w_row]
        plain.update((y_row - array.p @ w_row)[:, None], H=h)
    x, covariance = run_live(array, w, y).state()
    sd = np.sqrt(np.diag(plain.P)).reshape(m, 4)
    assert np.abs((x - plain.x.reshape(m, 4)) / sd).max() < 1e-6
    np.testing.assert_allclose(np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)), sd, rtol=1e-6)


def test_errors_are_within_their_sigmas() -> None:
    array, w = tetrahedron(), script(60)
    scores = []
    for seed in range(8):
        x, covariance = run_live(array, w, outputs(array, w, seed)).state()
        true = TRUE_STATES * [1, 1, 1 - TRUE_STATES[0], 1 - TRUE_STATES[0]]
        scores.append((x - true) / np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)))
    assert 0.75 < np.sqrt(np.mean(np.square(scores))) < 1.25
    assert np.abs(scores).max() < 4.5


def test_nis_is_one_for_the_right_noise() -> None:
    array, w = tetrahedron(), script(120)
    live = run_live(array, w, outputs(array, w, seed=4))
    assert live.nis_dof == 600 * 4 * 4
    assert live.nis_mean == pytest.approx(1.0, abs=5 * np.sqrt(2 / live.nis_dof))


@pytest.mark.parametrize("factor", [0.5, 0.9, 1.1, 2.0])
def test_a_wrong_noise_shows_in_nis(factor: float) -> None:
    array, w = tetrahedron(), script(120)
    live = run_live(array, w, outputs(array, w, seed=5), noise_rps=factor * NOISE_RPS)
    assert live.nis_mean == pytest.approx(factor**-2, rel=0.05)


def test_an_effect_beyond_the_model_shows_in_nis_and_in_its_channel() -> None:
    array, w = tetrahedron(), script(120)
    y = outputs(array, w, seed=6)
    live = LiveFilter(array, np.full(4, NOISE_RPS), Prior())
    for start in range(0, 6000, 20):
        live.update(w[start : start + 20], y[start : start + 20])
    usual = live.update(w[6000:6020], y[6000:6020])
    y[6020:6040, 2] += 20 * NOISE_RPS
    struck = live.update(w[6020:6040], y[6020:6040])
    assert usual.nis / usual.dof < 3
    assert struck.nis / struck.dof > 50
    assert int(np.argmax(np.abs(struck.normalised))) == 2
    # The step weighs by the mean of its block: twenty sigmas of one sample, times the root of twenty.
    assert struck.normalised[2] == pytest.approx(20 * np.sqrt(20), rel=0.1)


def test_the_normalised_innovation_has_the_sign_of_the_output() -> None:
    array, w = tetrahedron(), np.zeros((20, 3))
    live = LiveFilter(array, np.full(4, NOISE_RPS), Prior())
    y = np.tile([0.02, -0.02, 0.02, -0.02], (20, 1))
    np.testing.assert_array_equal(np.sign(live.update(w, y).normalised), [1, -1, 1, -1])


def test_before_any_row_it_knows_the_prior_and_no_nis() -> None:
    live = LiveFilter(tetrahedron(), np.full(4, NOISE_RPS), Prior())
    x, covariance = live.state()
    np.testing.assert_array_equal(x, np.zeros((4, 4)))
    np.testing.assert_array_equal(covariance, np.tile(np.diag(Prior().variances()), (4, 1, 1)))
    assert np.isnan(live.nis_mean)


def test_the_innovations_do_not_depend_on_how_a_processor_rounds() -> None:
    """At rest the columns of the body rate are constant; other rounding gave other figures of consistency (0.3 %)."""
    array = tetrahedron()
    w = script(60)
    w[:100] = np.array([3e-5, 5e-5, 4e-5])  # the Earth's rate
    y = outputs(array, w, seed=7)
    rounded = w * (1 + 2e-16 * np.random.default_rng(3).integers(-1, 2, w.shape))
    one, other = run_live(array, w, y), run_live(array, rounded, y)
    assert one.nis_mean == pytest.approx(other.nis_mean, rel=1e-7)
