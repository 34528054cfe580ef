"""Gyros of the twins: their noise is what their data sheet says, and their truth is the table's."""

from __future__ import annotations

import numpy as np
import pytest

from sims.physics.body import Body
from sims.physics.geometry import MOUNTS_DEG, mounted
from sims.physics.gyro import GyroArray, GyroTruth
from sims.physics.motion import AxisMotion
from sims.physics.wander import Wander

DEG = np.pi / 180
MOUNTING = mounted(MOUNTS_DEG["tetrahedron"])
NONE = np.zeros(4)


def turntable() -> tuple[Body, AxisMotion]:
    motion = AxisMotion(0.0, 10.0, 10.0)
    return Body(
        gimbals="z",
        angles=lambda _axis, t: motion.angles(t),
        revision=lambda: motion.revision,
        latitude_rad=np.pi / 4,
        heading_rad=0.0,
    ), motion


def gyros(
    *,
    arw: float = 0.0,
    instability: float = 0.0,
    rate_hz: float = 100.0,
    seed: int = 1,
    states: np.ndarray | None = None,
    body: Body | None = None,
) -> GyroArray:
    k, b, sigma_j, sigma_k = np.zeros((4, 4)) if states is None else states.T
    truth = GyroTruth(k, b, sigma_j, sigma_k, arw, instability)
    return GyroArray(mounting=MOUNTING, truth=truth, body=body or turntable()[0], rate_hz=rate_hz, seed=(seed,))


def sampled(array: GyroArray, duration_s: float, rate_hz: float = 100.0, per_call: int = 10) -> np.ndarray:
    t_s = np.arange(1, round(duration_s * rate_hz) + 1) / rate_hz
    return np.vstack([array.sample(t_s[i : i + per_call]) for i in range(0, len(t_s), per_call)])


def allan_deviation(rate: np.ndarray, n: int, period_s: float) -> np.ndarray:
    """Return the overlapping Allan deviation of columns over clusters of n samples."""
    angle = np.vstack([np.zeros(rate.shape[1]), np.cumsum(rate, axis=0)]) * period_s
    second = angle[2 * n :] - 2 * angle[n:-n] + angle[: -2 * n]
    return np.sqrt(np.mean(second**2, axis=0) / 2) / (n * period_s)


@pytest.mark.parametrize(("rate_hz", "per_call"), [(100.0, 1), (100.0, 10), (500.0, 5), (2000.0, 20)])
def test_white_noise_is_the_angle_random_walk_times_the_root_of_the_rate(rate_hz: float, per_call: int) -> None:
    arw = 0.005 * DEG
    out = sampled(gyros(arw=arw, rate_hz=rate_hz), 4000 / rate_hz, rate_hz, per_call)
    assert out.shape == (4000, 4)
    np.testing.assert_allclose(out.std(axis=0), arw * np.sqrt(rate_hz), rtol=0.06)
    correlation = np.corrcoef(np.hstack([out[1:], out[:-1]]).T)
    assert np.abs(correlation[~np.eye(8, dtype=bool)]).max() < 0.08


def test_the_same_seed_gives_the_same_samples() -> None:
    first, second, other = (sampled(gyros(arw=1e-3, instability=1e-4, seed=seed), 20.0) for seed in (7, 7, 8))
    np.testing.assert_array_equal(first, second)
    assert np.abs(first - other).min() > 0


@pytest.mark.parametrize("tau_s", [1.0, 3.0, 10.0, 30.0])
def test_bias_instability_is_the_floor_of_the_allan_deviation(tau_s: float) -> None:
    instability = 3.0 * DEG / 3600
    out = np.hstack([sampled(gyros(instability=instability, rate_hz=10.0, seed=s), 2000.0, 10.0) for s in range(3)])
    deviation = np.sqrt(np.mean(allan_deviation(out, round(tau_s * 10), 0.1) ** 2))
    assert deviation == pytest.approx(0.664 * instability, rel=0.25)


def test_without_noise_the_output_is_the_error_model_of_the_true_rate() -> None:
    states = np.random.default_rng(2).uniform(-1, 1, (4, 4)) * 0.02
    body, motion = turntable()
    motion.jog(0.0, 0.7, 0.2)
    out = sampled(gyros(states=states, body=body), 8.0)
    w = body.rate_rps(np.arange(1, 801) / 100)
    k, b, sigma_j, sigma_k = states.T
    pbar = MOUNTING.p - sigma_k[:, None] * MOUNTING.j + sigma_j[:, None] * MOUNTING.k
    np.testing.assert_allclose(out, (1 - k) * (w @ pbar.T) - b, atol=1e-9)


def test_a_table_at_rest_gives_earth_rate_only() -> None:
    pole = np.array([1, 0, 1]) / np.sqrt(2)
    wanted = 2 * np.pi / 86164.0905 * MOUNTING.p @ pole
    np.testing.assert_allclose(sampled(gyros(), 1.0), np.tile(wanted, (100, 1)), atol=1e-11)


@pytest.mark.parametrize("per_call", [1, 2])
def test_a_command_changes_the_truth_from_then_on_and_not_the_noise(per_call: int) -> None:
    (still_body, _), (body, motion) = turntable(), turntable()
    still, moved = (gyros(arw=1e-3, instability=1e-4, body=b) for b in (still_body, body))
    silent = gyros(body=body)
    kept, turned, true = [], [], []
    for first in range(1, 201, per_call):
        t_s = np.arange(first, first + per_call) / 100
        if first == 105:  # in the middle of what had been worked out ahead
            motion.jog(float(t_s[0]), 1.0, 5.0)
        kept.append(still.sample(t_s))
        turned.append(moved.sample(t_s))
        true.append(silent.sample(t_s))
    difference = np.vstack(turned) - np.vstack(kept)
    rest = np.vstack(true)[0]
    np.testing.assert_allclose(difference, np.vstack(true) - rest, atol=1e-12)
    np.testing.assert_array_equal(difference[:103], 0.0)
    assert np.abs(difference[106:]).max(axis=1).min() > 0
    # Gyro 1 looks down: it sees the turn about z with the other sign.
    assert difference[-1, 0] == pytest.approx(-(5.0 * 0.2), rel=1e-3)


def test_gyros_warm_up_to_their_end_temperature() -> None:
    truth = GyroTruth(NONE, NONE, NONE, NONE, 0.0, 0.0, temperature_c=25.0, warming_c=2.0, warming_time_s=300.0)
    array = GyroArray(mounting=MOUNTING, truth=truth, body=turntable()[0], rate_hz=100.0, seed=(1,))
    assert array.temperature_c(0.0) == 25.0
    assert array.temperature_c(300.0) == pytest.approx(25 + 2 * (1 - np.exp(-1)))
    assert array.temperature_c(1e5) == pytest.approx(27.0)


@pytest.mark.parametrize("random_walk", [0.0, 1e-3])
def test_a_bias_wanders_alike_by_single_steps_and_by_many_at_once(random_walk: float) -> None:
    def wander() -> Wander:
        random = np.random.default_rng(3)
        return Wander(count=4, bias_instability=1e-3, random_walk=random_walk, period_s=0.01, random=random)

    singly, together = wander(), wander()
    expected = [singly.step(10) for _ in range(50)]
    np.testing.assert_array_equal(together.steps(10, 30), expected[:30])
    np.testing.assert_array_equal(together.steps(10, 20), expected[30:])
    np.testing.assert_array_equal(together.step(7), singly.step(7))
