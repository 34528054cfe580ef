"""Turns and outputs over the same intervals."""

from __future__ import annotations

import numpy as np

from estimator.observations.turned import Turned
from estimator.recordings.reference import AttitudeReadings, RateReadings, TableReadings


def ns(t_s: np.ndarray) -> np.ndarray:
    return np.round(t_s * 1e9).astype(np.int64)


def test_means_are_differences_of_angles_whatever_lies_between() -> None:
    t_s = np.sort(np.random.default_rng(0).uniform(0, 10, 900))
    angle = np.sin(t_s)
    table = TableReadings(t_ns=ns(t_s), angle_rad=angle[:, None], rate_rps=np.zeros((900, 1)), gimbals=("y",))
    assert table.by_turns
    body = Turned.of_reference(table, None)
    first, last = t_s[100:110], t_s[400:410]
    expected = (np.sin(last) - np.sin(first)) / (last - first)
    np.testing.assert_allclose(body.means(first, last)[:, 1], expected, atol=1e-8)
    np.testing.assert_allclose(body.means(first, last)[:, [0, 2]], 0)
    np.testing.assert_allclose(body.means(first - 0.01, last - 0.01)[:, 1], expected, atol=0.02)


def test_what_lies_in_a_gap_is_not_known() -> None:
    t_s = np.concatenate([np.arange(0, 4, 0.01), np.arange(5, 9, 0.01)])
    gyro = Turned.of_rates(ns(t_s), np.ones((len(t_s), 2)))
    known = gyro.means(np.array([1.0, 3.0, 6.0, 8.5]), np.array([2.0, 6.0, 7.0, 9.5]))
    assert np.isfinite(known).all(axis=1).tolist() == [True, False, True, False]


def test_an_attitude_turns_about_body_axes_and_is_lost_where_markers_are() -> None:
    t_s = np.arange(0, 10, 0.01)
    half = 0.5 * 0.3 * t_s
    q = np.column_stack([np.cos(half), np.sin(half), 0 * half, 0 * half])
    q[500:520] = np.nan
    body = Turned.of_reference(AttitudeReadings(ns(t_s), q), None)
    means = body.means(np.array([1.0, 4.9]), np.array([2.0, 5.3]))
    np.testing.assert_allclose(means[0], [0.3, 0, 0], atol=1e-9)
    assert np.isnan(means[1]).all()


def test_rests_are_stated_by_two_readings() -> None:
    body = Turned.of_reference(RateReadings(ns(np.array([0.0, 60.0])), np.zeros((2, 3))), None)
    np.testing.assert_allclose(body.means(np.array([10.0]), np.array([50.0])), 0)
