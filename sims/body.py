"""What the body really does: its attitude as a quaternion, and its inertial rate as the change of attitude."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

SIDEREAL_DAY_S = 86164.0905
_HALF_STEP_S = 1e-4
_CONJUGATE = np.array([1.0, -1.0, -1.0, -1.0])


# (a b)_k = sum over i, j of a_i b_j _TABLE[i, j, k]: Hamilton's table of units.
_TABLE = np.zeros((4, 4, 4))
for _i, _j, _k, _sign in (
    (0, 0, 0, 1), (0, 1, 1, 1), (0, 2, 2, 1), (0, 3, 3, 1),
    (1, 0, 1, 1), (1, 1, 0, -1), (1, 2, 3, 1), (1, 3, 2, -1),
    (2, 0, 2, 1), (2, 1, 3, -1), (2, 2, 0, -1), (2, 3, 1, 1),
    (3, 0, 3, 1), (3, 1, 2, 1), (3, 2, 1, -1), (3, 3, 0, -1),
):  # fmt: skip
    _TABLE[_i, _j, _k] = _sign
_TABLE = _TABLE.reshape(16, 4)


def turn(axis: str, angle_rad: Floats) -> Floats:
    """Return quaternions (n, 4), scalar first, of turns about a coordinate axis."""
    q = np.zeros((len(angle_rad), 4))
    half = 0.5 * angle_rad
    q[:, 0] = np.cos(half)
    q[:, 1 + "xyz".index(axis)] = np.sin(half)
    return q


def product(a: Floats, b: Floats) -> Floats:
    """Return the quaternion products a b, (n, 4)."""
    return np.asarray((a[:, :, None] * b[:, None, :]).reshape(-1, 16) @ _TABLE)


class Body:
    """A body on the innermost gimbal of a table that stands on the turning Earth."""

    def __init__(
        self,
        gimbals: Sequence[str],
        angles: Callable[[str, Floats], Floats],
        latitude_rad: float,
        heading_rad: float,
    ) -> None:
        """``angles(axis, t_s)`` gives an axis' true angles; gimbals are named outermost first."""
        self._gimbals = tuple(gimbals)
        self._angles = angles
        # The pole, seen from a base with z up and x at the heading: turn east about up by the heading.
        spin = 2 * math.pi / SIDEREAL_DAY_S
        north, up = math.cos(latitude_rad), math.sin(latitude_rad)
        self._spin = spin
        self._pole = np.array([north * math.cos(heading_rad), north * math.sin(heading_rad), up])

    def rate_rps(self, t_s: Floats) -> Floats:
        """Return the inertial rate in body axes at each instant, (n, 3)."""
        n = len(t_s)
        around = np.concatenate([t_s - _HALF_STEP_S, t_s + _HALF_STEP_S])
        attitude = self._attitude(around, float(t_s[0]))
        before, after = attitude[:n] * _CONJUGATE, attitude[n:]
        change = product(before, after)
        return np.asarray(change[:, 1:] / _HALF_STEP_S)  # 2 vec(q* q') over a step of 2 h

    def _attitude(self, t_s: Floats, origin_s: float) -> Floats:
        half = 0.5 * self._spin * (t_s - origin_s)
        q = np.empty((len(t_s), 4))
        q[:, 0] = np.cos(half)
        q[:, 1:] = np.sin(half)[:, None] * self._pole
        for axis in self._gimbals:
            q = product(q, turn(axis, self._angles(axis, t_s)))
        return q
