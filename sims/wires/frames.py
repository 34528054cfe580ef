"""Common parts of IMU twins: their setup, faults of gyros and clocks, and where frames go."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import can
import numpy as np

from drivers.types import Floats
from sims.physics.gyro import GyroArray

STANDARD_GRAVITY_MPS2 = 9.80665


class FrameSink(Protocol):
    """A bus as seen by its nodes: a python-can bus, an slcan adapter or a socketcand server."""

    def send(self, msg: can.Message) -> None:
        """Send a frame."""


@dataclass(slots=True)
class NodeFaults:
    """Knobs of a twin, which may be turned while it runs.

    ``dropped`` and ``doubled`` are the shares of samples left out and sent twice; ``stuck`` gyros keep their last rate,
    ``saturated`` ones show the end of their range; ``silent`` sends nothing. ``huge`` is the share of samples with
    impossible rates; ``clock_ppm`` is by how much the device's clock is too fast.
    """

    dropped: float = 0.0
    doubled: float = 0.0
    stuck: set[int] = field(default_factory=set)
    saturated: set[int] = field(default_factory=set)
    silent: bool = False
    huge: float = 0.0
    clock_ppm: float = 0.0
    seed: int = 0
    _random: np.random.Generator | None = None
    _last: Floats | None = None

    def times_to_send(self) -> int:
        """Return how often to send the present sample: 0, 1 or 2 times, at random by ``dropped`` and ``doubled``.

        0 while silent, 1 without these faults; then nothing is drawn.
        """
        if self.silent:
            return 0
        if not self.dropped and not self.doubled:
            return 1
        if self._random is None:
            self._random = np.random.default_rng(self.seed)
        draw = float(self._random.random())
        return 0 if draw < self.dropped else 2 if draw < self.dropped + self.doubled else 1

    def spoilt(self, rates_rps: Floats, most_rps: float = 1e300) -> Floats:
        """Return rates (n, m) with all of a row ``most_rps``, the largest number on the wire, in a share ``huge``."""
        if not self.huge:
            return rates_rps
        self._random = self._random or np.random.default_rng(self.seed)
        return np.where(self._random.random((len(rates_rps), 1)) < self.huge, most_rps, rates_rps)

    def rates(self, rates_rps: Floats) -> Floats:
        """Return the rates (m,) of one sample with the faults of gyros.

        Stuck ones keep the rate of the sample before, or the present one if there is none; saturated ones become
        infinite with the sign of their rate, which stands for the end of the range.
        """
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


@dataclass(kw_only=True, frozen=True, slots=True)
class ImuTwinSetup:
    """A device under test on the simulated table.

    ``gyros`` sample at ``rate_hz``; ``up`` gives the specific force (n, 3) in g at instants (n,), None if the table
    does not provide it. ``options`` are the protocol's keys in the bench file, ``signals`` those of a DBC or a
    description; the knobs of ``faults`` may be turned at any time. ``number`` counts devices of the same kind from 0.
    """

    gyros: GyroArray
    rate_hz: float
    up: Callable[[Floats], Floats] | None = None
    faults: NodeFaults = field(default_factory=NodeFaults)
    options: Mapping[str, Any] = field(default_factory=dict)
    signals: Any = None
    number: int = 0

    def force_mps2(self, t_s: Floats) -> Floats:
        """Return the specific force (n, 3) at its accelerometers in m/s2 at instants (n,); 0 without a direction up."""
        return np.zeros((len(t_s), 3)) if self.up is None else self.up(t_s) * STANDARD_GRAVITY_MPS2
