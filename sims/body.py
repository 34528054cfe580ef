"""What the body really does: its attitude as a quaternion, and its inertial rate as the change of attitude."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

SIDEREAL_DAY_S = 86164.0905
_HALF_STEP_S = 1e-4


# q @ _RIGHT[axis] is the quaternion product q e, with e the unit quaternion along x, y or z.
_RIGHT = {
    "x": np.array([[0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, -1], [0, 0, 1, 0]], dtype=np.float64),
    "y": np.array([[0, 0, 1, 0], [0, 0, 0, 1], [-1, 0, 0, 0], [0, -1, 0, 0]], dtype=np.float64),
    "z": np.array([[0, 0, 0, 1], [0, 0, -1, 0], [0, 1, 0, 0], [-1, 0, 0, 0]], dtype=np.float64),
}
_ALL_RIGHT = np.hstack([_RIGHT[axis] for axis in "xyz"])


class Body:
    """A body on the innermost gimbal of a table that stands on the turning Earth."""

    def __init__(
        self,
        gimbals: Sequence[str],
        angles: Callable[[str, Floats], Floats],
        revision: Callable[[], int],
        latitude_rad: float,
        heading_rad: float,
        earth_turns: bool = True,
    ) -> None:
        """Gimbals are named outermost first.

        ``angles(axis, t_s)`` gives an axis' true angles, now and to come by what it has been told; ``revision``
        changes whenever it is told something else.
        """
        self._gimbals = tuple(gimbals)
        self._angles = angles
        self._revision_of_angles = revision
        # The pole, seen from a base with z up and x at the heading: turn east about up by the heading.
        spin = 2 * math.pi / SIDEREAL_DAY_S if earth_turns else 0.0
        north, up = math.cos(latitude_rad), math.sin(latitude_rad)
        self._spin = spin
        self._pole = np.array([north * math.cos(heading_rad), north * math.sin(heading_rad), up])

    @property
    def revision(self) -> int:
        """Number that changes whenever rates to come have changed."""
        return self._revision_of_angles()

    def rate_rps(self, t_s: Floats) -> Floats:
        """Return the inertial rate in body axes at each instant, (n, 3)."""
        n = len(t_s)
        attitude = self._attitude(np.concatenate([t_s - _HALF_STEP_S, t_s + _HALF_STEP_S]), float(t_s[0]))
        before, after = attitude[:n], attitude[n:]
        # The vector part of (before)* (after): half the angle turned in a step of 2 h.
        half_turn = (before @ _ALL_RIGHT).reshape(n, 3, 4) @ after[:, :, None]
        return np.asarray(half_turn[:, :, 0] / _HALF_STEP_S)

    def _attitude(self, t_s: Floats, origin_s: float) -> Floats:
        earth = 0.5 * self._spin * (t_s - origin_s)
        q = np.empty((len(t_s), 4))
        q[:, 0] = np.cos(earth)
        q[:, 1:] = np.sin(earth)[:, None] * self._pole
        half = 0.5 * np.stack([self._angles(axis, t_s) for axis in self._gimbals])
        cos, sin = np.cos(half)[:, :, None], np.sin(half)[:, :, None]
        for i, axis in enumerate(self._gimbals):
            q = cos[i] * q + sin[i] * (q @ _RIGHT[axis])
        return q
