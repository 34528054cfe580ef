"""Noise: its Allan deviation, and what the estimate makes of it."""

from __future__ import annotations

import numpy as np
import pytest
from support import TABLE_1, direct_recording

from estimator.calibration.values import Calibration
from estimator.estimation.calibrate import calibrate
from estimator.geometry.noise import MeansCovariance, NoiseModel
from estimator.observations.allan.deviation import degrees_of_freedom, overlapping_deviation
from estimator.observations.allan.duration import record_length_s
from estimator.observations.allan.terms import noise_terms

DPH = np.pi / 180 / 3600


def allan_deviation(noise: NoiseModel, tau_s: np.ndarray | float) -> np.ndarray:
    """Return the Allan deviation of a noise at averaging times (IEEE Std 952, Annex C)."""
    flicker = 2 * np.log(2) / np.pi * noise.instability**2
    return np.sqrt(noise.arw**2 / tau_s + flicker + noise.walk**2 * tau_s / 3)


@pytest.mark.filterwarnings("ignore")  # what allantools imports warns of its own
def test_the_overlapping_allan_deviation_is_that_of_allantools() -> None:
    import allantools

    rate = np.cumsum(np.random.default_rng(1).standard_normal((5000, 2)), axis=0)
    tau_s, deviation = overlapping_deviation([rate], 0.01)
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


def test_rests_alone_tell_the_random_walk_with_its_interval() -> None:
    inside = []
    for gyro in noisy(1, 0.0).gyros:
        assert gyro.rest is not None
        assert gyro.rest.span_s == pytest.approx(135, abs=2)
        n, b, k = gyro.rest.terms.n, gyro.rest.terms.b, gyro.rest.terms.k
        assert n.seen
        assert n.high < 1.05 * n.low
        inside.append(n.low < np.radians(0.005) < n.high)
        assert not b.seen
        assert b.high < 20 * DPH
        assert not k.seen
    assert sum(inside) >= 3


def simulated(random: np.random.Generator, size: tuple[int, int], noise: NoiseModel, period_s: float) -> np.ndarray:
    """Return series (n, m) of white noise, half integrated noise (flicker) and a random walk."""
    longer = 8 * size[0]
    numbers = np.arange(1, longer)
    kernel = np.concatenate([[1.0], np.cumprod((numbers - 0.5) / numbers)])
    white = random.standard_normal((longer, size[1]))
    spectrum = np.fft.rfft(white, 2 * longer, axis=0) * np.fft.rfft(kernel, 2 * longer)[:, None]
    flicker = np.fft.irfft(spectrum, axis=0)[longer - size[0] : longer]
    walk = np.cumsum(random.standard_normal(size), axis=0) * np.sqrt(period_s)
    return np.asarray(
        noise.arw / np.sqrt(period_s) * random.standard_normal(size) + noise.instability * flicker + noise.walk * walk
    )


def test_intervals_of_n_b_and_k_hold_the_truth() -> None:
    true = NoiseModel(arw=1.0, instability=0.3, walk=0.01)
    found = noise_terms([simulated(np.random.default_rng(4), (16000, 60), true, 1.0)], 1.0)
    for name, value in (("N", true.arw), ("B", true.instability), ("K", true.walk)):
        inside = np.mean([terms[name].low <= value <= terms[name].high for terms in found])
        assert inside >= 0.88, name  # 95 % expected of 60: 2.5 sigmas below
        assert np.mean([terms[name].seen for terms in found]) > 0.6, name
        assert np.median([terms[name].value for terms in found]) == pytest.approx(value, rel=0.1)


def test_what_is_not_there_is_at_most_so_much() -> None:
    white = np.random.default_rng(5).standard_normal((4000, 40))
    for terms in noise_terms([white[:1500], white[1500:]], 1.0):
        assert terms.n.low < 1.06
        assert terms.n.high > 0.94
        assert not terms.b.seen
        assert terms.b.low == 0
        assert terms.b.high < 0.15
        assert not terms.k.seen
        assert terms.k.high < 0.02


def test_the_filter_of_a_sensor_does_not_shape_its_random_walk() -> None:
    from scipy.signal import lfilter

    white = np.random.default_rng(6).standard_normal((40000, 4)) * 10
    slow = lfilter([0.3], [1, -0.7], white, axis=0)  # at 0 Hz as large as before it
    for terms in noise_terms([slow], 0.01):
        assert terms.n.low < 1.0 < terms.n.high
        assert terms.n.high < 1.1 * terms.n.low
        assert terms.shortest_s > 0.02


# Of 1000 rate samples, by 20,000 series: the squares of their Allan deviations scatter as chi-square with so many.
@pytest.mark.parametrize(
    ("kind", "expected"),
    [
        (0, (666, 346, 91, 21.2, 5.4, 2.73)),
        (1, (810, 300, 71.6, 16.5, 4.13, 1.87)),
        (2, (999, 238, 56.6, 13.0, 3.14, 1.43)),
    ],
    ids=["white", "flicker", "walk"],
)
def test_degrees_of_freedom_are_those_of_simulated_series(kind: int, expected: tuple[float, ...]) -> None:
    sizes = np.eye(3)[[kind]]
    found = [float(degrees_of_freedom([1000], width, 1.0, sizes)[0]) for width in (1, 4, 16, 64, 200, 330)]
    assert found == pytest.approx(expected, rel=0.02)


def test_the_length_of_a_record_leaves_the_wished_uncertainty() -> None:
    random = np.random.default_rng(7)
    true = NoiseModel(arw=1.0, instability=0.3, walk=0.0)
    first = noise_terms([simulated(random, (20000, 1), true, 1.0)], 1.0)[0]
    wanted_s = record_length_s(first, 1, 0.1)
    found = noise_terms([simulated(random, (round(wanted_s), 80), true, 1.0)], 1.0)
    spread = np.std([terms.b.value for terms in found]) / true.instability
    assert spread == pytest.approx(0.1, rel=0.5)


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
