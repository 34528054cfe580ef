"""The error model: exact in its states, with the paper's regressors, and decoded without approximation."""

from __future__ import annotations

import numpy as np
import pytest

from estimator.estimation.gram import Gram, solve
from estimator.geometry.array import SensorArray, cone, dodecahedron, tetrahedron, triad
from estimator.geometry.model import Prior, decode, predicted_output, regressor_maps

DEG = np.pi / 180
LOOSE = Prior(k=1e6, b_rps=1e6, sigma_rad=1e6)
"""A prior that has no say, so that what is left is the model."""


def some_states(n: int, size: float = 1.0, seed: int = 3) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.uniform(-1, 1, (n, 4)) * np.array([0.05, 1 * DEG, 0.02, 0.02]) * size


def some_rates(rows: int = 400, seed: int = 4) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1, 1, (rows, 3))


def decoded(array: SensorArray, w: np.ndarray, y: np.ndarray) -> np.ndarray:
    solution = solve(Gram.of(w, y), array, LOOSE, np.full(len(array), 1e-3))
    return np.array([decode(x, p)[0] for x, p in zip(solution.x, solution.covariance, strict=True)])


@pytest.mark.parametrize("size", [1e-3, 1.0, 10.0])
@pytest.mark.parametrize("array", [triad(), tetrahedron(), dodecahedron(), cone(5, 0.9)], ids=len)
def test_noise_free_outputs_give_the_states_back_products_and_all(array: SensorArray, size: float) -> None:
    states, w = some_states(len(array), size), some_rates()
    found = decoded(array, w, predicted_output(array, states, w))
    scale = np.array([0.05, 1 * DEG, 0.02, 0.02]) * size
    np.testing.assert_allclose(found / scale, states / scale, atol=1e-9)


def test_the_product_that_the_paper_drops_is_half_a_percent_of_its_sigma() -> None:
    array, w = tetrahedron(), some_rates()
    states = np.tile([0.005, 0.1 * DEG, 0.1 * DEG, -0.1 * DEG], (4, 1))
    y = predicted_output(array, states, w)
    undecoded = solve(Gram.of(w, y), array, LOOSE, np.full(4, 1e-3)).x
    np.testing.assert_allclose(undecoded[:, 2:] / states[:, 2:], 0.995, rtol=1e-9)
    np.testing.assert_allclose(decoded(array, w, y)[:, 2:], states[:, 2:], rtol=1e-9)


def test_the_output_is_written_out_for_one_gyro() -> None:
    array, w = tetrahedron(), np.array([[0.3, -0.2, 0.5]])
    states = some_states(4)
    y = predicted_output(array, states, w)[0]
    for i, (k, b, sigma_j, sigma_k) in enumerate(states):
        pbar = array.p[i] - sigma_k * array.j[i] + sigma_j * array.k[i]
        assert y[i] == pytest.approx((1 - k) * pbar @ w[0] - b, abs=1e-15)


def test_perfect_gyros_put_out_the_rate_along_their_axes() -> None:
    array, w = dodecahedron(), some_rates()
    np.testing.assert_allclose(predicted_output(array, np.zeros((6, 4)), w), w @ array.p.T)


def test_signs_are_those_of_the_conventions() -> None:
    array = triad()
    turning, resting = np.array([[0.4, 0.0, 0.0]]), np.zeros((1, 3))
    k_only, b_only = np.zeros((3, 4)), np.zeros((3, 4))
    k_only[0, 0], b_only[0, 1] = 0.01, 0.002
    assert predicted_output(array, k_only, turning)[0, 0] == pytest.approx(0.4 * 0.99)  # too small
    assert predicted_output(array, b_only, resting)[0, 0] == -0.002  # lowered


@pytest.mark.parametrize("array", [tetrahedron(), dodecahedron()], ids=len)
def test_regressors_are_the_papers(array: SensorArray) -> None:
    maps = regressor_maps(array)
    for w in some_rates(5):
        for i in range(len(array)):
            wanted = [-array.p[i] @ w, -1.0, array.k[i] @ w, -array.j[i] @ w]
            np.testing.assert_allclose(maps[i] @ [1.0, *w], wanted, atol=1e-15)


@pytest.mark.parametrize("array", [tetrahedron(), dodecahedron()], ids=len)
def test_regressors_are_the_derivatives_of_the_output(array: SensorArray) -> None:
    h, w = 1e-6, some_rates(1)
    maps = regressor_maps(array)
    for s in range(4):
        up, down = np.zeros((len(array), 4)), np.zeros((len(array), 4))
        up[:, s], down[:, s] = h, -h
        slope = (predicted_output(array, up, w) - predicted_output(array, down, w))[0] / (2 * h)
        np.testing.assert_allclose(maps[:, s] @ [1.0, *w[0]], slope, atol=1e-9)


def test_the_decoded_covariance_is_that_of_the_decoding_linearised() -> None:
    rng = np.random.default_rng(8)
    for x in some_states(6, size=5.0):
        root = rng.normal(size=(4, 4)) * 1e-4
        covariance = root @ root.T
        h = 1e-6
        jacobian = np.empty((4, 4))
        for s in range(4):
            step = np.zeros(4)
            step[s] = h
            jacobian[:, s] = (decode(x + step, covariance)[0] - decode(x - step, covariance)[0]) / (2 * h)
        wanted = jacobian @ covariance @ jacobian.T
        np.testing.assert_allclose(decode(x, covariance)[1], wanted, rtol=1e-6, atol=1e-16)


def test_a_prior_is_the_data_sheets_on_every_state() -> None:
    variances = Prior(k=0.02, b_rps=0.3, sigma_rad=0.01).variances()
    np.testing.assert_allclose(np.sqrt(variances), [0.02, 0.3, 0.01, 0.01])


def test_without_data_the_prior_stands() -> None:
    prior = Prior()
    solution = solve(Gram.empty(4), tetrahedron(), prior, np.full(4, 1e-3))
    np.testing.assert_array_equal(solution.x, np.zeros((4, 4)))
    for covariance in solution.covariance:
        np.testing.assert_allclose(covariance, np.diag(prior.variances()))


def test_sums_of_parts_are_the_whole() -> None:
    array, w = tetrahedron(), some_rates(9000)
    y = predicted_output(array, some_states(4), w) + np.random.default_rng(1).normal(size=(9000, 4))
    parts = Gram.of(w[:1234], y[:1234]) + Gram.of(w[1234:], y[1234:])
    whole = Gram.of(w, y)
    assert parts.rows == whole.rows == 9000
    np.testing.assert_allclose(parts.products, whole.products, rtol=1e-12, atol=1e-9)


def test_the_noise_is_found_in_the_residual_and_weights_are_relative_to_it() -> None:
    array, w = tetrahedron(), some_rates(20_000)
    rng = np.random.default_rng(2)
    states, weight = some_states(4), rng.uniform(0.5, 2.0, 20_000)
    y = predicted_output(array, states, w) + 0.01 * rng.normal(size=(20_000, 4)) / weight[:, None]
    solution = solve(Gram.of(w, y, weight), array, Prior())
    np.testing.assert_allclose(solution.noise_rps, 0.01, rtol=0.03)
    for x, p, wanted in zip(solution.x, solution.covariance, states, strict=True):
        found, covariance = decode(x, p)
        assert np.all(np.abs(found - wanted) < 4.5 * np.sqrt(np.diag(covariance)))
