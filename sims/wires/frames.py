"""What twins on CAN share: where their frames go, and what can be wrong with their gyros and clocks."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import can
import numpy as np

from drivers.types import Floats

SpecificForce = Callable[[Floats], Floats]
"""Specific force (n, 3) in m/s2 in the axes of the device at instants (n,)."""


class FrameSink(Protocol):
    """A bus as its nodes see it: a python-can bus, an slcan adapter, a socketcand server."""

    def send(self, msg: can.Message) -> None:
        """Send a frame."""


@dataclass(slots=True)
class NodeFaults:
    """Knobs of a twin on CAN; they may be turned while it runs.

    ``dropped`` and ``doubled`` are the shares of samples that are left out and sent twice; ``stuck`` gyros keep
    their last rate, ``saturated`` ones show the end of their range; ``silent`` sends nothing. ``clock_ppm`` is how
    much too fast the device's clock runs.
    """

    dropped: float = 0.0
    doubled: float = 0.0
    stuck: set[int] = field(default_factory=set)
    saturated: set[int] = field(default_factory=set)
    silent: bool = False
    clock_ppm: float = 0.0
    seed: int = 0
    _random: np.random.Generator | None = None
    _last: Floats | None = None

    def times_to_send(self) -> int:
        """Return how often the sample at hand goes out: 0, 1 or 2 times."""
        if self.silent:
            return 0
        if not self.dropped and not self.doubled:
            return 1
        if self._random is None:
            self._random = np.random.default_rng(self.seed)
        draw = float(self._random.random())
        return 0 if draw < self.dropped else 2 if draw < self.dropped + self.doubled else 1

    def rates(self, rates_rps: Floats) -> Floats:
        """Return what the gyros (m,) put out instead of these rates; infinite is the end of the range."""
        if not self.stuck and not self.saturated:
            self._last = rates_rps
            return rates_rps
        out = rates_rps.copy()
        for i in self.stuck:
            out[i] = rates_rps[i] if self._last is None else self._last[i]
        self._last = out.copy()
        for i in self.saturated:
            out[i] = np.copysign(np.inf, rates_rps[i])
        return out
