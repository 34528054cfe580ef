"""Body rate, Earth rate and gravity of a gimbal chain, against rotation matrices and against the twins."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from estimator.errors import RecordingError
from estimator.geometry.kinematics import (
    EARTH_RATE_RPS,
    GRAVITY_MPS2,
    Site,
    body_rate,
    check_gimbals,
    into_body,
    specific_force,
)
from sims.physics.body import Body
from sims.physics.motion import AxisMotion

CHAINS = [tuple(c) for n in (1, 2, 3) for c in itertools.permutations("xyz", n)]
SITE = Site(np.radians(47.3), np.radians(130.0))


def matrix(axis: str, angle: float) -> np.ndarray:
    """Return the rotation about x, y or z that turns body vectors into the frame outside the gimbal."""
    c, s = np.cos(angle), np.sin(angle)
    return {
        "x": np.array([[1, 0, 0], [0, c, -s], [0, s, c]]),
        "y": np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]),
        "z": np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]),
    }[axis]


def attitude(gimbals: tuple[str, ...], angles: np.ndarray) -> np.ndarray:
    """Return the matrix from body to base, outermost gimbal first."""
    out = np.eye(3)
    for axis, angle in zip(gimbals, angles, strict=True):
        out = out @ matrix(axis, float(angle))
    return out


def swing(t_s: float, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return angles and rates of n gimbals that move all at once."""
    frequency = np.array([0.7, 1.1, 1.9])[:n]
    phase = np.array([0.3, 1.4, -0.8])[:n]
    return 1.2 * np.sin(frequency * t_s + phase), 1.2 * frequency * np.cos(frequency * t_s + phase)


@pytest.mark.parametrize("gimbals", CHAINS, ids="".join)
def test_body_rate_is_the_change_of_attitude(gimbals: tuple[str, ...]) -> None:
    h = 1e-5
    for t_s in (0.0, 0.9, 2.3):
        before, _ = swing(t_s - h, len(gimbals))
        after, _ = swing(t_s + h, len(gimbals))
        here, rates = swing(t_s, len(gimbals))
        change = (attitude(gimbals, after) - attitude(gimbals, before)) / (2 * h)
        skew = attitude(gimbals, here).T @ change
        wanted = [skew[2, 1], skew[0, 2], skew[1, 0]]
        np.testing.assert_allclose(body_rate(here[None], rates[None], gimbals)[0], wanted, atol=1e-8)


@pytest.mark.parametrize("gimbals", CHAINS, ids="".join)
def test_earth_rate_adds_to_the_body_rate_as_a_base_vector(gimbals: tuple[str, ...]) -> None:
    angles, rates = swing(1.7, len(gimbals))
    with_earth = body_rate(angles[None], rates[None], gimbals, SITE)[0]
    without = body_rate(angles[None], rates[None], gimbals)[0]
    wanted = attitude(gimbals, angles).T @ SITE.earth_rate_rps()
    np.testing.assert_allclose(with_earth - without, wanted, atol=1e-15)


def test_the_order_is_the_papers_for_a_table_of_three_axes() -> None:
    angles, rates = swing(0.4, 3)
    z, y, x = angles
    zdot, ydot, xdot = rates
    inner = matrix("y", y).T @ [0, 0, zdot] + [0, ydot, 0]
    wanted = matrix("x", x).T @ inner + [xdot, 0, 0]
    np.testing.assert_allclose(body_rate(angles[None], rates[None], "zyx")[0], wanted, atol=1e-15)


def test_a_turn_about_one_axis_at_home_is_about_the_body_axis() -> None:
    for i, axis in enumerate("zyx"):
        rates = np.zeros((1, 3))
        rates[0, i] = 0.3
        wanted = 0.3 * (np.array(["x", "y", "z"]) == axis)
        np.testing.assert_array_equal(body_rate(np.zeros((1, 3)), rates, "zyx")[0], wanted)


