"""Effects of time on sensed rates: delays, low passes, and the aftermath of the last rotation."""

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from drivers.types import Floats
from sims.physics.hidden.fields import Each, HiddenError, each, given, hidden

KINDS: dict[str, type[Any]] = {}


@hidden(KINDS, "latency")
class Latency:
    """All gyros show their state of ``delay_s`` ago."""

    delay_s: float = field(metadata=given("s", least=0))


@hidden(KINDS, "rate_dependent_delay")
class RateDependentDelay:
    """A gyro shows its state of ``size`` times its rate ago; s per rad/s."""

    size: Each = field(metadata=each("us/(deg/s)", least=0))

    def delay_s(self, u: Floats) -> Floats:
        """Return the delay (n, m) at rates (n, m)."""
        return np.asarray(self.size * np.abs(u))


@hidden(KINDS, "bandwidth")
class Bandwidth:
    """A first-order low pass of the sensed rate, stated by its cutoff or its time constant."""

    cutoff_hz: Each = field(default=0.0, metadata=each("Hz", least=0))
    time_constant_s: Each = field(default=0.0, metadata=each("s", least=0))

    def __post_init__(self) -> None:
        """Refuse both and neither."""
        if np.any(np.asarray(self.cutoff_hz) > 0) == np.any(np.asarray(self.time_constant_s) > 0):
            raise HiddenError("bandwidth: give cutoff or time_constant, above zero")

    def lag_s(self) -> Floats:
        """Return the time constants, 0 for a gyro without a low pass."""
        cutoff = np.asarray(self.cutoff_hz, dtype=np.float64)
        with np.errstate(divide="ignore"):
            return np.asarray(np.where(cutoff > 0, 1 / (2 * math.pi * cutoff), self.time_constant_s))


@hidden(KINDS, "hysteresis")
class Hysteresis:
    """A bias whose sign is that of the last rotation about the sense axis above ``threshold_rps``; 0 before any."""

    size_rps: Each = field(metadata=each("deg/s"))
    threshold_rps: float = field(default=math.radians(1.0), metadata=given("deg/s"))


@dataclass(slots=True, eq=False)
class LowPass:
    """The low pass of one run; remembers the last input and output (m,)."""

    lag_s: Floats
    period_s: float
    last: tuple[Floats, Floats] | None = field(default=None)

    def __call__(self, x: Floats) -> Floats:
        """Return successive inputs (n, m) after the low pass, exact for inputs that are linear between samples.

        They go on from the last call; the very first input counts as having lasted. A lag of 0 leaves inputs as they
        are, and without rows nothing changes.
        """
        from scipy.signal import lfilter  # slow to import

        if not len(x):
            return x
        lag = np.maximum(self.lag_s, 1e-9)
        keep = np.exp(-self.period_s / lag)
        mean = lag * (1 - keep) / self.period_s
        x_before, y = self.last or (x[0], x[0])
        # y' = (x - y) / lag over one period, x going straight from x_before to x.
        push = (1 - mean) * x + (mean - keep) * np.vstack([x_before, x[:-1]])
        columns = [lfilter([1.0], [1.0, -k], p, zi=[k * y0])[0] for k, p, y0 in zip(keep, push.T, y, strict=True)]
        out = np.column_stack(columns)
        self.last = x[-1], out[-1]
        return out


@dataclass(slots=True, eq=False)
class LastTurn:
    """Sign (m,) of the last rotation of each gyro above a threshold."""

    threshold_rps: float
    sign: Floats

    def __call__(self, u: Floats) -> Floats:
        """Return the signs (n, m) of the last rotation above the threshold, up to each of successive rates (n, m).

        Before any rotation in these rates it is the sign of the last call, which is remembered.
        """
        if not len(u):
            return u
        turning = np.abs(u) > self.threshold_rps
        signs = np.vstack([self.sign, np.sign(u)])
        index = np.where(turning, np.arange(1, len(u) + 1)[:, None], 0)
        last = np.maximum.accumulate(index, axis=0)
        out = np.take_along_axis(signs, last, axis=0)
        self.sign = out[-1]
        return out
