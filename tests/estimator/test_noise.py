"""Noise: its Allan deviation, and what the estimate makes of it."""

from __future__ import annotations

import numpy as np
import pytest
from support import TABLE_1, direct_recording

from estimator.calibration.values import Calibration
from estimator.estimation.calibrate import calibrate
from estimator.geometry.noise import MeansCovariance, NoiseModel, allan_deviation_of_parts, identify

DPH = np.pi / 180 / 3600


def allan_deviation(noise: NoiseModel, tau_s: np.ndarray | float) -> np.ndarray:
    """Return the Allan deviation of a noise at averaging times (IEEE Std 952, Annex C)."""
    flicker = 2 * np.log(2) / np.pi * noise.instability**2
    return np.sqrt(noise.arw**2 / tau_s + flicker + noise.walk**2 * tau_s / 3)


@pytest.mark.filterwarnings("ignore")  # what allantools imports warns of its own
def test_the_overlapping_allan_deviation_is_that_of_allantools() -> None:
    import allantools

    rate = np.cumsum(np.random.default_rng(1).standard_normal((5000, 2)), axis=0)
    tau_s, deviation = allan_deviation_of_parts([rate], 0.01)
    for channel in range(2):
        theirs, wanted, _, _ = allantools.oadev(rate[:, channel], rate=100.0, data_type="freq", taus=tau_s)
        np.testing.assert_allclose(theirs, tau_s, rtol=1e-12)
        np.testing.assert_allclose(deviation[:, channel], wanted, rtol=1e-9)


def test_the_covariance_of_means_has_the_allan_deviation_of_its_model() -> None:
    noise = NoiseModel(arw=0.3, instability=1.0, walk=0.01)
    length_s, n = 20.0, 200
    t_s = (np.arange(n) + 0.5) * length_s
    covariance = MeansCovariance.of(t_s, length_s, np.full(n, length_s)).under(noise)
    difference = np.eye(n - 1, n, 1) - np.eye(n - 1, n)
    found = np.sqrt(0.5 * np.mean(np.diag(difference @ covariance @ difference.T)))
    # The walk is taken at the middle of each mean, and flicker noise ends at a second: a little is left open.
    assert found == pytest.approx(float(allan_deviation(noise, length_s)), rel=0.06)


def test_rests_alone_tell_the_random_walk_and_a_long_one_the_rest() -> None:
    calm = noisy(1, 0.0)
    for gyro in calm.gyros:
        assert gyro.rest is not None
        assert gyro.rest.span_s == pytest.approx(135, abs=2)
        assert gyro.rest.noise.arw == pytest.approx(np.radians(0.005), rel=0.05)
    true = NoiseModel(arw=0.3, instability=0.05, walk=0.002)
    tau_s = np.geomspace(0.1, 20000, 25)
    found = identify(tau_s, allan_deviation(true, tau_s)[:, None], 60000.0)[0]
    assert (found.arw, found.instability, found.walk) == pytest.approx((0.3, 0.05, 0.002), rel=1e-6)


def noisy(seed: int, instability_dph: float, walk_dph_rth: float = 0.0) -> Calibration:
    return calibrate(direct_recording(seed, instability_dph=instability_dph, walk_dph_rth=walk_dph_rth))


def test_bias_instability_is_found_and_told_from_white_noise() -> None:
    quiet, wandering = noisy(1, 0.0), noisy(1, 10.0)
    for gyro in quiet.gyros:
        assert gyro.noise is not None
        assert gyro.noise.instability_below < 6 * DPH
        assert gyro.noise.mean.arw == pytest.approx(np.radians(0.005), rel=0.15)
    found = [gyro.noise.mean.instability / DPH for gyro in wandering.gyros if gyro.noise]
    assert np.median(found) == pytest.approx(10, rel=0.4)
    for calm, loud in zip(quiet.gyros, wandering.gyros, strict=True):
        assert np.all(loud.sd > 1.5 * calm.sd)


def coverage(seeds: int, instability_dph: float, walk_dph_rth: float) -> float:
    inside = []
    for seed in range(seeds):
        gyros = noisy(seed, instability_dph, walk_dph_rth).gyros
        inside += [np.abs(gyro.states - TABLE_1) < 1.96 * gyro.sd for gyro in gyros]
    return float(np.mean(inside))


def test_intervals_hold_under_coloured_noise() -> None:
    # 128 intervals, those of one gyro hanging together: five hundredths of doubt.
    assert coverage(8, 10.0, 10.0) > 0.86