@pytest.mark.parametrize(
    ("latitude_deg", "heading_deg", "wanted"),
    [(90, 0, [0, 0, 1]), (-90, 20, [0, 0, -1]), (0, 0, [1, 0, 0]), (0, 90, [0, 1, 0]), (0, 180, [-1, 0, 0])],
)
def test_earth_rate_at_home_points_to_the_pole(latitude_deg: float, heading_deg: float, wanted: list[float]) -> None:
    site = Site(np.radians(latitude_deg), np.radians(heading_deg))
    np.testing.assert_allclose(site.earth_rate_rps(), EARTH_RATE_RPS * np.array(wanted), atol=1e-19)
    at_rest = body_rate(np.zeros((1, 3)), np.zeros((1, 3)), "zyx", site)[0]
    np.testing.assert_array_equal(at_rest, site.earth_rate_rps())


def test_earth_rate_has_its_size_at_any_attitude() -> None:
    assert np.degrees(EARTH_RATE_RPS) * 3600 == pytest.approx(15.041, abs=5e-4)
    angles = np.random.default_rng(2).uniform(-9, 9, (50, 3))
    at_rest = body_rate(angles, np.zeros((50, 3)), "zyx", SITE)
    np.testing.assert_allclose(np.linalg.norm(at_rest, axis=1), EARTH_RATE_RPS)


def test_turning_the_table_about_up_is_turning_its_heading() -> None:
    turned = body_rate(np.array([[np.radians(90.0), 0, 0]]), np.zeros((1, 3)), "zyx", Site(0.8, 0.0))[0]
    # The body's x axis turned to the left, to the west of a base that looks north: a heading of -90 deg.
    np.testing.assert_allclose(turned, Site(0.8, np.radians(-90.0)).earth_rate_rps(), atol=1e-19)


@pytest.mark.parametrize(
    ("angles_deg", "wanted"),
    [
        ([0, 0, 0], [0, 0, 1]),
        ([77, 0, 0], [0, 0, 1]),
        ([0, 90, 0], [-1, 0, 0]),
        ([0, 0, 90], [0, 1, 0]),
        ([0, 180, 0], [0, 0, -1]),
        ([0, 0, -30], [0, -0.5, np.sqrt(0.75)]),
    ],
)
def test_a_table_at_rest_feels_one_g_upwards(angles_deg: list[float], wanted: list[float]) -> None:
    force = specific_force(np.radians([angles_deg]), "zyx")[0]
    np.testing.assert_allclose(force, GRAVITY_MPS2 * np.array(wanted), atol=1e-12)


def test_a_base_vector_is_turned_by_the_transposed_attitude() -> None:
    angles, _ = swing(2.2, 3)
    v = np.array([0.3, -1.2, 0.7])
    np.testing.assert_allclose(into_body(v, angles[None], "zxy")[0], attitude(("z", "x", "y"), angles).T @ v)


@pytest.mark.parametrize("gimbals", CHAINS, ids="".join)
def test_the_twins_body_turns_alike(gimbals: tuple[str, ...]) -> None:
    motions = {axis: AxisMotion(0.4 * i, 10.0, 10.0) for i, axis in enumerate(gimbals)}
    for i, motion in enumerate(motions.values()):
        motion.jog(0.5 * i, (-1) ** i * (0.5 + 0.4 * i), 0.3)
    body = Body(
        gimbals=gimbals,
        angles=lambda axis, t: motions[axis].angles(t),
        revision=lambda: 0,
        latitude_rad=SITE.latitude_rad,
        heading_rad=SITE.heading_rad,
    )
    t_s = np.arange(0.013, 12.0, 0.05)
    # Where an acceleration begins or ends, a finite difference sees some of either.
    states = np.array([[motions[g].at(float(t)) for g in gimbals] for t in t_s])
    wanted = body_rate(states[:, :, 0], states[:, :, 1], gimbals, SITE)
    np.testing.assert_allclose(body.rate_rps(t_s), wanted, atol=1e-7)


@pytest.mark.parametrize("gimbals", ["", "xx", "xyzx", ["x", "w"], ["xy"], ["X"]])
def test_gimbals_are_different_ones_of_x_y_z(gimbals: str | list[str]) -> None:
    with pytest.raises(RecordingError, match="gimbals must be different ones of x, y, z"):
        check_gimbals(gimbals)


def test_gimbals_come_back_in_their_order() -> None:
    assert check_gimbals("zyx") == ("z", "y", "x")
    assert check_gimbals(["y"]) == ("y",)
