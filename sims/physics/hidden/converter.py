"""Effects of the converter, on the output with its noise: limits, values that are held."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from drivers.types import Floats
from sims.physics.hidden.fields import WHOLE, Each, HiddenError, each, given, hidden

KINDS: dict[str, type[Any]] = {}


@hidden(KINDS, "dead_band")
class DeadBand:
    """A gyro shows no rate while its rate is within ``size_rps``; its other effects stay."""

    size_rps: Each = field(metadata=each("deg/s"))


@hidden(KINDS, "saturation")
class Saturation:
    """An output limited to ``limit_rps`` on each side."""

    limit_rps: Each = field(metadata=each("deg/s", least=0))


@hidden(KINDS, "sample_hold")
class SampleHold:
    """A new output only every ``samples`` samples, beginning with the first."""

    samples: int = field(metadata=WHOLE)


@hidden(KINDS, "stuck")
class Stuck:
    """An output of one gyro, counted from 1, that is frozen between two instants of the bench clock."""

    gyro: int = field(metadata=WHOLE)
    from_s: float = field(metadata=given("s"))
    until_s: float = field(metadata=given("s"))

    def __post_init__(self) -> None:
        """Refuse a span that ends before it begins."""
        if self.until_s < self.from_s:
            raise HiddenError("stuck: until is before from")


@dataclass(slots=True, eq=False)
class Converter:
    """The converters of one run (m,): limits, then sample holds, then stuck outputs; remembers the last output."""

    limits: tuple[Saturation, ...]
    hold: int
    stuck: tuple[Stuck, ...]
    count: int = 0
    held: Floats = field(default_factory=lambda: np.empty(0))
    last: Floats = field(default_factory=lambda: np.empty(0))

    def __call__(self, clock_s: Floats, out: Floats) -> Floats:
        """Return the outputs (n, m) after limits, holds and stuck gyros, at successive instants (n,), one or more.

        They are of the bench clock, in s, and go on from the last call.
        Holds repeat every ``hold``-th row until the next; a stuck gyro keeps its last value before the time at which it
        sticks.
        """
        for limit in self.limits:
            out = np.clip(out, -np.asarray(limit.limit_rps), limit.limit_rps)
        if self.hold > 1:
            new = (np.arange(self.count, self.count + len(out)) % self.hold) == 0
            rows = np.vstack([self.held if len(self.held) else out[0], out])
            index = np.maximum.accumulate(np.where(new, np.arange(1, len(out) + 1), 0))
            out = rows[index]
            self.held = out[-1]
            self.count += len(out)
        for stuck in self.stuck:
            column = stuck.gyro - 1
            within = (clock_s >= stuck.from_s) & (clock_s < stuck.until_s)
            if within.any():
                out = out.copy()
                first = int(np.argmax(within))
                before = out[first - 1] if first else (self.last if len(self.last) else out[0])
                out[within, column] = before[column]
        self.last = out[-1]
        return out
