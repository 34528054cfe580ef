"""Geometry of an array of single-axis gyros: which way each one senses, and its two tilt axes."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from estimator.errors import GeometryError
from estimator.geometry.kinematics import AXES
from estimator.packaged import sentence
from estimator.types import Floats

TOLERANCE = 1e-3
"""How far printed axes (four digits) may be from unit length and from right angles."""


@dataclass(frozen=True, slots=True, eq=False)
class SensorArray:
    """Nominal sense axes ``p`` and tilt axes ``j``, ``k`` of n gyros, each n x 3, in the body frame."""

    names: tuple[str, ...]
    p: Floats
    j: Floats
    k: Floats

    def __len__(self) -> int:
        return len(self.names)

    def select(self, rows: Sequence[int]) -> "SensorArray":
        """Return the array of only these gyros, in this order; rank is not asked of a part."""
        index = list(rows)
        return SensorArray(tuple(self.names[i] for i in index), self.p[index], self.j[index], self.k[index])

    def turned(self, axes: Floats) -> "SensorArray":
        """Return the array in another frame, in which its own frame has the axes x, y, z in the rows of ``axes``."""
        return SensorArray(self.names, self.p @ axes, self.j @ axes, self.k @ axes)


def sensor_array(
    p: ArrayLike,
    j: ArrayLike | None = None,
    k: ArrayLike | None = None,
    *,
    names: Sequence[str] | None = None,
    part_of_array: bool = False,
    as_printed: bool = False,
) -> SensorArray:
    """Return a checked array from sense axes (n x 3) and, if given, tilt axes (n x 3 each).

    Otherwise tilt axes are derived: j is the part of +z perpendicular to p (of +x if p is along z), and k = p x j.
    ``part_of_array`` allows gyros that do not span space. ``as_printed`` accepts skewed triads, for reproducing a
    publication with its misprints. Names are gyro1, gyro2 and so on if none are given.

    GeometryError for axes that are not unit vectors, triads that are not orthonormal to 1e-3, directions that do not
    span three dimensions, only one of j and k, and wrong shapes or names.
    """
    p = _axes("p", p)
    n = len(p)
    labels = tuple(names) if names is not None else tuple(f"gyro{i + 1}" for i in range(n))
    if len(labels) != n or len(set(labels)) != n:
        raise GeometryError(f"{n} sense axes need {n} different names, got {list(labels)}")
    if (j is None) != (k is None):
        raise GeometryError("give both tilt axes j and k of each gyro, or neither")
    lengths = np.linalg.norm(np.clip(p, -1e9, 1e9), axis=1)
    for label, length in zip(labels, lengths, strict=True):
        if abs(length - 1) > TOLERANCE:
            raise GeometryError(f"sense axis of {label} has length {length:.4g}, not 1: give a unit vector")
    if not part_of_array:
        singular = np.linalg.svd(p, compute_uv=False)
        if n < 3 or singular[2] < TOLERANCE:
            raise GeometryError(sentence("geometry.in_a_plane"))
    if j is None or k is None:
        j = _tilt_axes(p)
        k = np.cross(p, j)
    j, k = _axes("j", j), _axes("k", k)
    if j.shape != p.shape or k.shape != p.shape:
        raise GeometryError(f"p, j and k must have the same shape, got {p.shape}, {j.shape}, {k.shape}")
    if not as_printed:
        for i, label in enumerate(labels):
            triad = np.array([p[i], j[i], k[i]])
            skew = float(np.abs(triad @ triad.T - np.eye(3)).max())
            if skew > TOLERANCE:
                raise GeometryError(sentence("geometry.not_orthonormal", name=label, skew=skew))
    return SensorArray(labels, p, j, k)


def triad() -> SensorArray:
    """Return three gyros along +x, +y, +z."""
    return sensor_array(np.eye(3), names=("x", "y", "z"))


def tetrahedron() -> SensorArray:
    """Return the paper's four gyros (eq. 14): one along -z, three at acos(1/3) from +z at 0, 120, 240 deg."""
    return sensor_array(np.vstack([[0.0, 0.0, -1.0], _cone_axes(3, float(np.arccos(1 / 3)))]))


def dodecahedron() -> SensorArray:
    """Return six gyros along the face normals of a regular dodecahedron."""
    a = float(np.arctan(2.0))  # angle between neighbouring face normals
    return sensor_array(np.vstack([[0.0, 0.0, 1.0], _cone_axes(5, a)]))


def cone(n: int, half_angle_rad: float) -> SensorArray:
    """Return n gyros evenly spaced on a cone about +z with this half angle."""
    return sensor_array(_cone_axes(n, half_angle_rad))


def accelerometer_names(count: int) -> tuple[str, ...]:
    """Return the names of the accelerometers of a source: by axis if there are three."""
    return tuple(f"accel {axis}" for axis in (AXES if count == 3 else range(1, count + 1)))


def accelerometer_axes(array: SensorArray, mounting: Floats | None = None) -> Floats:
    """Return the nominal axes (3, 3) of a device's accelerometers: those of its gyros if it has three, else its own.

    ``mounting`` has the device's own axes x, y, z in its rows; None: they are the body's.
    """
    if array.p.shape == (3, 3):
        return array.p
    return np.eye(3) if mounting is None else mounting


def accelerometer_array(axes: Floats, gyros: SensorArray) -> SensorArray:
    """Return the accelerometers of a device with nominal sense ``axes`` (n, 3), under their usual names.

    If each lies along the gyro of its number, all have the tilt axes of these gyros, which turn with the device when it
    is mounted otherwise. Else all get derived ones. GeometryError as for ``sensor_array``.
    """
    names = accelerometer_names(len(axes))
    first = gyros.p[: len(axes)]
    if first.shape == axes.shape and np.abs(first - axes).max(initial=0.0) < TOLERANCE:
        return SensorArray(names, first, gyros.j[: len(axes)], gyros.k[: len(axes)])
    return sensor_array(axes, names=names, part_of_array=True)


def _cone_axes(n: int, half_angle_rad: float) -> Floats:
    azimuth = 2 * np.pi * np.arange(n) / max(n, 1)
    s, c = np.sin(half_angle_rad), np.cos(half_angle_rad)
    return np.column_stack([s * np.cos(azimuth), s * np.sin(azimuth), np.full(n, c)])


def _tilt_axes(p: Floats) -> Floats:
    up = np.array([0.0, 0.0, 1.0])
    j = up - np.outer(p @ up, 1.0) * p
    norm = np.linalg.norm(j, axis=1, keepdims=True)
    along_z = norm[:, 0] < 1e-6
    j = np.where(along_z[:, None], [1.0, 0.0, 0.0], j / np.where(norm < 1e-6, 1.0, norm))
    return np.asarray(j, dtype=np.float64)


def _axes(name: str, value: ArrayLike) -> Floats:
    """Return ``value`` as an array (n, 3) of at least one row.

    GeometryError, with ``name``, if it is not of finite numbers, empty, or of another shape.
    """
    try:
        axes = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise GeometryError(f"{name} must be numbers, one row of three for each gyro") from None
    if axes.ndim != 2 or axes.shape[1] != 3 or not len(axes):
        raise GeometryError(f"{name} must have one row of three numbers for each gyro, got shape {axes.shape}")
    if not np.isfinite(axes).all():
        raise GeometryError(f"{name} holds a number that is not finite")
    return axes
