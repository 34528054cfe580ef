"""When a sample was taken: device counters, or regular sampling, aligned to the host's clock.

Delays are one-sided: a sample can come late, never early. So the earliest arrivals of each second tell the
device's time, and a robust line through them carries its offset and drift. That line moves slowly, hence a
sample's time never jumps. Arrivals themselves are only used for this.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from drivers.seams import SourceCounts

Floats = NDArray[np.float64]
Stamps = NDArray[np.int64]

_BUCKET_S = 1.0
_BUCKETS = 120  # two minutes of earliest arrivals
_MIN_BUCKETS_FOR_DRIFT = 10
_SLEW = 1e-3  # how fast the line may move: 1 ms a second
_LATE_PERIODS = 2.0
_LOSS_COST = 6.0  # in samples that came a period late: how much it takes to believe in a loss
_REPEAT_COST = 4.0


class HostFit:
    """Line from device time (s since its first sample) to host time (ns)."""

    def __init__(self) -> None:
        """Start with nothing known."""
        self._origin_ns: int | None = None
        self._offset_s = 0.0  # of the line in use, at _at_s
        self._slope = 0.0
        self._at_s = 0.0
        self._earliest: deque[tuple[float, float]] = deque(maxlen=_BUCKETS)
        self._bucket: list[float] = []  # end of the bucket, device time and excess of its earliest arrival

    def add(self, device_s: Floats, arrival_ns: Stamps) -> None:
        """Take in arrivals of samples taken at these device times."""
        if self._origin_ns is None:
            self._origin_ns = int(arrival_ns[0]) - round(device_s[0] * 1e9)
            first = (arrival_ns - self._origin_ns) * 1e-9 - device_s
            self._offset_s = float(first.min())
        excess = (arrival_ns - self._origin_ns) * 1e-9 - device_s
        best = int(np.argmin(excess))
        at, value = float(device_s[best]), float(excess[best])
        if not self._bucket:
            self._bucket = [at + _BUCKET_S, at, value]
        elif value < self._bucket[2]:
            self._bucket[1:] = [at, value]
        if value < self._line(at) and len(self._earliest) < 2:
            self._offset_s = value - self._slope * (at - self._at_s)  # nothing settled yet: take it at once
        if float(device_s[-1]) >= self._bucket[0]:
            self._earliest.append((self._bucket[1], self._bucket[2]))
            self._bucket = []
            self._move_line(float(device_s[-1]))

    def time_ns(self, device_s: Floats) -> Stamps:
        """Return host times of device times."""
        host_s = device_s + self._offset_s + self._slope * (device_s - self._at_s)
        return np.asarray((self._origin_ns or 0) + np.round(host_s * 1e9), dtype=np.int64)

    def lateness_of(self, device_s: Floats, arrival_ns: Stamps) -> Floats:
        """Return how much later than its time each sample came, in s."""
        line = self._offset_s + self._slope * (device_s - self._at_s)
        return np.asarray((arrival_ns - (self._origin_ns or 0)) * 1e-9 - device_s - line)

    @property
    def known(self) -> bool:
        """Whether anything has been taken in."""
        return self._origin_ns is not None

    def _line(self, device_s: float) -> float:
        return self._offset_s + self._slope * (device_s - self._at_s)

    def _move_line(self, now_s: float) -> None:
        points = np.array(self._earliest)
        at, excess = points[:, 0], points[:, 1]
        slope = 0.0
        if len(points) >= _MIN_BUCKETS_FOR_DRIFT:
            # Theil-Sen over well separated pairs: single late seconds do not bend it.
            half = len(points) // 2
            slope = float(np.median((excess[half:] - excess[:-half]) / (at[half:] - at[:-half])))
            wanted = float(np.median(excess - slope * (at - now_s)))
        else:
            wanted = float(excess.min())
        step = wanted - self._line(now_s)
        limit = _SLEW * _BUCKET_S
        self._offset_s = self._line(now_s) + min(max(step, -limit), limit)
        self._at_s, self._slope = now_s, slope


@dataclass(slots=True)
class CounterClock:
    """Times of samples that carry a wrapping counter of a known tick."""

    tick_s: float
    modulus: int
    ticks_per_sample: int
    counts: SourceCounts = field(default_factory=SourceCounts)
    fit: HostFit = field(default_factory=HostFit)
    _last: int = -1  # unwrapped count of the last sample
    _last_arrival_ns: int = 0

    def stamp(self, counter: Stamps, arrival_ns: Stamps) -> tuple[NDArray[np.bool_], Stamps]:
        """Return which samples are new (n,), and the times in ns of those.

        Gaps longer than the counter's wrap are resolved by the arrival of the last sample: what was queued
        comes together, and the last of it waited least.
        """
        unwrapped = self._unwrap(counter, int(arrival_ns[-1]))
        newest = np.maximum.accumulate(np.concatenate([[self._last], unwrapped]))[:-1]
        keep = unwrapped > newest
        step = (unwrapped - newest)[keep]
        if self._last < 0 and len(step):
            step[0] = self.ticks_per_sample
        self.counts.repeated += int(np.sum(~keep))
        missing = np.round(step / self.ticks_per_sample).astype(int) - 1
        self.counts.lost += int(np.maximum(missing, 0).sum())
        fresh = unwrapped[keep]
        if not len(fresh):
            return keep, np.empty(0, dtype=np.int64)
        self._last, self._last_arrival_ns = int(fresh[-1]), int(arrival_ns[-1])
        device_s = np.asarray(fresh * self.tick_s, dtype=np.float64)
        self.fit.add(device_s, arrival_ns[keep])
        t_ns = self.fit.time_ns(device_s)
        late = (arrival_ns[keep] - t_ns).astype(np.float64) * 1e-9
        period = self.tick_s * self.ticks_per_sample
        self.counts.late += int(np.sum(late > max(_LATE_PERIODS * period, 0.05)))
        self.counts.samples += len(fresh)
        return keep, t_ns

    def _unwrap(self, counter: Stamps, last_arrival_ns: int) -> Stamps:
        """Return counts that go on over the wrap; a step just short of a whole wrap is one backwards."""
        before = counter[:1] if self._last < 0 else np.array([self._last % self.modulus])
        step = np.diff(np.concatenate([before, counter])) % self.modulus
        step = np.where(step > self.modulus - 2 * self.ticks_per_sample, step - self.modulus, step)
        start = int(counter[0]) if self._last < 0 else self._last
        unwrapped = start + np.cumsum(step)
        if self._last >= 0:
            expected = self._last + (last_arrival_ns - self._last_arrival_ns) * 1e-9 / self.tick_s
            unwrapped += self.modulus * max(round((expected - int(unwrapped[-1])) / self.modulus), 0)
        return np.asarray(unwrapped, dtype=np.int64)


class RegularClock:
    """Times of samples that carry no counter and are known to be taken regularly.

    Samples are held back a little while, because only what follows tells a late sample from a lost one: after
    a loss all later samples keep coming a period late, after a stall they catch up. A doubled sample shows in
    that all later ones keep coming a period early; it is dropped where two neighbours are equal.
    """

    HOLD = 8
    """How many later samples there must be before one is given its time."""
    PROOF = 32
    """How many later samples must agree, in a steady rhythm, that one was lost or doubled."""
    MOST = 256
    """How many are held at the most, should the rhythm not come back."""

    def __init__(self, period_s: float, counts: SourceCounts) -> None:
        """Start empty, for samples that come every ``period_s`` on average."""
        self._period_s = period_s
        self._counts = counts
        self._fit = HostFit()
        self._held: list[tuple[int, float, bytes]] = []  # arrival_ns, value, raw bytes
        self._next = 0
        self._last_raw = b""
        self._look_again = 0

    def add(self, arrival_ns: int, value: float, raw: bytes) -> None:
        """Take in one sample; ``raw`` is what equal samples share."""
        self._held.append((arrival_ns, value, raw))

    @property
    def due(self) -> bool:
        """Whether enough is held for ``ready`` to give something."""
        return len(self._held) >= 2 * self.HOLD

    def ready(self, *, everything: bool = False) -> tuple[Stamps, Stamps, Floats] | None:
        """Return (t_ns, arrival_ns, value) of the samples that can be timed, or None while too few are held."""
        if not self._held or not (self.due or everything):
            return None
        index = self._index_held(certain=everything or len(self._held) >= self.MOST)
        take = len(index) if everything else len(index) - self.HOLD
        if take <= 0:
            return None
        rows, self._held, self._look_again = self._held[:take], self._held[take:], 0
        arrival = np.array([row[0] for row in rows], dtype=np.int64)
        device_s = np.asarray(index[:take] * self._period_s, dtype=np.float64)
        self._fit.add(device_s, arrival)
        t_ns = self._fit.time_ns(device_s)
        last = int(index[take - 1])
        self._counts.samples += take
        self._counts.lost += last + 1 - self._next - take
        self._counts.late += int(np.sum((arrival - t_ns) * 1e-9 > max(_LATE_PERIODS * self._period_s, 0.05)))
        self._next, self._last_raw = last + 1, rows[-1][2]
        return t_ns, arrival, np.array([row[1] for row in rows])

    def _index_held(self, *, certain: bool) -> NDArray[np.int64]:
        """Return the sample index of each held sample, as far as it is known; drops repeats from the held ones."""
        arrival = np.array([row[0] for row in self._held], dtype=np.int64)
        index = self._next + np.arange(len(arrival))
        device_s = np.asarray(index * self._period_s, dtype=np.float64)
        if not self._fit.known:
            self._fit.add(device_s, arrival)
        lag = self._fit.lateness_of(device_s, arrival) / self._period_s
        if lag.min() > -0.5 and lag[-self.HOLD :].min() < 0.6:
            return index  # the last ones are in time, so nothing was lost or doubled before them
        if not certain and len(self._held) < self._look_again:
            return index[:0]
        self._look_again = len(self._held) + self.HOLD  # the search below is dear
        raws = [self._last_raw, *(row[2] for row in self._held)]
        shift = _likeliest_shifts(lag, [now == before for before, now in pairwise(raws)])
        events = np.flatnonzero(np.diff(shift, prepend=0))
        if len(events) and not certain and not self._steady(lag - shift, int(events[-1])):
            first = int(events[0])
            return index[:first] if first > self.HOLD else index[:0]
        repeats = np.flatnonzero(np.diff(shift, prepend=0) < 0)
        for i in repeats[::-1]:
            del self._held[i]
        self._counts.repeated += len(repeats)
        return np.delete(index + shift, repeats)

    def _steady(self, lag: Floats, last_event: int) -> bool:
        """Return whether the rhythm since has been steady: while a sender catches up, lag proves nothing."""
        half = self.PROOF // 2
        if len(lag) - last_event < self.PROOF:
            return False
        return bool(abs(lag[-half:].min() - lag[-self.PROOF : -half].min()) < 0.3)


def _likeliest_shifts(lag: Floats, equal: list[bool]) -> NDArray[np.int64]:
    """Return by how many samples each held sample is further on than if none had been lost or doubled before.

    The cheapest path (Viterbi) through the shifts that the lags (in periods) suggest: coming early is all but
    impossible, late is likely, a loss is rare, a doubled sample is rare and must equal its neighbour.
    """
    shifts = np.unique(np.concatenate([[0], np.round(lag), np.floor(lag), np.floor(lag) - 1])).astype(np.int64)
    step = shifts[None, :] - shifts[:, None]  # from row to column
    onward = np.where(step > 0, _LOSS_COST + 0.05 * step, np.where(step == 0, 0.0, np.inf))
    onward_equal = np.where(step == -1, _REPEAT_COST, onward)
    cost = np.where(shifts == 0, 0.0, np.inf)
    came_from = np.empty((len(lag), len(shifts)), dtype=np.int64)
    for i, (now, same) in enumerate(zip(lag, equal, strict=True)):
        total = cost[:, None] + (onward_equal if same else onward)
        came_from[i] = np.argmin(total, axis=0)
        late = now - shifts
        cost = total.min(axis=0) + 10 * np.maximum(-late - 0.3, 0) + np.clip(late, 0, 3)
    path = np.empty(len(lag), dtype=np.int64)
    state = int(np.argmin(cost))
    for i in range(len(lag) - 1, -1, -1):
        path[i] = state
        state = int(came_from[i, state])
    return shifts[path]
