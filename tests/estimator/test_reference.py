"""Body rates from attitudes."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from estimator.estimation.calibrate import calibrate
from estimator.geometry.array import triad
from estimator.recordings.recording import ImuData, Recording
from estimator.recordings.reference import AttitudeReadings


def attitudes(axis: np.ndarray, rate_rps: float, count: int = 200, step_ns: int = 5_000_000) -> AttitudeReadings:
    """Attitudes of a body that turns at a constant rate about an axis fixed to it."""
    t_ns = np.arange(count, dtype=np.int64) * step_ns
    half = 0.5 * rate_rps * t_ns * 1e-9
    return AttitudeReadings(t_ns, np.column_stack([np.cos(half), np.sin(half)[:, None] * axis]))


AXIS = np.array([2.0, -3.0, 6.0]) / 7


@pytest.mark.parametrize("rate_rps", [0.0, 1e-4, 1.0, -1.0, 300.0])
def test_a_constant_rate_comes_back_about_its_body_axis(rate_rps: float) -> None:
    rates = attitudes(AXIS, rate_rps).external_rates()
    np.testing.assert_allclose(rates.rate_rps, np.tile(rate_rps * AXIS, (199, 1)), atol=1e-9 * max(abs(rate_rps), 1))


def test_rates_are_stamped_between_the_attitudes() -> None:
    rates = attitudes(AXIS, 1.0).external_rates()
    np.testing.assert_array_equal(rates.t_ns, np.arange(199) * 5_000_000 + 2_500_000)


def test_a_quaternion_and_its_negative_are_one_attitude() -> None:
    plain = attitudes(AXIS, 2.0)
    flips = np.where(np.arange(200) % 3 == 0, -1.0, 1.0)[:, None]
    flipped = AttitudeReadings(plain.t_ns, plain.attitude_wxyz * flips)
    np.testing.assert_allclose(flipped.external_rates().rate_rps, plain.external_rates().rate_rps, atol=1e-12)


def test_the_rate_is_in_body_axes_however_the_reference_frame_lies() -> None:
    plain = attitudes(AXIS, 2.0)
    w, v = plain.attitude_wxyz[:, :1], plain.attitude_wxyz[:, 1:]
    a, b = 0.6, np.array([0.0, 0.8, 0.0])  # a fixed turn of the reference frame, applied from the left
    turned = np.hstack([a * w - v @ b[:, None], a * v + w * b + np.cross(b, v)])
    rates = AttitudeReadings(plain.t_ns, turned).external_rates()
    np.testing.assert_allclose(rates.rate_rps, np.tile(2.0 * AXIS, (199, 1)), atol=1e-9)


def test_nothing_is_said_beside_lost_attitudes() -> None:
    plain = attitudes(AXIS, 2.0)
    q = plain.attitude_wxyz.copy()
    q[100:110] = np.nan
    lost = np.isnan(AttitudeReadings(plain.t_ns, q).external_rates().rate_rps).all(axis=1)
    np.testing.assert_array_equal(np.flatnonzero(lost), np.arange(99, 110))


def test_nothing_is_said_over_a_gap_in_the_stamps() -> None:
    plain = attitudes(AXIS, 2.0)
    keep = (np.arange(200) < 100) | (np.arange(200) >= 140)
    rates = AttitudeReadings(plain.t_ns[keep], plain.attitude_wxyz[keep]).external_rates()
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(rates.rate_rps).all(axis=1)), [99])


@cache
def swing() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Instants (s), body rates and attitudes of a body that swings about all axes for two minutes."""
    t_s = np.arange(12_000) * 0.01
    w = 1.5 * np.column_stack([np.sin(0.25 * t_s), np.sin(0.31 * t_s + 1), np.cos(0.37 * t_s)])
    q = np.empty((len(t_s), 4))
    q[0] = [1, 0, 0, 0]
    turns = 0.5 * (w[1:] + w[:-1]) * 0.01
    for i, turn in enumerate(turns):
        angle = float(np.linalg.norm(turn))
        dw, dv = np.cos(angle / 2), np.sin(angle / 2) * turn / angle
        a, b = q[i, 0], q[i, 1:]
        q[i + 1] = [a * dw - b @ dv, *(a * dv + dw * b + np.cross(b, dv))]
    return t_s, w, q


def swinging(seed: int, error_correlation: float) -> Recording:
    """A triad with k = 2000 ppm beside attitudes; its noise is white or correlated from one 0.1 s to the next."""
    rng = np.random.default_rng(seed)
    t_s, w, q = swing()
    blocks = rng.normal(size=(len(t_s) // 10, 3))
    for i in range(1, len(blocks)):
        blocks[i] = error_correlation * blocks[i - 1] + np.sqrt(1 - error_correlation**2) * blocks[i]
    rate = 0.998 * w + 0.01 * np.repeat(blocks, 10, axis=0)
    t_ns = np.round(t_s * 1e9).astype(np.int64)
    return Recording({"imu": ImuData(triad(), t_ns, rate)}, AttitudeReadings(t_ns, q))


@pytest.mark.parametrize(
    ("error_correlation", "seeds"), [(0.9, 8), *(pytest.param(one, 24, marks=pytest.mark.full) for one in (0.0, 0.9))]
)
def test_sigmas_against_attitudes_are_true_whether_the_error_is_white_or_not(
    error_correlation: float, seeds: int
) -> None:
    scores = []
    for seed in range(seeds):
        calibration = calibrate(swinging(seed, error_correlation))
        scores += [(g.states - [0.002, 0, 0, 0]) / g.sd for g in calibration.gyros]
    rms = float(np.sqrt(np.mean(np.square(scores))))
    assert 0.6 < rms < 1.5


def test_a_coloured_residual_is_told() -> None:
    assert any("the residual is not white" in note for note in calibrate(swinging(1, 0.9)).notes)
    assert not any("the residual is not white" in note for note in calibrate(swinging(1, 0.0)).notes)
