"""The other methods: right where they can be, silent where they cannot, and no better than the bound."""

from __future__ import annotations

import json

import numpy as np
import pytest

from estimator.errors import EstimatorError
from estimator.estimation.gram import Gram, solve
from estimator.geometry.array import SensorArray, cone, tetrahedron
from estimator.geometry.model import Prior, decode, predicted_output, regressor_maps
from estimator.observations.rows import Observations
from station.campaigns.campaigns import Failure
from station.cli import main
from station.studies.baselines import METHODS, BaselineStudy, MethodSummary, rotation_script, static_script
from station.studies.baselines_results import print_baselines
from station.studies.methods import (
    BaselineEstimate,
    augmented_observation,
    direct_observation,
    least_squares,
    six_position,
    table_rates,
    unseen_directions,
)
from station.studies.paper_filter import bound, covariance_filter
from station.studies.published import tetrahedron_as_printed

DEG = np.pi / 180
NOISE_RPS = 0.05 * DEG
TRUE_STATES = np.array([0.005, 0.1 * DEG, 0.1 * DEG, -0.1 * DEG])
ARRAYS = [tetrahedron(), cone(5, 0.9)]


def rates(rows: int = 6000) -> np.ndarray:
    """Return body rates (rows, 3): rest, then 20 deg/s about x, y, z, a quarter each."""
    w = np.zeros((rows, 3))
    for axis in range(3):
        w[(axis + 1) * rows // 4 : (axis + 2) * rows // 4, axis] = 20 * DEG
    return w


def outputs(array: SensorArray, w: np.ndarray, seed: int = 1, noise_rps: float = NOISE_RPS) -> np.ndarray:
    states = np.tile(TRUE_STATES, (len(array), 1))
    noise = np.random.default_rng(seed).normal(0, noise_rps, (len(w), len(array)))
    return predicted_output(array, states, w) - noise


def six_rotations(array: SensorArray, seed: int) -> BaselineEstimate:
    pairs = []
    for axis in range(3):
        both = [np.tile(sign * 20 * DEG * np.eye(3)[axis], (1000, 1)) for sign in (1, -1)]
        plus, minus = (Observations(w, outputs(array, w, 10 * seed + 2 * axis + i)) for i, w in enumerate(both))
        pairs.append((plus, minus))
    return six_position(pairs, array)


@pytest.mark.parametrize("array", ARRAYS)
def test_least_squares_is_the_batch_estimate_under_a_prior_that_says_nothing(array: SensorArray) -> None:
    w = rates()
    y = outputs(array, w)
    found = least_squares(w, y, array)
    batch = solve(Gram.of(w, y), array, Prior(1e3, 1e3, 1e3))
    decoded = [decode(x, covariance) for x, covariance in zip(batch.x, batch.covariance, strict=True)]
    np.testing.assert_allclose(found.states, [states for states, _ in decoded], atol=1e-9)
    np.testing.assert_allclose(found.sd, [np.sqrt(np.diag(c)) for _, c in decoded], rtol=1e-6)


@pytest.mark.parametrize("array", ARRAYS)
def test_null_space_augmentation_finds_the_states_of_least_squares(array: SensorArray) -> None:
    w = rates()
    y = outputs(array, w)
    augmented, plain = augmented_observation(w, y, array), least_squares(w, y, array)
    np.testing.assert_allclose(augmented.states, plain.states, atol=1e-6 * plain.sd.min())
    np.testing.assert_allclose(augmented.sd, plain.sd, rtol=0.05)  # one noise for all gyros here, one each there
    assert augmented.operations > 0
    assert not len(augmented.unseen)


@pytest.mark.parametrize("array", [*ARRAYS, tetrahedron_as_printed()])
def test_what_is_named_unseen_leaves_the_table_rates_as_they_are(array: SensorArray) -> None:
    w, n = rates(400), len(array)
    regressors = np.column_stack([np.ones(len(w)), w])
    directions = unseen_directions(array, table_rates(array))
    assert directions.shape == (4 * (n - 3), n, 4)
    assert np.linalg.matrix_rank(directions.reshape(len(directions), -1)) == len(directions)
    for direction in directions:
        change = np.einsum("rj,nij,ni->rn", regressors, regressor_maps(array), direction)
        assert np.abs(change).max() > 0.01
        assert np.abs(change @ table_rates(array).T).max() < 1e-12


def test_direct_observation_claims_no_state_of_a_tetrahedron_and_every_state_of_three_gyros() -> None:
    w = rates()
    four, three = tetrahedron(), tetrahedron().select([1, 2, 3])
    found = direct_observation(w, outputs(four, w), four)
    assert np.isnan(found.states).all()
    assert np.isnan(found.sd).all()
    assert len(found.unseen) == 4
    y = outputs(three, w)
    np.testing.assert_allclose(direct_observation(w, y, three).states, least_squares(w, y, three).states, atol=1e-9)


@pytest.mark.parametrize("array", [*ARRAYS, tetrahedron_as_printed()])
def test_six_rotations_are_unbiased_within_their_sigmas(array: SensorArray) -> None:
    errors = np.array([(e.states - TRUE_STATES) / e.sd for e in (six_rotations(array, seed) for seed in range(40))])
    # Means of 40 of unit variance: four sigmas of the mean, and of the rms over all.
    assert np.abs(errors.mean(axis=0)).max() < 4 / np.sqrt(40)
    assert np.sqrt(np.mean(errors**2)) == pytest.approx(1.0, abs=4 / np.sqrt(2 * errors.size / 4))


def test_six_positions_give_the_classic_formula() -> None:
    array, rate = tetrahedron(), 20 * DEG
    means = {}
    for axis in range(3):
        for sign in (1, -1):
            w = np.tile(sign * rate * np.eye(3)[axis], (50, 1))
            means[axis, sign] = Observations(w, outputs(array, w, 7 + axis + sign))
    found = six_position([(means[axis, 1], means[axis, -1]) for axis in range(3)], array)
    y = {key: position.y_rps.mean(axis=0) for key, position in means.items()}
    row = np.column_stack([(y[axis, 1] - y[axis, -1]) / (2 * rate) for axis in range(3)])
    np.testing.assert_allclose(found.states[:, 0], 1 - np.einsum("ij,ij->i", row, array.p), atol=1e-12)
    np.testing.assert_allclose(found.states[:, 1], -np.mean(list(y.values()), axis=0), atol=1e-12)


def test_six_positions_that_do_not_span_space_are_refused() -> None:
    array = tetrahedron()
    w = np.tile([0.0, 0.0, 0.3], (10, 1))
    pair = (Observations(w, outputs(array, w)), Observations(-w, outputs(array, -w)))
    with pytest.raises(EstimatorError, match="three directions"):
        six_position([pair, pair, pair], array)


def test_the_filter_on_every_sample_ends_where_the_batch_estimate_does() -> None:
    array, w = tetrahedron(), rates(2000)
    y = outputs(array, w)
    run = covariance_filter(w, y, array, np.sqrt(Prior().variances()), NOISE_RPS, every=500)
    batch = solve(Gram.of(w, y), array, Prior(), np.full(4, NOISE_RPS))
    sd = np.sqrt(np.diagonal(batch.covariance, axis1=1, axis2=2))
    assert list(run.rows) == [499, 999, 1499, 1999]
    assert np.abs((run.x[-1] - batch.x) / sd).max() < 1e-6
    np.testing.assert_allclose(run.covariance[-1], batch.covariance, rtol=1e-6, atol=1e-16)
    assert run.operations == 2000 * 26496


def test_the_bound_is_the_sigma_of_the_batch_estimate_in_white_noise_and_grows_with_the_bias() -> None:
    array, w = tetrahedron(), rates(2000)
    states = np.tile(TRUE_STATES, (4, 1))
    row_s, arw = 0.2, 0.005 * DEG
    white = bound(w, array, states, Prior(), row_s, arw)
    batch = solve(Gram.of(w, outputs(array, w)), array, Prior(), np.full(4, arw / np.sqrt(row_s)))
    np.testing.assert_allclose(white[:, :2], np.sqrt(np.diagonal(batch.covariance, axis1=1, axis2=2))[:, :2], rtol=1e-6)
    wandering = bound(w, array, states, Prior(), row_s, arw, ((2 * DEG / 3600, 100.0),))
    assert (wandering > white).all()


def test_methods_agree_where_they_must_and_are_silent_where_they_should(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["study", "baselines", "--seeds", "1", "--jobs", "1", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    static, rotating, direct, augmented, squares, kalman, ours = found["methods"]
    assert direct["rms_error"] == [None] * 4
    assert len(found["unseen_by_table_rates"]) == 4
    assert static["rms_error"][1] > 2e4  # ppm of k, where 5000 is the set value
    assert rotating["rms_error"][1] < 200
    np.testing.assert_allclose(augmented["rms_error"], squares["rms_error"], rtol=1e-6)
    np.testing.assert_allclose(kalman["rms_error"], squares["rms_error"], rtol=0.01)
    assert (np.array(ours["rms_error"]) < 3 * np.array(ours["rms_stated_sigma"])).all()
    assert kalman["operations_a_sample"] > 100 * ours["operations_a_sample"]
    assert found["failed"] == []


def test_the_table_of_methods_shows_errors_sigmas_and_cost_and_what_is_not_seen(
    capsys: pytest.CaptureFixture[str],
) -> None:
    methods = [
        MethodSummary(
            name=name,
            rms=np.array([4e-4, 20.0 + number, 1e-3, 1e-3]) if number != 2 else np.full(4, np.nan),
            stated=np.array([2e-4, 20.0, 1e-3, 1e-3]),
            seconds=0.012,
            operations_a_sample=100.0,
        )
        for number, (name, *_) in enumerate(METHODS)
    ]
    failed = (Failure("7", "out of memory"),)
    print_baselines(BaselineStudy(methods=tuple(methods), unseen=("biases: +0.50 b1",), seeds=19, failures=failed))
    printed = capsys.readouterr().out
    assert "over 19 seeds" in printed
    assert printed.count("unseen") == 8
    assert "k within 21 to 26 ppm" in " ".join(printed.split())
    assert "2.00" in printed
    assert "biases: +0.50 b1" not in printed
    assert max(len(line.rstrip()) for line in printed.splitlines()) <= 80


def test_the_scripts_of_the_six_positions_take_as_long_as_the_papers() -> None:
    for script in (static_script(), rotation_script()):
        assert script.least_s == pytest.approx(360.0)
    turned = [step.turn_rad / (2 * np.pi) for step in rotation_script().steps]
    np.testing.assert_allclose(np.abs(turned), 3.0)
