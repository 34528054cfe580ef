"""Times of samples that carry no count and are known to be taken regularly."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np

from drivers.clocks.alignment import HostFit
from drivers.clocks.arrival_delay import Lateness
from drivers.clocks.counter_clock import LATE_PERIODS, LATE_S
from drivers.types import Alignment, Flags, Floats, SourceCounts, Stamps

_MOST_STATES = 400
_GROUPS = 64
_LOST_FIRST = 0.004  # share of samples that are lost, until it is known
_ONE_OF_LOSSES = 0.8  # share of the losses of one sample among all
_LONG_GAP = 0.95  # for longer losses, each further sample is less likely by this factor
_REPEATED = 0.02  # share of samples like the one before that are the one before
_CERTAIN = 0.999
_UNLIKELY = 1e-4
_MOST_DRIFT = 2e-3  # a larger one could not be distinguished from losses
_LEAST_STEP = 0.1  # in periods
_TOO_EARLY_PERIODS, _TOO_EARLY_S = 5.0, 0.05  # nothing arrives before it was taken


class RegularClock:
    """Times of samples without a counter that are known to be taken regularly.

    Samples are held back for a short while, because only later samples tell a late one from a lost one: after a loss
    all later samples keep coming a period late, after a stall they catch up. After a doubled sample all later ones come
    a period early; it is dropped where two neighbours are equal.

    Where arrivals jitter by less than the period, each loss can be placed a few samples later. Where they jitter by
    more, a sample's place is its mean over all possible losses (forward-backward smoothing of a hidden Markov chain),
    at the latest ``Lateness.LONGEST_S`` later; the number of losses is then right.

    A sender that falls behind for seconds looks like one that loses samples. When it catches up, samples seem to come
    before they were taken. The clock then starts anew and drops as many samples as were counted as lost meanwhile,
    whose times would run backwards.
    """

    HOLD = 8
    """How many later samples there must be before one is given its time."""
    MOST = 256
    """How many are held at the most, should the rhythm not come back; or a second's, where that is more."""

    def __init__(self, period_s: float, counts: SourceCounts) -> None:
        """Start empty, for samples every ``period_s`` on average; losses and repeats are added to ``counts``."""
        self._period_s = period_s
        self._counts = counts
        self._most = max(self.MOST, round(1 / period_s))
        self._held: list[tuple[int, Floats | float, bytes]] = []  # arrival_ns, values, raw bytes
        self._last_raw = b""
        self._last_arrival_ns: int | None = None
        self._last_t_ns = -(2**62)
        self._resumed_ns: int | None = None  # last arrival before a break
        self._begin()

    def _begin(self) -> None:
        """Forget the clock fit, the lateness and the place in the rhythm; held samples, counts and the last time given
        are kept.
        """
        self._fit = HostFit()
        self._lateness = Lateness(self._period_s)
        self._next = 0  # place of the first held sample, if nothing was lost
        self._shifts = np.ones(1)  # probabilities that 0, 1, 2 ... more were lost before it
        self._last_place = -1.0
        self._least_s = math.inf  # excess of the earliest, until more is known
        self._lost_before = self._counts.lost
        self._given = 0
        self._look_again = 0

    @property
    def alignment(self) -> Alignment | None:
        """The device's clock relative to the loop's; None in the first seconds.

        Where jitter hides single losses, the uncertainties include a drift that could hide behind them.
        """
        found = self._fit.alignment
        hidden = self._lateness.hidden_drift
        if found is None or not hidden:
            return found
        # Where jitter hides single losses, they and a drift look alike.
        return replace(
            found,
            sd_offset_s=math.hypot(found.sd_offset_s, self._period_s / math.sqrt(12)),
            sd_drift_ppm=math.hypot(found.sd_drift_ppm, hidden * 1e6 / math.sqrt(3)),
        )

    def add(self, arrival_ns: int, values: Floats | float, raw: bytes) -> None:
        """Add one sample, a number or a row (k,); equal samples have equal ``raw`` bytes."""
        self._held.append((arrival_ns, values, raw))

    def restart(self) -> None:
        """Begin anew after a break, whose length tells how many samples were lost; no sample may be held any more."""
        self._begin()
        self._resumed_ns = self._last_arrival_ns

    @property
    def due(self) -> bool:
        """Whether enough samples are held for ``ready`` to return some."""
        return len(self._held) >= max(2 * self.HOLD, self._look_again)

    def ready(self, *, flush: bool = False) -> tuple[Stamps, Stamps, Floats] | None:
        """Return (t_ns, arrival_ns, values) of the held samples that can be timed, in their order; None if there are
        none.

        All three are (n,), or values (n, k) where samples are rows. Without ``flush`` nothing is timed until ``due``;
        with it all held samples are, those too that would wait for later ones. Doubled samples are dropped, as are
        those whose time would not be later than the last one returned. The counts are updated. If all samples come well
        before they can have been taken, the clock starts anew.
        """
        if not self._held or not (self.due or flush):
            return None
        arrival = np.array([row[0] for row in self._held], dtype=np.int64)
        # In a burst only the last came as soon as it could; the last of all may be followed by another yet.
        own = np.append(np.abs(np.diff(arrival)) > 0.2e9 * self._period_s, False)
        certain = flush or len(arrival) >= self._most
        place, known, kept = self._places(arrival, own, certain=certain, flush=flush)
        if not len(place):
            return None
        if self._too_early(place, arrival[: len(kept)][kept]):
            self._begin()
            return self.ready(flush=flush)
        rows, self._held, self._look_again = self._held[: len(kept)], self._held[len(kept) :], 0
        self._last_raw = rows[-1][2]
        arrival = arrival[: len(kept)][kept]
        values = np.array([row[1] for row, keep in zip(rows, kept, strict=True) if keep])
        t_ns = self._time_ns(place, arrival, own[: len(kept)][kept], known)
        later = t_ns > self._last_t_ns
        if not later.all():
            self._counts.samples -= int(np.count_nonzero(~later))
            t_ns, arrival, values = t_ns[later], arrival[later], values[later]
        if not len(t_ns):
            return None
        self._last_t_ns = int(t_ns[-1])
        return t_ns, arrival, values

    def _too_early(self, place: Floats, arrival: Stamps) -> bool:
        """Return whether all samples seem to come well before they were taken."""
        if not self._given:
            return False
        early_s = -float(self._fit.lateness_of(place * self._period_s, arrival).max())
        return early_s > max(_TOO_EARLY_PERIODS * self._period_s, _TOO_EARLY_S)

    def _search(self, excess: Floats, unqueued: Flags) -> "_Search":
        """Search for lost and doubled samples among ``excess`` (n,) in s; ``unqueued`` marks samples that waited for no
        other.

        While no lateness has been learned, a first search gives a better guess of it, and a second search uses that,
        which then counts as learned.
        """
        equal = self._equal()
        if not self._lateness.learned:
            self._lateness.guess(excess[unqueued], self._least(excess))
            better = excess - self._searched(excess, unqueued, equal).mean * self._period_s
            self._lateness.guess(better[unqueued], float(better.min()))
        return self._searched(excess, unqueued, equal)

    def _searched(self, excess: Floats, unqueued: Flags, equal: Flags) -> "_Search":
        """Search once among ``excess`` (n,) in s, with the present lateness.

        ``unqueued`` (n,) marks samples that waited for no other, ``equal`` (n,) those that repeat the one before.
        """
        return _Search(
            lateness=self._lateness,
            period_s=self._period_s,
            excess=excess,
            unqueued=unqueued,
            equal=equal,
            before=self._shifts,
            lost_share=self._lost_share,
        )

    def _equal(self) -> Flags:
        """Return which of the held samples equal the one before."""
        raws = [self._last_raw, *(row[2] for row in self._held)]
        return np.array([now == before for before, now in pairwise(raws)])

    def _least(self, excess: Floats) -> float:
        """Return the excess (s) of samples that are not late, or the best guess of it while nothing has been learned.

        The guess is the least excess of samples timed so far; before any, that of ``excess`` (n,). If those contain a
        doubled one, only the samples up to it are used, as all later ones seem early; all are, if most equal the one
        before.
        """
        if self._lateness.learned:
            return self._lateness.least_s
        if self._given:
            return self._least_s
        equal = self._equal()
        if equal.mean() > 0.5 or not equal[1:].any():
            return float(excess.min())
        return float(excess[: int(equal[1:].argmax()) + 1].min())  # after one that is doubled, all seem early

    def _time_ns(self, place: Floats, arrival: Stamps, unqueued: Flags, known: Flags) -> Stamps:
        """Update the clock fit, the lateness and the counts with samples whose place is known; return their times (n,)
        in ns.

        ``place`` (n,) in periods, ``arrival`` (n,) in ns; ``known`` marks places that are certain, ``unqueued`` samples
        that waited for no other. After a break in reading, the pause itself counts as lost samples. The count of losses
        never falls.
        """
        device_s = place * self._period_s
        drifted_s = float(self._fit.drifted(device_s[-1:])[0])
        self._lateness.add(device_s, self._fit.excess_of(device_s, arrival), unqueued, drifted_s, self._fit.drift)
        self._fit.most_drift = self._lateness.hidden_drift or _MOST_DRIFT
        self._fit.add(device_s, arrival, known)
        t_ns = self._fit.time_ns(device_s)
        lateness_s = (arrival - t_ns) * 1e-9
        self._given += len(place)
        self._counts.samples += len(place)
        self._counts.late += int(np.count_nonzero(lateness_s > max(LATE_PERIODS * self._period_s, LATE_S)))
        if self._resumed_ns is not None:  # not counted meanwhile: the pause gives the number
            missed = round((int(arrival[0]) - self._resumed_ns) * 1e-9 / self._period_s) - 1
            self._lost_before += max(missed, 0)
            self._resumed_ns = None
        lost = self._lost_before + round(float(place[-1])) + 1 - self._given
        self._counts.lost = max(self._counts.lost, lost)
        self._last_place, self._last_arrival_ns = float(place[-1]), int(arrival[-1])
        return t_ns

    def _places(self, arrival: Stamps, unqueued: Flags, *, certain: bool, flush: bool) -> tuple[Floats, Flags, Flags]:
        """Return the places of the held samples that can be timed, which places are certain, and which samples to keep.

        ``arrival`` (n,) in ns and ``unqueued`` (n,), samples that waited for no other, are of all held samples. Flags
        ``kept`` (m,) are of the m oldest of them; those not marked are doubled ones. Places, in periods and rising, and
        their certainty are of the kept ones. All three are empty while later samples are needed. Otherwise the rhythm
        moves on past the m samples, and repeats are counted. If the last samples came in time, no search is made.
        ``certain`` decides now, even without a steady lateness; ``flush`` leaves nothing held.
        """
        place = self._next + np.arange(len(arrival), dtype=np.float64)
        device_s = place * self._period_s
        excess = self._fit.excess_of(device_s, arrival) - self._fit.drifted(device_s)
        if self._in_time(excess):
            take = len(place) - (0 if flush else self.HOLD)
            self._next += take
            self._least_s = min(self._least_s, float(excess[:take].min()))
            kept = np.ones(take, dtype=np.bool_)
            return place[:take], kept, kept
        hold = 0 if flush else self._lateness.hold
        if not certain and len(place) < hold + hold // 2:
            self._look_again = hold + hold // 2
            return place[:0], unqueued[:0], unqueued[:0]
        search = self._search(excess, unqueued)
        if not certain and not self._lateness.steady((excess - search.mean * self._period_s)[unqueued]):
            self._look_again = len(place) + max(self.HOLD, len(place) // 8)
            return place[:0], unqueued[:0], unqueued[:0]
        take = max(len(place) - hold, 1)
        take, base, self._shifts = search.cut(take)
        self._next += take + base
        kept = np.ones(take, dtype=np.bool_)
        repeats = search.repeats[search.repeats < take]
        kept[repeats] = False
        self._counts.repeated += len(repeats)
        place = (place + search.mean)[:take][kept]
        place[0] = max(place[0], self._last_place + _LEAST_STEP)
        steps = np.arange(len(place)) * _LEAST_STEP
        return np.maximum.accumulate(place - steps) + steps, search.certain[:take][kept], kept

    @property
    def _lost_share(self) -> float:
        seen = 1000.0
        lost = self._counts.lost - self._lost_before
        return min(max((lost + _LOST_FIRST * seen) / (self._given + lost + seen), 1e-3), 0.1)

    def _in_time(self, excess: Floats) -> bool:
        """Return whether the last samples are in time, so that nothing was lost or doubled before them."""
        late = (excess - self._least(excess)) / self._period_s
        sharp = self._lateness.sharp and len(self._shifts) == 1
        return bool(sharp and late.min() > -0.5 and late[-self.HOLD :].min() < 0.6)


class _Search:
    """Lost and doubled samples, inferred from how late samples came.

    State of the hidden Markov chain: by how many places a sample is ahead of where it would be without losses or
    repeats. Where jitter is many periods, samples are treated in groups.
    """

    def __init__(
        self,
        *,
        lateness: Lateness,
        period_s: float,
        excess: Floats,
        unqueued: Flags,
        equal: Flags,
        before: Floats,
        lost_share: float,
    ) -> None:
        """Run the search over n samples; it sets ``mean``, ``certain`` and ``repeats``.

        ``mean`` (n,) is how many places were lost before each sample, ``certain`` (n,) which of these are sure,
        ``repeats`` the indices of doubled samples to drop. ``excess`` (n,) in s, of no losses; ``unqueued`` and
        ``equal`` (n,) mark samples that waited for no other and that repeat the one before. ``before`` are the
        probabilities of 0, 1, 2 ... losses before the first, ``lost_share`` that of a loss per sample.
        """
        back = min(int(equal.sum()), 8)
        most = min(max(lateness.most_lost(excess[unqueued]), len(before) + 1), _MOST_STATES)
        self._states = np.arange(-back, most + 1)
        self._group = group = max(1, lateness.hold // _GROUPS)
        self._starts = np.arange(0, len(excess), group)
        costs = lateness.costs(excess[:, None] - self._states * period_s, unqueued)
        costs = np.add.reduceat(costs, self._starts, axis=0)
        weights = np.exp(costs.min(axis=1, keepdims=True) - costs)
        twice = np.logical_or.reduceat(equal, self._starts)
        start = np.zeros(len(self._states))
        start[back : back + len(before)] = before
        posterior, self._forward, down = _smooth(weights, start, twice, 1 - (1 - lost_share) ** group)
        sure = posterior.max(axis=1) > _CERTAIN
        mean = np.where(sure, self._states[posterior.argmax(axis=1)], posterior @ self._states)
        # A group in which, or next to which, something was lost has no certain place.
        moved = np.diff(mean, prepend=mean[0]) != 0
        near = moved | np.append(moved[1:], False)
        self.mean = np.repeat(mean, group)[: len(excess)]
        self.certain = np.repeat(sure & ~near, group)[: len(excess)] & unqueued
        groups = np.flatnonzero(down > 0.5)
        self.repeats = np.array([self._starts[g] + int(equal[self._starts[g] :].argmax()) for g in groups], dtype=int)

    def cut(self, take: int) -> tuple[int, int, Floats]:
        """Return what is known of the losses at a cut: (samples before it, fewest plausible losses, probabilities).

        The cut is at ``take`` samples, rounded down to whole groups, at least one group; at the end if there are no
        more than ``take``. The probabilities are those of 0, 1, 2 ... losses more than the fewest, without implausible
        ends; the fewest is negative where samples may have been doubled.
        """
        groups = len(self._starts) if take >= len(self.mean) else max(take // self._group, 1)
        taken = min(groups * self._group, len(self.mean))
        shares = self._forward[groups - 1]
        likely = np.flatnonzero(shares > _UNLIKELY)
        shares = shares[likely[0] : likely[-1] + 1]
        return taken, int(self._states[likely[0]]), shares / shares.sum()


def _smooth(weights: Floats, start: Floats, twice: Flags, lost_share: float) -> tuple[Floats, Floats, Floats]:
    """Return probabilities of k states for n groups: given all data (n, k), given data so far (n, k); of a repeat (n,).

    ``weights`` (n, k) are likelihoods of the observations in each state, ``start`` (k,) the probabilities before. A
    loss, of probability ``lost_share``, moves up by any number of states; a repeat, possible only where ``twice`` (n,),
    moves down by one. A group that no state explains is judged by its weights alone.
    """
    count = len(start)
    up = np.subtract.outer(np.arange(count), np.arange(count)).T
    long_gaps = (1 - _ONE_OF_LOSSES) * (1 - _LONG_GAP) * _LONG_GAP ** np.maximum(up - 1, 0)
    step = np.where(up > 0, lost_share * (long_gaps + _ONE_OF_LOSSES * (up == 1)), 0.0)
    step += (1 - lost_share) * np.eye(count)
    step_twice = step + _REPEATED * np.eye(count, k=-1)
    forward = np.empty_like(weights)
    ahead = np.empty_like(weights)
    now = start
    for i, weight in enumerate(weights):
        now = (now @ (step_twice if twice[i] else step)) * weight
        total = float(now.sum())
        now = now / total if total > 0 else weight / weight.sum()
        forward[i] = now
    back = np.ones(count)
    for i in range(len(weights) - 1, -1, -1):
        ahead[i] = back
        back = (step_twice if twice[i] else step) @ (weights[i] * back)
        back /= max(float(back.max()), 1e-300)
    posterior = forward * ahead
    posterior /= np.maximum(posterior.sum(axis=1, keepdims=True), 1e-300)
    repeated = np.zeros(len(weights))
    for j in np.flatnonzero(twice):
        before = forward[j - 1] if j else start
        both = (weights[j] * ahead[j])[:-1] * before[1:] * _REPEATED
        every = (before @ step_twice) @ (weights[j] * ahead[j])
        repeated[j] = both.sum() / max(float(every), 1e-300)
    return posterior, forward, repeated
