"""Array geometry: what is ready-made, what is derived, what is refused."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from estimator.errors import GeometryError
from estimator.geometry.array import (
    SensorArray,
    cone,
    dodecahedron,
    sensor_array,
    tetrahedron,
    triad,
)
from sims.physics.geometry import MOUNTS_DEG, mounted
from station.studies.published import tetrahedron_as_printed

READY_MADE: list[Callable[[], SensorArray]] = [
    triad,
    tetrahedron,
    dodecahedron,
    lambda: cone(5, np.radians(54.7)),
    lambda: cone(3, np.radians(10)),
]


@pytest.mark.parametrize("make", READY_MADE)
def test_ready_made_arrays_have_right_handed_triads_of_unit_axes(make: Callable[[], SensorArray]) -> None:
    array = make()
    triads = np.stack([array.p, array.j, array.k], axis=1)
    np.testing.assert_allclose(triads @ triads.transpose(0, 2, 1), np.tile(np.eye(3), (len(array), 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(triads), 1.0)


def test_the_triad_is_the_axes_themselves() -> None:
    np.testing.assert_array_equal(triad().p, np.eye(3))
    assert triad().names == ("x", "y", "z")


def test_the_tetrahedron_is_the_papers_to_its_four_digits() -> None:
    np.testing.assert_allclose(tetrahedron().p, tetrahedron_as_printed().p, atol=5e-5)
    cosines = tetrahedron().p @ tetrahedron().p.T
    np.testing.assert_allclose(cosines[~np.eye(4, dtype=bool)], -1 / 3)


def test_the_dodecahedron_has_its_faces_equally_inclined() -> None:
    cosines = np.abs(dodecahedron().p @ dodecahedron().p.T)
    np.testing.assert_allclose(cosines[~np.eye(6, dtype=bool)], 1 / np.sqrt(5))
    np.testing.assert_allclose(dodecahedron().p.T @ dodecahedron().p, 2 * np.eye(3), atol=1e-12)


def test_a_cone_is_inclined_by_its_half_angle() -> None:
    array = cone(7, np.radians(35))
    assert len(array) == 7
    np.testing.assert_allclose(array.p[:, 2], np.cos(np.radians(35)))
    np.testing.assert_allclose(array.p.mean(axis=0), [0, 0, np.cos(np.radians(35))], atol=1e-12)


@pytest.mark.parametrize("kind", sorted(MOUNTS_DEG))
def test_axes_agree_with_those_of_the_twins(kind: str) -> None:
    array = {"triad": triad, "tetrahedron": tetrahedron, "dodecahedron": dodecahedron}[kind]()
    mounting = mounted(MOUNTS_DEG[kind])
    np.testing.assert_allclose(array.p, mounting.p, atol=1e-12)
    np.testing.assert_allclose(array.j, mounting.j, atol=1e-12)
    np.testing.assert_allclose(array.k, mounting.k, atol=1e-12)


def test_tilt_axes_are_derived_for_any_direction() -> None:
    rng = np.random.default_rng(1)
    p = rng.normal(size=(200, 3))
    p /= np.linalg.norm(p, axis=1, keepdims=True)
    p[0] = [0, 0, 1]
    p[1] = [0, 0, -1]
    p[2] = [1e-4, 0, np.sqrt(1 - 1e-8)]
    p[3] = [1e-7, 0, 1]
    array = sensor_array(p)
    np.testing.assert_allclose(array.k, np.cross(array.p, array.j))
    np.testing.assert_allclose(np.einsum("ij,ij->i", array.p, array.j), 0, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(array.j, axis=1), 1)


def test_explicit_axes_are_kept() -> None:
    p, j = np.eye(3), np.roll(np.eye(3), 1, axis=1)
    array = sensor_array(p, j, np.cross(p, j), names=["a", "b", "c"])
    np.testing.assert_array_equal(array.j, j)
    assert array.names == ("a", "b", "c")


def test_a_left_handed_triad_may_be_stated() -> None:
    p, j = np.eye(3), np.roll(np.eye(3), 1, axis=1)
    np.testing.assert_array_equal(sensor_array(p, j, -np.cross(p, j)).k, -np.cross(p, j))


def test_a_part_of_an_array_need_not_span_space() -> None:
    part = sensor_array([[1, 0, 0]], names=["single"], part_of_array=True)
    assert len(part) == 1
    assert tetrahedron().select([2, 0]).names == ("gyro3", "gyro1")
    np.testing.assert_array_equal(tetrahedron().select([2, 0]).k, tetrahedron().k[[2, 0]])


@pytest.mark.parametrize(
    "p",
    [
        [[1, 0, 0], [0, 1, 0]],
        [[1, 0, 0], [0, 1, 0], [1, 0, 0]],
        [[1, 0, 0], [0, 1, 0], [0.6, 0.8, 0], [0.8, -0.6, 0]],
        [[0, 0, 1], [0, 0, -1], [0, 0, 1]],
        [[1, 0, 0], [0, 1, 0], [np.sqrt(1 - 1e-8), 0, 1e-4]],
    ],
)
def test_axes_that_lie_in_a_plane_are_refused(p: list[list[float]]) -> None:
    with pytest.raises(GeometryError, match="lie in a plane .*rank < 3"):
        sensor_array(p)


@pytest.mark.parametrize("length", [0.0, 0.9, 1.002, -2.0])
def test_a_sense_axis_that_is_no_unit_vector_is_refused_by_name(length: float) -> None:
    p = np.eye(3)
    p[1] *= length
    with pytest.raises(GeometryError, match=f"sense axis of b has length {abs(length):.4g}, not 1"):
        sensor_array(p, names=["a", "b", "c"])


def test_a_skewed_triad_is_refused_by_name() -> None:
    p, j = np.eye(3), np.roll(np.eye(3), 1, axis=1)
    k = np.cross(p, j)
    j[2] = [0.98, 0, 0.199]
    with pytest.raises(GeometryError, match=r"p, j, k of gyro3 are not orthonormal \(error 0.199\)"):
        sensor_array(p, j, k)


def test_the_misprinted_triads_are_refused_unless_taken_as_printed() -> None:
    printed = tetrahedron_as_printed()
    with pytest.raises(GeometryError, match=r"of gyro3 are not orthonormal \(error 0.629\)"):
        sensor_array(printed.p, printed.j, printed.k)
    taken = sensor_array(printed.p, printed.j, printed.k, as_printed=True)
    np.testing.assert_array_equal(taken.j, printed.j)


def test_the_corrected_triads_of_the_paper_are_taken() -> None:
    printed = tetrahedron_as_printed()
    j = printed.j.copy()
    j[2], j[3] = [0.1667, -0.2887, 0.9428], [0.1667, 0.2887, 0.9428]
    assert len(sensor_array(printed.p, j, printed.k)) == 4


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize("which", ["p", "j", "k"])
def test_numbers_that_are_not_finite_are_refused(bad: float, which: str) -> None:
    axes = {"p": np.eye(3), "j": np.roll(np.eye(3), 1, axis=1), "k": np.roll(np.eye(3), 2, axis=1)}
    axes[which][1, 1] = bad
    with pytest.raises(GeometryError, match=f"{which} holds a number that is not finite"):
        sensor_array(**axes)


@pytest.mark.parametrize(
    "p", [[], [1, 0, 0], [[1, 0], [0, 1], [0, 0]], [["a", "b", "c"]], [[1, 0, 0], [0, 1]], np.zeros((2, 3, 3))]
)
def test_what_has_not_three_numbers_a_gyro_is_refused(p: object) -> None:
    with pytest.raises(GeometryError, match="one row of three"):
        sensor_array(p)  # type: ignore[arg-type]


def test_half_of_the_tilt_axes_is_refused() -> None:
    with pytest.raises(GeometryError, match="both tilt axes"):
        sensor_array(np.eye(3), j=np.roll(np.eye(3), 1, axis=1))
    with pytest.raises(GeometryError, match="same shape"):
        sensor_array(np.eye(3), np.eye(3)[:2], np.eye(3)[:2])


@pytest.mark.parametrize("names", [["a", "b"], ["a", "b", "a"]])
def test_every_gyro_needs_a_name_of_its_own(names: list[str]) -> None:
    with pytest.raises(GeometryError, match="3 sense axes need 3 different names"):
        sensor_array(np.eye(3), names=names)
