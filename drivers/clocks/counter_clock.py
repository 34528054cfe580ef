"""Times of samples that carry the device's own count."""

import math
from dataclasses import dataclass, field

import numpy as np

from drivers.clocks.alignment import HostFit
from drivers.types import Alignment, Flags, Floats, SourceCounts, Stamps

LATE_PERIODS = 2.0
LATE_S = 0.05
"""A sample is late when it comes so many periods, and so long, after its time."""
_IMPOSSIBLY_EARLY_S = 0.1
_PROOF_S = 0.3  # how long all must come late by a wrap before it is taken for a loss
_NEARLY = 0.9
_NEAR_WHOLE = 0.05


@dataclass(slots=True)
class CounterClock:
    """Sample times from a wrapping counter with a known tick; a sample may advance it by any number of ticks."""

    tick_s: float
    modulus: int
    ticks_per_sample: float
    counts: SourceCounts = field(default_factory=SourceCounts)
    fit: HostFit = field(default_factory=HostFit)
    _last: int = -1  # unwrapped count of the last sample
    _last_arrival_ns: int | None = None
    _least_s: float = math.inf  # lateness of the samples since
    _since_s: float = 0.0

    @property
    def alignment(self) -> Alignment | None:
        """The device's clock against the loop's; None in the first seconds."""
        return self.fit.alignment

    def stamp(self, counter: Stamps, arrival_ns: Stamps) -> tuple[Flags, Stamps]:
        """Return which samples are new, as flags (n,), and the times in ns of the new ones, in their order.

        ``counter`` (n,) are the device's counts, ``arrival_ns`` (n,) the arrivals; both results are empty if they are.
        Counters not above all before are dropped and counted as repeated, missing ones counted as lost, samples that
        come 2 periods and 50 ms too late counted as late; the clock fit is updated. Gaps longer than the counter's wrap
        are resolved by the arrival of the last sample, which waited least. A count that continues without a gap may
        have missed a whole wrap, or its sender is late: where arrivals jitter, a loss is counted only if the lateness
        persists. If the last sample comes 0.1 s or more before its time, the clock restarts.
        """
        if not len(counter):
            return np.zeros(0, dtype=np.bool_), np.empty(0, dtype=np.int64)
        unwrapped, even = self._unwrap(counter, int(arrival_ns[-1]))
        if even:
            keep, fresh, arrival = np.ones(len(counter), dtype=np.bool_), unwrapped, arrival_ns
        else:
            newest = np.maximum.accumulate(np.concatenate([[self._last], unwrapped]))[:-1]
            keep = unwrapped > newest
            fresh, arrival = unwrapped[keep], arrival_ns[keep]
        device_s: Floats = np.asarray(fresh * self.tick_s, dtype=np.float64)
        if len(fresh) and self._impossible(float(device_s[-1]), int(arrival[-1])):
            self.restart()
            return self.stamp(counter, arrival_ns)
        if not even:
            self.counts.repeated += len(keep) - len(fresh)
            self._count_lost((fresh - newest[keep]), int(arrival_ns[0]))
        if not len(fresh):
            return keep, np.empty(0, dtype=np.int64)
        self._last, self._last_arrival_ns = int(fresh[-1]), int(arrival_ns[-1])
        self.fit.add(device_s, arrival)
        t_ns = self.fit.time_ns(device_s)
        self._look_for_wraps(float(device_s[-1]), float((arrival - t_ns).min()) * 1e-9)
        limit_ns = max(LATE_PERIODS * self._period_s, LATE_S) * 1e9
        self.counts.late += int(np.count_nonzero(arrival - t_ns > limit_ns))
        self.counts.samples += len(fresh)
        return keep, t_ns

    def restart(self) -> None:
        """Treat the next count as that of a restarted device: the pause in arrivals then tells how many were missed.

        The fit of the clock is forgotten; the counts so far are kept.
        """
        self._last, self.fit, self._least_s = -1, HostFit(), math.inf

    @property
    def _period_s(self) -> float:
        return self.tick_s * self.ticks_per_sample

    def _look_for_wraps(self, device_s: float, lateness_s: float) -> None:
        """Count whole wraps as lost, and move the count on by them, if all samples of the last 0.3 s came so much too
        late.

        ``device_s`` is the device time of the newest sample, ``lateness_s`` the least lateness in its batch. Less than
        0.9 of a wrap is not taken for a loss. A decision is made once in 0.3 s of device time; before that nothing
        changes.
        """
        if self._least_s == math.inf:
            self._since_s = device_s
        self._least_s = min(self._least_s, lateness_s)
        if device_s - self._since_s < _PROOF_S:
            return
        wrap_s = self.modulus * self.tick_s
        if self._least_s >= _NEARLY * wrap_s:
            wraps = round(self._least_s / wrap_s)
            self._last += wraps * self.modulus
            self.counts.lost += round(wraps * self.modulus / self.ticks_per_sample)
        self._least_s = math.inf

    def _impossible(self, device_s: float, arrival_ns: int) -> bool:
        """Return whether a sample came well before its time: then the count does not go on from where it was."""
        return self.fit.known and self.fit.lateness(device_s, arrival_ns) < -_IMPOSSIBLY_EARLY_S

    def _count_lost(self, step: Stamps, arrival_ns: int) -> None:
        """Count the samples missing between new counters as lost; ``step`` (n,) are their differences in ticks.

        After a restart there is no last counter: the gap in arrival times before ``arrival_ns`` (the first new one)
        stands for the first step. Before anything has arrived, the first step counts nothing.
        """
        if self._last < 0:
            if self._last_arrival_ns is not None:
                gap = round((arrival_ns - self._last_arrival_ns) * 1e-9 / self._period_s)
                self.counts.lost += max(gap - 1, 0)
            step = step[1:]
        missing = np.round(step / self.ticks_per_sample).astype(np.int64) - 1
        self.counts.lost += int(np.maximum(missing, 0).sum())

    def _unwrap(self, counter: Stamps, last_arrival_ns: int) -> tuple[Stamps, bool]:
        """Return counters continued over wraps (n,), and whether each is exactly one sample after the one before.

        ``counter`` (n,) is continued from the last count, or from its own first value after a restart. A step back by
        less than two samples, seen as one just short of a whole wrap, counts as backwards. Whole wraps are added where
        ``last_arrival_ns``, the arrival of the last sample, shows them; if all steps are even, only if it shows them
        clearly. Nothing is counted or remembered.
        """
        if self._last < 0 or self._last_arrival_ns is None:
            before = start = int(counter[0])
            expected = float(start)
        else:
            before, start = self._last % self.modulus, self._last
            expected = start + (last_arrival_ns - self._last_arrival_ns) * 1e-9 / self.tick_s
        step = np.empty(len(counter), dtype=np.int64)
        step[0] = counter[0] - before
        np.subtract(counter[1:], counter[:-1], out=step[1:])
        step %= self.modulus
        even = bool((step == self.ticks_per_sample).all())
        if not even:
            step[step > self.modulus - 2 * self.ticks_per_sample] -= self.modulus
        unwrapped = step.cumsum() + start
        behind = (expected - int(unwrapped[-1])) / self.modulus
        wraps = max(round(behind), 0)
        if even and wraps and not self._are_wraps(behind):
            wraps = 0
        return unwrapped + self.modulus * wraps, even and not wraps

    def _are_wraps(self, behind: float) -> bool:
        """Return whether ``behind`` is clearly a whole number of wraps, given the jitter of the arrivals."""
        known = self.fit.alignment
        jitter = 3 * known.jitter_rms_s / (self.modulus * self.tick_s) if known is not None else 0.0
        return abs(behind - round(behind)) < _NEAR_WHOLE + jitter < 2 * _NEAR_WHOLE
