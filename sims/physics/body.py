"""The true motion of the body: its attitude as a quaternion, and its inertial rate as the change of attitude."""

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from drivers.types import Floats

SIDEREAL_DAY_S = 86164.0905
_HALF_STEP_S = 1e-4
_AHEAD_S = 0.1
_SAME_INSTANT_S = 1e-6
_FORCE_STEP_S = 1e-3


# q @ _RIGHT[axis] is the quaternion product q e, with e the unit quaternion along x, y or z.
_RIGHT = {
    "x": np.array([[0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, -1], [0, 0, 1, 0]], dtype=np.float64),
    "y": np.array([[0, 0, 1, 0], [0, 0, 0, 1], [-1, 0, 0, 0], [0, -1, 0, 0]], dtype=np.float64),
    "z": np.array([[0, 0, 0, 1], [0, 0, -1, 0], [0, 1, 0, 0], [-1, 0, 0, 0]], dtype=np.float64),
}
_EACH_RIGHT = np.stack([_RIGHT[axis] for axis in "xyz"])
_ALL_RIGHT = np.hstack(list(_EACH_RIGHT))


class Body:
    """A body on the innermost gimbal of a table that stands on the rotating Earth."""

    def __init__(
        self,
        *,
        gimbals: Sequence[str],
        angles: Callable[[str, Floats], Floats],
        revision: Callable[[], int],
        latitude_rad: float,
        heading_rad: float,
        earth_turns: bool = True,
        directions: Mapping[str, Floats] | None = None,
    ) -> None:
        """Prepare the body; ``gimbals`` are named outermost first.

        ``angles(axis, t_s)`` gives the true angles of an axis, for future instants by its present command;
        ``revision()`` changes with each new command. ``heading_rad`` is that of the table's x axis at home, clockwise
        from north. ``directions`` are unit vectors (3,) of axes that at home are not along the body axis of their name.
        ``earth_turns`` false leaves the Earth's rate out.
        """
        self.gimbals = tuple(gimbals)
        self._angles = angles
        tilted = {axis: np.tensordot(unit, _EACH_RIGHT, 1) for axis, unit in (directions or {}).items()}
        self._right = {axis: tilted.get(axis, _RIGHT[axis]) for axis in gimbals}
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
        """Return the inertial rate in body axes (n, 3) in rad/s at instants (n,), by differences of the attitude.

        It includes that of the Earth, if the Earth turns.
        """
        n = len(t_s)
        attitude = self._attitude(np.concatenate([t_s - _HALF_STEP_S, t_s + _HALF_STEP_S]), float(t_s[0]))
        before, after = attitude[:n], attitude[n:]
        # The vector part of (before)* (after): half the angle turned in a step of 2 h.
        half_turn = (before @ _ALL_RIGHT).reshape(n, 3, 4) @ after[:, :, None]
        return np.asarray(half_turn[:, :, 0] / _HALF_STEP_S)

    def angle(self, axis: str, t_s: Floats) -> Floats:
        """Return the true angle of an axis at each instant, (n,); 0 for an axis that is no gimbal."""
        return self._angles(axis, t_s) if axis in self.gimbals else np.zeros(len(t_s))

    def up(self, t_s: Floats) -> Floats:
        """Return the unit vector up, which is the specific force at rest in g, in body axes at each instant, (n, 3)."""
        w, x, y, z = self._turned(np.tile([1.0, 0.0, 0.0, 0.0], (len(t_s), 1)), t_s).T
        return np.column_stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)])

    def specific_force_mps2(self, t_s: Floats, places_m: Floats, gravity_mps2: float) -> Floats:
        """Return the specific force (n, places, 3) at places fixed to the body, in body axes, at each instant (n,).

        ``places_m`` (places, 3) are from the point in which the axes of the table meet, in body axes. The acceleration
        of each is the second difference of where it is in the base frame, over 1 ms.
        """
        n = len(t_s)
        instants = np.concatenate([t_s - _FORCE_STEP_S, t_s, t_s + _FORCE_STEP_S])
        level = np.tile([1.0, 0.0, 0.0, 0.0], (len(instants), 1))
        into_base = _rotations(self._turned(level, instants))
        there_m = np.einsum("nij,pj->npi", into_base, places_m)
        change_m = there_m[:n] - 2 * there_m[n : 2 * n] + there_m[2 * n :]
        felt = change_m / _FORCE_STEP_S**2
        felt[:, :, 2] += gravity_mps2
        return np.asarray(np.einsum("nij,npi->npj", into_base[n : 2 * n], felt))

    def up_in_turn(self, period_s: float) -> Callable[[Floats], Floats]:
        """Return a function like ``up`` for successive instants ``period_s`` apart, computed ahead."""
        return self.in_turn(self.up, period_s)

    def in_turn(self, at: Callable[[Floats], Floats], period_s: float) -> Callable[[Floats], Floats]:
        """Return a function like ``at`` for successive instants ``period_s`` apart, which computes ahead.

        ``at`` gives a row for each instant (n,). What was computed ahead lapses when the motion changes. Instants that
        are not ``period_s`` apart are computed individually.
        """
        count = max(round(_AHEAD_S / period_s), 1)
        first_s, revision = math.inf, -1
        ahead: Floats = np.empty((0, 3))

        def rows(t_s: Floats) -> Floats:
            """Return the rows at evenly spaced instants, from values computed ahead; else compute them now.

            Values are computed ahead anew at another start, at the end, and after the motion has changed.
            """
            nonlocal first_s, ahead, revision
            n, now_s = len(t_s), float(t_s[0])
            if abs(float(t_s[-1]) - now_s - (n - 1) * period_s) > _SAME_INSTANT_S:
                return at(t_s)
            place = (now_s - first_s) / period_s
            row = round(place) if 0 <= place < len(ahead) - n + 0.5 else 0
            if revision != self.revision or abs(place - row) * period_s > _SAME_INSTANT_S:
                first_s, row = now_s, 0
                coming = np.arange(max(count, n), dtype=np.float64)
                ahead, revision = at(first_s + period_s * coming), self.revision
            return ahead[row : row + n]

        return rows

    def _attitude(self, t_s: Floats, origin_s: float) -> Floats:
        earth = 0.5 * self._spin * (t_s - origin_s)
        q = np.empty((len(t_s), 4))
        q[:, 0] = np.cos(earth)
        q[:, 1:] = np.sin(earth)[:, None] * self._pole
        return self._turned(q, t_s)

    def _turned(self, q: Floats, t_s: Floats) -> Floats:
        """Return attitudes (n, 4) turned by the gimbals."""
        half = 0.5 * np.stack([self._angles(axis, t_s) for axis in self.gimbals])
        cos, sin = np.cos(half)[:, :, None], np.sin(half)[:, :, None]
        for i, axis in enumerate(self.gimbals):
            q = cos[i] * q + sin[i] * (q @ self._right[axis])
        return q


def _rotations(q: Floats) -> Floats:
    """Return the matrices (n, 3, 3) that turn body vectors into the base frame, of unit quaternions w x y z (n, 4)."""
    w, x, y, z = q.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.asarray(np.moveaxis(np.array(rows), 2, 0))
