"""How late samples arrive, learned from past ones, and how many samples were lost to judge by that."""

import math

import numpy as np

from drivers.clocks.alignment import median
from drivers.types import Flags, Floats

_KEPT = 4096
_OVER_S = 60.0  # older arrivals are forgotten
_FEWEST = 100
_ROUGH = 512
_HIDDEN_DRIFT = 1e-4
_HIDING = 0.6  # jitter, in periods, that hides single losses
_HIDING_SHARE = 0.3  # or where no more than these waited for no other
_RELEARN_S = 2.0
_HALF_LIFE_S = 10.0  # of the estimated share of samples that wait for none, and of their correlation
_FLOOR = 0.003  # density of impossible delays, over the highest
_EARLY_COST, _MOST_EARLY_COST = 1.0, 20.0  # in nats a bin of the histogram, beyond its ends
_LATE_COST, _MOST_LATE_COST = 0.2, 3.0
_LEAST_WEIGHT = 0.1
_LITTLE_PERIODS = 0.03


class _Newest:
    """Ring buffer of the newest rows; their order is not kept."""

    def __init__(self, most: int, columns: int) -> None:
        self._kept = np.empty((most, columns))
        self._count = 0

    def __len__(self) -> int:
        return min(self._count, len(self._kept))

    @property
    def rows(self) -> Floats:
        return self._kept[: len(self)]

    def add(self, rows: Floats) -> None:
        rows = rows[-len(self._kept) :]
        at = (self._count + np.arange(len(rows))) % len(self._kept)
        self._kept[at] = rows
        self._count += len(rows)


