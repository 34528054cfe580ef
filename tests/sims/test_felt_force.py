"""Accelerometers of the twins: the specific force where each one sits, by the physics of a turning body."""

from __future__ import annotations

import numpy as np
import pytest

from sims.physics.accelerometer import Accelerometers, AccelerometerTruth
from sims.physics.body import Body
from sims.physics.geometry import MOUNTS_DEG, mounted
from sims.physics.motion import AxisMotion

DEG = np.pi / 180
G = 9.80665
TRIAD = mounted(MOUNTS_DEG["triad"])
NONE = np.zeros(3)


def body_on(motions: dict[str, AxisMotion]) -> Body:
    return Body(
        gimbals=tuple(motions),
        angles=lambda axis, t: motions[axis].angles(t),
        revision=lambda: 0,
        latitude_rad=np.pi / 4,
        heading_rad=0.0,
    )


def outputs(body: Body, t_s: np.ndarray, rate_hz: float = 100.0, **errors: object) -> np.ndarray:
    """Return what the accelerometers put out at instants, with these errors and no others."""
    stated = {"k": NONE, "b_mps2": NONE, "sigma_j_rad": NONE, "sigma_k_rad": NONE, "places_m": np.zeros((3, 3))}
    truth = AccelerometerTruth(**{**stated, **errors})
    sensors = Accelerometers(mounting=TRIAD, truth=truth, body=body, rate_hz=rate_hz, seed=(1,))
    return sensors.sample_all(t_s)


def standing(axis: str, angle_deg: float) -> Body:
    return body_on({axis: AxisMotion(angle_deg * DEG, 10.0, 10.0)})


@pytest.mark.parametrize(
    ("axis", "angle_deg", "up"),
    [("x", 0, (0, 0, 1)), ("x", 90, (0, 1, 0)), ("y", 90, (-1, 0, 0)), ("x", 180, (0, 0, -1))],
)
def test_at_rest_gravity_points_up(axis: str, angle_deg: float, up: tuple[int, ...]) -> None:
    felt = outputs(standing(axis, angle_deg), np.array([1.0]))[0]
    np.testing.assert_allclose(felt, G * np.array(up), atol=1e-4)


def test_a_steady_turn_pulls_inwards_with_the_square_of_the_rate() -> None:
    motion = AxisMotion(0.0, 10.0, 10.0)
    motion.jog(0.0, 2.0, 10.0)
    felt = outputs(body_on({"z": motion}), np.array([5.0]), places_m=np.tile([0.1, 0.0, 0.3], (3, 1)))[0]
    np.testing.assert_allclose(felt, [-0.1 * 2.0**2, 0.0, G], atol=1e-4)


def test_a_ramp_pushes_along_the_circle() -> None:
    motion = AxisMotion(0.0, 10.0, 10.0)
    motion.jog(0.0, 5.0, 2.0)
    felt = outputs(body_on({"z": motion}), np.array([0.5]), places_m=np.tile([0.1, 0.0, 0.0], (3, 1)))[0]
    np.testing.assert_allclose(felt[:2], [-0.1 * 1.0**2, 0.1 * 2.0], atol=1e-4)


def test_the_states_are_those_of_the_model_of_a_gyro() -> None:
    """y = (1 - k) (p - sigma_k j + sigma_j k) . f - b, with the axes p, j, k of each."""
    k = np.array([0.01, -0.02, 0.005])
    b = np.array([0.1, -0.2, 0.3])
    sigma_j = np.array([0.004, -0.002, 0.003])
    sigma_k = np.array([-0.001, 0.006, 0.002])
    body = standing("x", 30.0)
    force = outputs(body, np.array([1.0]))[0]
    felt = outputs(body, np.array([1.0]), k=k, b_mps2=b, sigma_j_rad=sigma_j, sigma_k_rad=sigma_k)[0]
    in_body = np.linalg.solve(TRIAD.p, force)
    sense = TRIAD.p - sigma_k[:, None] * TRIAD.j + sigma_j[:, None] * TRIAD.k
    np.testing.assert_allclose(felt, (1 - k) * (sense @ in_body) - b, atol=1e-6)


def test_a_late_output_shows_an_earlier_pose() -> None:
    motion = AxisMotion(0.0, 10.0, 10.0)
    motion.jog(0.0, 1.0, 10.0)
    late = outputs(body_on({"x": motion}), np.array([3.05]), delay_s=0.05)
    early = outputs(body_on({"x": motion}), np.array([3.0]))
    np.testing.assert_allclose(late, early, atol=1e-6)


@pytest.mark.parametrize(
    ("effect", "value", "expected_g"),
    [
        ("asymmetry", 0.01, 0.005),
        ("k2_pg", 0.002, 0.002),
        ("k3_pg2", 0.003, -0.003),
    ],
)
def test_a_hidden_effect_changes_the_output_as_its_name_says(effect: str, value: float, expected_g: float) -> None:
    """The accelerometer along z, upside down, feels -1 g."""
    body = standing("x", 180.0)
    change = outputs(body, np.array([1.0]), **{effect: np.full(3, value)}) - outputs(body, np.array([1.0]))
    assert change[0, 2] == pytest.approx(expected_g * G, rel=1e-3)


def test_the_noise_is_that_of_the_data_sheet() -> None:
    vrw = 1e-3
    felt = outputs(standing("x", 0.0), np.arange(20000) / 100.0, vrw_mps2_rthz=vrw)
    np.testing.assert_allclose(felt.std(axis=0), vrw * 10.0, rtol=0.03)


def test_outputs_come_in_steps() -> None:
    felt = outputs(standing("x", 10.0), np.arange(50) / 100.0, step_mps2=0.05, vrw_mps2_rthz=0.01)
    np.testing.assert_allclose(felt / 0.05, np.round(felt / 0.05), atol=1e-9)
