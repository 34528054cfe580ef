"""The temperature of the gyros over time, and the outputs that follow it."""

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from drivers.types import Floats
from sims.physics.hidden.fields import choice, given

EXPONENTIAL, LINEAR, CYCLE = "exponential", "linear", "cycle"


@dataclass(frozen=True, slots=True)
class Temperature:
    """A temperature (degC) that rises by ``rise_c`` from the bench clock's 0 on.

    Exponential: with ``time_constant_s``. Linear: over ``over_s``, then constant. Cycle: up and down, a raised cosine
    of period ``over_s``. Thermal effects are zero at ``reference_c``.
    """

    name: ClassVar[str] = "temperature"
    start_c: float = field(default=25.0, metadata=given("degC"))
    rise_c: float = field(default=2.0, metadata=given("degC"))
    time_constant_s: float = field(default=300.0, metadata=given("s", least=1e-3))
    over_s: float = field(default=360.0, metadata=given("s", least=1e-3))
    shape: str = field(default=EXPONENTIAL, metadata=choice((EXPONENTIAL, LINEAR, CYCLE)))
    reference_c: float = field(default=25.0, metadata=given("degC"))

    def at(self, t_s: Floats) -> Floats:
        """Return the temperature in degC at instants (n,) of the bench clock; the start value before 0.

        By ``shape`` it rises linearly and stays, rises and falls in cycles, or approaches its end exponentially.
        """
        t_s = np.maximum(t_s, 0.0)
        if self.shape == LINEAR:
            risen = np.minimum(t_s / self.over_s, 1.0)
        elif self.shape == CYCLE:
            risen = 0.5 * (1 - np.cos(2 * np.pi * t_s / self.over_s))
        else:
            risen = 1 - np.exp(-t_s / self.time_constant_s)
        return np.asarray(self.start_c + self.rise_c * risen)

    def above(self, t_s: Floats) -> Floats:
        """Return by how much it is above the reference."""
        return self.at(t_s) - self.reference_c

    def slope(self, t_s: Floats) -> Floats:
        """Return the rate of change in degC/s at instants (n,) of the bench clock; 0 before 0."""
        if self.shape == LINEAR:
            rising = np.where(t_s < self.over_s, 1 / self.over_s, 0.0)
        elif self.shape == CYCLE:
            rising = np.pi / self.over_s * np.sin(2 * np.pi * t_s / self.over_s)
        else:
            rising = np.exp(-np.maximum(t_s, 0.0) / self.time_constant_s) / self.time_constant_s
        return np.asarray(np.where(t_s >= 0, self.rise_c * rising, 0.0))

    def lagged(self, t_s: Floats, lag_s: float) -> Floats:
        """Return the temperature in degC of a body that follows this one with a first-order lag of ``lag_s``.

        At instants (n,) of the bench clock; it equals this one at the instant 0 and before.
        """
        t_s = np.maximum(t_s, 0.0)
        decay = np.exp(-t_s / lag_s)
        if self.shape == LINEAR:
            after = np.maximum(t_s - self.over_s, 0.0)
            ramp = np.minimum(t_s, self.over_s)
            risen = (ramp - lag_s * (1 - np.exp(-ramp / lag_s))) / self.over_s
            risen = 1 - (1 - risen) * np.exp(-after / lag_s)
        elif self.shape == CYCLE:
            angle = 2 * np.pi * t_s / self.over_s
            behind = 2 * np.pi * lag_s / self.over_s
            waves = np.cos(angle) + behind * np.sin(angle) + behind**2 * decay
            risen = 0.5 * (1 - waves / (1 + behind**2))
        elif abs(lag_s - self.time_constant_s) < 1e-6 * lag_s:
            risen = 1 - (1 + t_s / lag_s) * decay
        else:
            own = self.time_constant_s
            risen = 1 - (own * np.exp(-t_s / own) - lag_s * decay) / (own - lag_s)
        return np.asarray(self.start_c + self.rise_c * risen)