class Lateness:
    """Histogram of the excess (arrival time minus device time, s) of samples that did not wait for another one.

    A sample that arrives together with the next one waited for it, in a buffer or for a poll. It only shows that it was
    not taken later.
    """

    PROOF = 32
    """How many later samples must agree, in a steady rhythm, that one was lost or doubled."""
    LONGEST_S = 0.3
    """How long samples are held at the most for the sake of jitter, in a steady rhythm."""

    def __init__(self, period_s: float) -> None:
        """Start without data, for samples that are taken every ``period_s``."""
        self._period_s = period_s
        self._seen = _Newest(_KEPT, 2)  # device time and excess
        self._rough = _Newest(_ROUGH, 1)  # changes of excess from one to the next
        self._every = max(1, round(_OVER_S / period_s / _KEPT))
        self._new = 0
        self._lagged, self._square = 0.0, 1e-18  # sums of products of neighbours
        self._own, self._all = 1e-9, 1e-9
        self._weight, self._share = 1.0, 1.0
        self._rms_s: float | None = None
        self._low = self._middle = self._high = 0.0
        self._width, self._first, self._costs = 1.0, 0.0, np.zeros(1)
        self.sharp = True
        """Whether the earliest are no more than a tenth of a period apart."""

    @property
    def learned(self) -> bool:
        """Whether anything is known."""
        return self._rms_s is not None

    @property
    def least_s(self) -> float:
        """The excess that one sample of a hundred undercuts."""
        return self._low

    @property
    def hidden_drift(self) -> float:
        """Largest drift (s/s) to assume where jitter may hide losses, which look like drift; else 0.

        0 as well while there are fewer than 100 pairs of neighbouring samples that waited for no other.
        """
        if len(self._rough) < _FEWEST:
            return 0.0
        jitter_s = median(np.abs(self._rough.rows[:, 0]))
        hiding = jitter_s > _HIDING * self._period_s or self._share < _HIDING_SHARE
        return _HIDDEN_DRIFT if hiding else 0.0

    @property
    def hold(self) -> int:
        """How many later samples it takes to place a loss: ``PROOF`` or more, at most as many as come in ``LONGEST_S``.

        The more jitter and the more samples that wait for others, the more it takes; the most while nothing is learned.
        """
        longest = max(self.PROOF, round(self.LONGEST_S / self._period_s))
        if self._rms_s is None:
            return longest
        jitter = self._rms_s / self._period_s
        return min(max(self.PROOF, round(8 * (1 + jitter**2) / self._share)), longest)

    def guess(self, excess: Floats, least_s: float) -> None:
        """Make a first histogram from early samples, some of which may have been lost.

        ``excess`` (n,) in s gives the scatter, ``least_s`` the least excess; fewer than two values count as no scatter.
        It counts as ``learned`` from then on. The scatter is estimated robustly against single losses and doubled
        samples, and is at least a twentieth of the period. The histogram is that of an exponential distribution which
        begins at ``least_s``, its mean one scatter above.
        """
        if len(excess) < 2:
            excess = np.zeros(2)
        at = np.arange(len(excess)) - (len(excess) - 1) / 2
        slope = max(float(at @ excess) / float(at @ at), 0.0)
        # Lost or repeated samples make the first of these too large, but not the second.
        level = float((excess - slope * at).std())
        steps = 2.0 * float(np.median(np.abs(np.diff(excess))))
        rms_s = max(min(level, steps), 0.05 * self._period_s)
        self._learn(least_s - rms_s * np.log(1 - (np.arange(1000) + 0.5) / 1000))

    def add(self, device_s: Floats, excess: Floats, unqueued: Flags, drifted_s: float, drift: float) -> None:
        """Add samples whose place in the rhythm is known, at least one, and compute the histogram anew once enough have
        come.

        ``device_s`` and ``excess`` (n,) in s; of both only the samples marked in ``unqueued`` (n,), which waited for no
        other, enter, thinned out at high rates. ``drifted_s`` is the part of the excess due to clock drift at the last
        sample, ``drift`` its growth per second. Enough are 100 samples in all, and since the last time those of 2 s or
        a quarter of all in memory. Every call updates how many samples wait for others and how far neighbours are late
        together, both with more weight on recent ones.
        """
        keep = 0.5 ** (len(unqueued) * self._period_s / _HALF_LIFE_S)
        self._own, self._all = keep * self._own + float(unqueued.sum()), keep * self._all + len(unqueued)
        self._new += len(unqueued)
        newest_s = float(device_s[-1])
        device_s, excess = device_s[unqueued], excess[unqueued]
        self._seen.add(np.column_stack([device_s[:: self._every], excess[:: self._every]]))
        if len(excess) > 1:
            self._rough.add((excess[1:] - excess[:-1])[:, None])
            about = np.clip(excess - drifted_s, self._low, self._high) - self._middle
            # Delays far below a period do not count as late, together or not.
            little = len(about) * (_LITTLE_PERIODS * self._period_s) ** 2
            self._square = keep * self._square + float(about[1:] @ about[1:]) + little
            self._lagged = keep * self._lagged + float(about[1:] @ about[:-1])
        enough = min(len(self._seen) * self._every // 4, round(_RELEARN_S / self._period_s))
        if len(self._seen) >= _FEWEST and self._new >= enough:
            self._new = 0
            at, all_excess = self._seen.rows.T
            self._learn(all_excess - drifted_s - drift * (at - newest_s))

    def _learn(self, excess: Floats) -> None:
        """Compute the histogram, its costs and its statistics from ``excess`` (n,) in s, drift removed.

        The statistics leave out the lowest and the highest hundredth. Neighbouring samples that are late together count
        as less than two: the correlation between them lowers the weight.
        """
        low, high = (float(v) for v in np.percentile(excess, [1.0, 99.0]))
        inner = excess[(excess >= low) & (excess <= high)]
        rms_s = max(float(inner.std()), 1e-6)
        self._rms_s, self._low, self._middle, self._high = rms_s, low, float(inner.mean()), high
        self.sharp = bool(low - excess.min() < 0.1 * self._period_s)
        self._share = max(self._own / self._all, 0.02)
        # Neighbours that are late together are no two witnesses.
        along = self._lagged / self._square
        self._weight = min(max((1 - along) / (1 + along), _LEAST_WEIGHT), 1.0)
        self._width = width = min(rms_s / 5, max(self._period_s / 3, (high - low) / 300))
        edges = np.arange(low - 3 * width, high + 4 * width, width)
        hits = np.histogram(excess, edges)[0].astype(np.float64)
        blur = max(rms_s * min(0.4, 4 / math.sqrt(len(excess))) / width, 0.7)
        reach = np.arange(-math.ceil(3 * blur), math.ceil(3 * blur) + 1)
        kernel = np.exp(-0.5 * (reach / blur) ** 2)
        density = np.convolve(hits, kernel / kernel.sum())
        self._first = edges[0] + reach[0] * width
        self._costs = -np.log(density / density.max() + _FLOOR)

    def costs(self, excess: Floats, unqueued: Flags) -> Floats:
        """Return costs (n, k) in nats of n samples with k hypothetical values of ``excess`` (n, k) in s each.

        A cost is the negative log-likelihood by the histogram, limited on both sides and scaled down if neighbours are
        late together. Rows that are not marked in ``unqueued`` (n,) waited for another sample: they cost more than the
        least only where they are too early. The costs mean nothing before ``guess`` or ``add`` has made a histogram.
        """
        likeliest = self._first + (int(self._costs.argmin()) + 0.5) * self._width
        excess = np.where(unqueued[:, None] | (excess < likeliest), excess, likeliest)
        bins = np.floor((excess - self._first) / self._width).astype(np.int64)
        last = len(self._costs) - 1
        cost = self._costs[np.clip(bins, 0, last)]
        cost += np.minimum(np.maximum(-bins, 0) * _EARLY_COST, _MOST_EARLY_COST)
        cost += np.minimum(np.maximum(bins - last, 0) * _LATE_COST, _MOST_LATE_COST)
        return np.asarray(cost * self._weight)

    def steady(self, excess: Floats) -> bool:
        """Return whether the mean excess has been constant lately; while a sender catches up, lateness proves nothing.

        ``excess`` (n,) in s are samples that waited for no other, losses taken into account. False while there are too
        few or nothing has been learned.
        """
        half = max(round(self.hold * self._share / 2), 1)
        if len(excess) < 2 * half or self._rms_s is None:
            return False
        allowed = max(0.3 * self._period_s, 4 * self._rms_s * math.sqrt(2 / (half * self._weight)))
        return bool(abs(np.mean(excess[-half:]) - np.mean(excess[-2 * half : -half])) < allowed)

    def most_lost(self, excess: Floats) -> int:
        """Return how many samples at most can have been lost before the last of ``excess`` (n,) in s; 1 if it is empty.

        ``excess`` is of samples that waited for no other; the limit follows from the median of the newest of them, with
        two in reserve: it is at least 2.
        """
        last = excess[-max(round(self.hold * self._share / 2), 8) :]
        if not len(last):
            return 1
        high = float(np.median(last)) - self._middle + (self._rms_s or 0.0)
        return max(math.ceil(high / self._period_s), 0) + 2
