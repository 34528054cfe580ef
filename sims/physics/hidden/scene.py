"""The motion of the body as gyros sense it at their instants."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from drivers.types import Floats
from sims.physics.body import Body
from sims.physics.geometry import Mounting
from sims.physics.hidden.temperature import Temperature

_STEP_S = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """The surroundings of the gyros: body, mounting, true sense axes (m, 3) and temperature.

    The bench clock, which temperature and drift follow, is at ``started_s`` at the instant 0 of the motion.
    """

    body: Body
    mounting: Mounting
    sense: Floats
    temperature: Temperature
    started_s: float = 0.0


class Scene:
    """The inputs of all effects at instants (n,); each is computed when first used."""

    def __init__(self, world: World, t_s: Floats) -> None:
        """``t_s`` are instants of the motion."""
        self.world, self.t_s = world, t_s

    @property
    def clock_s(self) -> Floats:
        """Instants (n,) of the bench clock."""
        return self.t_s + self.world.started_s

    @cached_property
    def u(self) -> Floats:
        """Rate about each sense axis as it really is (n, m), rad/s."""
        return np.asarray(self.world.body.rate_rps(self.t_s) @ self.world.sense.T)

    @cached_property
    def acceleration(self) -> Floats:
        """Angular acceleration of the body (n, 3), rad/s2."""
        after, before = (self.world.body.rate_rps(self.t_s + step) for step in (_STEP_S, -_STEP_S))
        return np.asarray((after - before) / (2 * _STEP_S))

    @cached_property
    def up(self) -> Floats:
        """Specific force at rest (n, 3) in body axes, g."""
        return self.world.body.up(self.t_s)

    @cached_property
    def warmth(self) -> Floats:
        """Temperature above the reference (n, 1), degC."""
        return self.world.temperature.above(self.clock_s)[:, None]

    def angle(self, axis: str) -> Floats:
        """Return the true angle of an axis of the table (n, 1), rad; 0 if the table lacks it."""
        return self.world.body.angle(axis, self.t_s)[:, None]

    @cached_property
    def axes(self) -> tuple[Floats, Floats]:
        """Rates (rad/s) and accelerations (rad/s2) of the table's axes, each (n, axes), by differences over 1 ms."""
        body = self.world.body
        before, here, after = (
            np.column_stack([body.angle(axis, self.t_s + step) for axis in body.gimbals])
            for step in (-_STEP_S, 0.0, _STEP_S)
        )
        return (after - before) / (2 * _STEP_S), (after - 2 * here + before) / _STEP_S**2
