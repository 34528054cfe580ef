"""How gyros are mounted: each by the polar angle and azimuth of its sense axis."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drivers.types import Floats

_POLAR = math.degrees(math.acos(1 / 3))
_FACE = math.degrees(math.atan(2.0))

MOUNTS_DEG: dict[str, list[tuple[float, float]]] = {
    "triad": [(90, 0), (90, 90), (0, 180)],
    "tetrahedron": [(180, 0), (_POLAR, 0), (_POLAR, 120), (_POLAR, 240)],
    "dodecahedron": [(0, 180), *((_FACE, 72.0 * i) for i in range(5))],
}


@dataclass(frozen=True, slots=True, eq=False)
class Mounting:
    """Sense axes and tilt axes, each (n, 3)."""

    p: Floats
    j: Floats
    k: Floats


def mounted(angles_deg: Sequence[tuple[float, float]]) -> Mounting:
    """Return the axes of gyros whose z axis was turned by the polar angle about y, then by the azimuth about z.

    Angles (polar, azimuth) in degrees. The tilt axes of a gyro are its -x and -y after the turns.
    """
    axes = []
    for polar, azimuth in np.radians(np.asarray(angles_deg, dtype=np.float64)):
        about_y = np.array([[math.cos(polar), 0, math.sin(polar)], [0, 1, 0], [-math.sin(polar), 0, math.cos(polar)]])
        about_z = np.array(
            [[math.cos(azimuth), -math.sin(azimuth), 0], [math.sin(azimuth), math.cos(azimuth), 0], [0, 0, 1]]
        )
        axes.append(about_z @ about_y)
    turned = np.array(axes)
    return Mounting(turned[:, :, 2], -turned[:, :, 0], -turned[:, :, 1])


def remounted(mounting: Mounting, along: Floats, error_rad: Sequence[float]) -> Mounting:
    """Return the axes of gyros of a device that was turned: its axes x, y, z now point along the rows of ``along``.

    It is off by small turns ``error_rad`` about its own x, y and z, one after the other.
    """
    frame = np.asarray(along, dtype=np.float64).T
    for axis, angle in enumerate(error_rad):
        others = [(axis + 1) % 3, (axis + 2) % 3]
        turn = np.eye(3)
        turn[np.ix_(others, others)] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
        frame = frame @ turn
    p, j, k = (axes @ frame.T for axes in (mounting.p, mounting.j, mounting.k))
    return Mounting(p, j, k)


def along(p: Sequence[Sequence[float]]) -> Mounting:
    """Return the mounting of gyros given by their sense axes, unit vectors (n, 3).

    A gyro along z or -z has a fixed azimuth of 180 or 0 deg.
    """
    angles = []
    for x, y, z in p:
        if math.hypot(x, y) < 1e-6:
            angles.append((0.0, 180.0) if z > 0 else (180.0, 0.0))
        else:
            angles.append((math.degrees(math.acos(max(-1.0, min(1.0, z)))), math.degrees(math.atan2(y, x))))
    return mounted(angles)


def upright(t_s: Floats) -> Floats:
    """Return the direction up (n, 3) of a device that stands with its third axis up."""
    return np.tile([0.0, 0.0, 1.0], (len(t_s), 1))


def tilt_deg(up: Floats) -> Floats:
    """Return roll, pitch, yaw (n, 3), from east, north, up to the axes in which ``up`` (n, 3) is given.

    There is no magnetic heading, so yaw is 0.
    """
    roll, pitch = np.arctan2(up[:, 1], up[:, 2]), -np.arcsin(np.clip(up[:, 0], -1.0, 1.0))
    return np.asarray(np.degrees(np.column_stack([roll, pitch, np.zeros(len(up))])))
