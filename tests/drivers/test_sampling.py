"""Sample times: device counters, and regular sampling without one, from arrivals that are only ever late."""

from __future__ import annotations

import copy

import numpy as np
import pytest
from clocks import Timed, counted, drift_of, regular

from drivers.clocks.sampling import CounterClock, RegularClock
from drivers.types import SourceCounts

PERIOD_S = 0.01
TICK_S, MODULUS, TICKS = 1 / 2000, 256, 16  # a STIM300 at 125 Hz: its counter wraps every 16 samples
COUNTER_PERIOD_S = TICK_S * TICKS


def ns(t_s: np.ndarray) -> np.ndarray:
    return np.round(t_s * 1e9).astype(np.int64)


def stamped(
    samples: np.ndarray, arrival_s: np.ndarray, rows: int = 2
) -> tuple[np.ndarray, np.ndarray, np.ndarray, SourceCounts]:
    """Feed samples of these numbers, a few rows at a time: kept (n,), kept samples, their times, the counts."""
    clock = CounterClock(TICK_S, MODULUS, TICKS)
    counter = samples * TICKS % MODULUS
    parts = [clock.stamp(counter[i : i + rows], ns(arrival_s[i : i + rows])) for i in range(0, len(samples), rows)]
    kept = np.concatenate([keep for keep, _ in parts])
    return kept, samples[kept], np.concatenate([t for _, t in parts]) * 1e-9, clock.counts


def timed(
    values: np.ndarray, arrival_s: np.ndarray, period_s: float = PERIOD_S
) -> tuple[np.ndarray, np.ndarray, np.ndarray, SourceCounts]:
    """Feed samples one by one; return times, arrivals and values of those that came out, and the counts."""
    counts = SourceCounts()
    clock = RegularClock(period_s, counts)
    parts = []
    for value, arrival_ns in zip(values, ns(arrival_s), strict=True):
        clock.add(int(arrival_ns), float(value), np.float64(value).tobytes())
        parts.append(clock.ready())
    parts.append(clock.ready(flush=True))
    found = [part for part in parts if part is not None]
    t_ns, arrival_ns, value = (np.concatenate([part[i] for part in found]) for i in range(3))
    return t_ns * 1e-9, arrival_ns * 1e-9, value, counts


def rms_s(t_s: np.ndarray, true_s: np.ndarray) -> float:
    return float(np.sqrt(np.mean((t_s - true_s) ** 2)))


@pytest.mark.parametrize("rows", [1, 3, 15])
def test_a_counter_that_wraps_gives_even_times(rows: int) -> None:
    samples = np.arange(1000)
    true_s = 5 + samples * COUNTER_PERIOD_S
    _, _, t_s, counts = stamped(samples, true_s, rows)
    np.testing.assert_allclose(t_s, true_s, atol=2e-9)
    assert counts == SourceCounts(samples=1000)


@pytest.mark.parametrize("lost", [1, 3, 7, 15, 16, 17, 100, 1000])
def test_a_gap_is_counted_and_what_follows_keeps_its_time(lost: int) -> None:
    samples = np.delete(np.arange(3000), np.arange(1000, 1000 + lost))
    true_s = samples * COUNTER_PERIOD_S
    _, kept, t_s, counts = stamped(samples, true_s)
    np.testing.assert_allclose(t_s, kept * COUNTER_PERIOD_S, atol=2e-9)
    assert counts == SourceCounts(samples=3000 - lost, lost=lost)


@pytest.mark.parametrize("rows", [1, 2, 5])
def test_a_repeated_count_is_one_sample(rows: int) -> None:
    samples = np.sort(np.concatenate([np.arange(1000), [500, 501, 900]]))
    kept, found, t_s, counts = stamped(samples, samples * COUNTER_PERIOD_S, rows)
    np.testing.assert_array_equal(found, np.arange(1000))
    assert len(kept) == 1003
    np.testing.assert_allclose(t_s, np.arange(1000) * COUNTER_PERIOD_S, atol=2e-9)
    assert counts == SourceCounts(samples=1000, repeated=3)


@pytest.mark.parametrize("drift", [50e-6, -50e-6])
def test_counter_times_follow_a_drifting_device_beneath_one_sided_jitter(drift: float) -> None:
    samples = np.arange(125 * 60)
    for seed in range(3):
        rng = np.random.default_rng(seed)
        true_s = 1 + samples * COUNTER_PERIOD_S * (1 + drift)
        _, _, t_s, counts = stamped(samples, np.sort(true_s + rng.uniform(0, 1e-3, len(samples))))
        quarter = len(samples) // 4
        assert rms_s(t_s[quarter:], true_s[quarter:]) < 0.2e-3
        assert np.all(np.diff(t_s) > 0)
        assert counts == SourceCounts(samples=len(samples))


def test_a_counter_sample_that_comes_late_keeps_its_time_and_is_counted_late() -> None:
    samples = np.arange(1000)
    true_s = samples * COUNTER_PERIOD_S
    arrival_s = true_s.copy()
    arrival_s[600:608] = true_s[607]  # 56 ms late at the most, and all at once
    _, _, t_s, counts = stamped(samples, arrival_s, 4)
    np.testing.assert_allclose(t_s, true_s, atol=2e-9)
    assert counts == SourceCounts(samples=1000, late=1)


def test_a_clean_stream_without_counter_is_timed_exactly() -> None:
    samples = np.arange(2000)
    true_s = 3 + samples * PERIOD_S
    t_s, arrival_s, value, counts = timed(samples, true_s)
    np.testing.assert_allclose(t_s, true_s, atol=2e-9)
    np.testing.assert_allclose(arrival_s, true_s, atol=2e-9)
    np.testing.assert_array_equal(value, samples)
    assert counts == SourceCounts(samples=2000)


@pytest.mark.parametrize("drift", [0.0, 50e-6])
def test_losses_are_counted_and_times_are_right_beneath_jitter(drift: float) -> None:
    for seed in range(3):
        rng = np.random.default_rng(seed)
        samples = np.flatnonzero(rng.random(6000) > 0.01)
        true_s = 1 + samples * PERIOD_S * (1 + drift)
        t_s, _, value, counts = timed(samples, true_s + rng.uniform(0, 1e-3, len(samples)))
        missing = int(samples[-1]) + 1 - len(samples)
        np.testing.assert_array_equal(value, samples)
        assert counts.lost == pytest.approx(missing, rel=0.1)
        assert counts.repeated == 0
        assert rms_s(t_s, true_s) < 2e-3


@pytest.mark.parametrize("repeat_delay_s", [0.0, 2e-3])
def test_doubled_samples_are_dropped_and_counted(repeat_delay_s: float) -> None:
    rng = np.random.default_rng(4)
    doubled = rng.choice(np.arange(50, 3000), 20, replace=False)
    samples = np.sort(np.concatenate([np.arange(3000), doubled]))
    again = np.diff(samples, prepend=-1) == 0
    arrival_s = (samples * PERIOD_S) + rng.uniform(0, 1e-3, 3000)[samples] + repeat_delay_s * again
    t_s, _, value, counts = timed(samples, arrival_s)
    np.testing.assert_array_equal(value, np.arange(3000))
    assert rms_s(t_s, np.arange(3000) * PERIOD_S) < 0.5e-3
    assert (counts.samples, counts.repeated, counts.lost) == (3000, 20, 0)


def test_neighbours_that_are_equal_and_in_time_are_no_repeats() -> None:
    rng = np.random.default_rng(5)
    arrival_s = np.arange(3000) * PERIOD_S + rng.uniform(0, 1e-3, 3000)
    *_, counts = timed(np.zeros(3000), arrival_s)
    assert counts == SourceCounts(samples=3000)


@pytest.mark.parametrize("stall_s", [0.1, 0.25, 1.0])
def test_a_stall_with_catch_up_is_no_loss(stall_s: float) -> None:
    true_s = np.arange(3000) * PERIOD_S
    arrival_s = true_s.copy()
    behind = arrival_s[1000] + stall_s + 0.004 * np.arange(2000)
    arrival_s[1000:] = np.maximum(arrival_s[1000:], behind)
    t_s, _, value, counts = timed(np.arange(3000), arrival_s)
    np.testing.assert_allclose(t_s, true_s, atol=2e-9)
    np.testing.assert_array_equal(value, np.arange(3000))
    assert (counts.samples, counts.lost, counts.repeated) == (3000, 0, 0)
    assert counts.late > 0


def test_few_samples_are_held_back_and_all_come_out_in_the_end() -> None:
    counts = SourceCounts()
    clock = RegularClock(PERIOD_S, counts)
    out = 0
    for i in range(500):
        clock.add(i * 10_000_000, float(i), bytes([i % 256]))
        if clock.due and (ready := clock.ready()) is not None:
            out += len(ready[0])
        assert i + 1 - out <= 2 * RegularClock.HOLD
    last = clock.ready(flush=True)
    assert last is not None
    assert out + len(last[0]) == counts.samples == 500
    assert clock.ready(flush=True) is None


def test_samples_are_not_held_for_ever_when_the_rhythm_does_not_come_back() -> None:
    counts = SourceCounts()
    clock = RegularClock(PERIOD_S, counts)
    rng = np.random.default_rng(6)
    arrival_ns = ns(np.cumsum(rng.uniform(0.001, 0.08, 2000)))
    out = 0
    for i, at in enumerate(arrival_ns):
        clock.add(int(at), float(i), i.to_bytes(4))
        ready = clock.ready()
        out += 0 if ready is None else len(ready[0])
        assert i + 1 - out <= RegularClock.MOST + RegularClock.HOLD


@pytest.mark.parametrize("stall_s", [0.06, 0.15, 0.25, 1.0])
def test_what_was_queued_in_a_stall_is_no_loss(stall_s: float) -> None:
    clock = CounterClock(1 / 2000, 256, 16)  # 125 Hz, the counter wraps each 128 ms
    period_s, count = 0.008, 2000
    arrival_s = np.arange(count) * period_s
    stalled = (arrival_s >= 8.0) & (arrival_s < 8.0 + stall_s)
    arrival_s[stalled] = 8.0 + stall_s
    times = []
    i = 0
    while i < count:
        same = int(np.searchsorted(arrival_s, arrival_s[i], side="right"))
        counter = (np.arange(i, same) * 16) % 256
        _, t_ns = clock.stamp(counter, np.full(same - i, round(arrival_s[i] * 1e9)))
        times.append(t_ns)
        i = same
    assert clock.counts.lost == 0
    assert np.abs(np.concatenate(times) * 1e-9 - np.arange(count) * period_s).max() < 1e-3


@pytest.mark.parametrize("missing", [7, 8, 10, 12])
def test_a_gap_within_a_chunk_is_counted_and_does_not_run_backwards(missing: int) -> None:
    clock = CounterClock(1 / 2000, 256, 16)
    index = np.concatenate([np.arange(10), np.arange(10 + missing, 30)])
    _, t_ns = clock.stamp((index * 16) % 256, np.full(len(index), round(index[-1] * 0.008e9)))
    assert clock.counts.lost == missing
    assert clock.counts.repeated == 0
    assert np.all(np.diff(t_ns) > 0)


def rms_after_s(run: Timed, since_s: float = 5.0) -> float:
    return float(np.sqrt(np.mean(run.error_s[run.true_s >= since_s] ** 2)))


LONG_S = {100: 60.0, 500: 30.0, 2000: 8.0}
JITTER = [("usb polls", "in order"), ("uneven polls", "in order"), ("uniform", "free"), ("exponential", "free")]
KINDS = [
    pytest.param(
        *jitter, rate_hz, marks=[] if rate_hz == 100 or (rate_hz == 2000 and jitter is JITTER[0]) else pytest.mark.full
    )
    for rate_hz in LONG_S
    for jitter in JITTER
]


@pytest.mark.parametrize(("delay", "order", "rate_hz"), KINDS)
def test_with_a_counter_times_are_right_to_200_us_beneath_5_ms_of_jitter(delay: str, order: str, rate_hz: int) -> None:
    runs = [counted(delay, order, rate_hz, LONG_S[rate_hz], seed) for seed in range(2)]
    assert np.sqrt(np.mean([rms_after_s(run) ** 2 for run in runs])) < 0.2e-3
    for run in runs:
        assert np.diff(run.t_s).min() > 0
        assert run.lost == 1.0


@pytest.mark.parametrize(("delay", "order", "rate_hz"), KINDS)
def test_without_a_counter_times_are_right_to_1_ms_and_losses_are_counted_beneath_5_ms_of_jitter(
    delay: str, order: str, rate_hz: int
) -> None:
    runs = [regular(delay, order, rate_hz, LONG_S[rate_hz], seed) for seed in range(2)]
    assert np.sqrt(np.mean([rms_after_s(run) ** 2 for run in runs])) < 1e-3
    for run in runs:
        assert np.diff(run.t_s).min() > 0
        assert run.lost == pytest.approx(1.0, abs=0.05)
        assert run.held_s < 0.5


@pytest.mark.parametrize("timed", [counted, regular])
def test_jitter_to_both_sides_leaves_an_offset_that_stays(timed: object) -> None:
    for seed in range(2):
        run = timed("normal", "free", 500, 30.0, seed)  # type: ignore[operator]
        late = run.error_s[run.true_s >= 10.0]
        assert late.std() < (0.2e-3 if timed is counted else 1e-3)


@pytest.mark.parametrize(
    ("delay", "order"), [JITTER[0], *(pytest.param(*jitter, marks=pytest.mark.full) for jitter in JITTER[1:])]
)
def test_a_counted_clock_tells_its_drift_and_how_well_it_is_known(delay: str, order: str) -> None:
    scores = []
    for seed in range(4):
        found = counted(delay, order, 250, 30.0, seed).alignment
        assert found is not None
        assert 0 < found.sd_offset_s < 0.2e-3
        assert 3e-3 < found.jitter_rms_s < 7e-3
        scores.append((found.drift_ppm - 1e6 * drift_of(seed)) / found.sd_drift_ppm)
    assert np.sqrt(np.mean(np.square(scores))) < 3.0


def test_where_losses_could_pass_for_drift_the_drift_is_said_to_be_unknown() -> None:
    found = regular("exponential", "free", 2000, 20.0, 1).alignment
    assert found is not None
    assert found.sd_drift_ppm > 50


def test_the_offset_is_that_of_the_line_in_use() -> None:
    samples = np.arange(1000)
    clock = CounterClock(TICK_S, MODULUS, TICKS)
    assert clock.alignment is None
    clock.stamp(samples[:1] * TICKS % MODULUS, ns(7.0 + samples[:1] * COUNTER_PERIOD_S))
    for i in range(1, 1000):
        clock.stamp(samples[i : i + 1] * TICKS % MODULUS, ns(7.0 + samples[i : i + 1] * COUNTER_PERIOD_S))
    assert clock.alignment is not None
    assert clock.alignment.offset_s == pytest.approx(7.0, abs=1e-8)
    assert clock.alignment.jitter_rms_s < 1e-6


@pytest.mark.parametrize("away_s", [0.5, 20.0])
def test_a_device_that_begins_to_count_anew_gets_right_times_again(away_s: float) -> None:
    clock = CounterClock(1e-4, 1 << 32, 100)  # a clock of 10 kHz that wraps after five days
    before = 5.0 + np.arange(3000) * 0.01
    after = before[-1] + away_s + np.arange(1000) * 0.01
    counter = np.concatenate([7_000_000 + np.arange(3000) * 100, np.arange(1000) * 100])
    true_s = np.concatenate([before, after])
    times = [clock.stamp(counter[i : i + 1], ns(true_s[i : i + 1]))[1] for i in range(len(true_s))]
    np.testing.assert_allclose(np.concatenate(times) * 1e-9, true_s, atol=2e-9)
    assert clock.counts.lost == round(away_s / 0.01) - 1


def test_a_clock_that_is_told_of_a_break_goes_on_by_arrivals() -> None:
    counts = SourceCounts()
    clock = RegularClock(PERIOD_S, counts)
    true_s = np.concatenate([np.arange(300), 500 + np.arange(300)]) * PERIOD_S
    times = []
    for i, at_ns in enumerate(ns(true_s)):
        if i == 300:
            last = clock.ready(flush=True)
            assert last is not None
            times.append(last[0])
            clock.restart()
        clock.add(int(at_ns), float(i), i.to_bytes(4))
        if (ready := clock.ready()) is not None:
            times.append(ready[0])
    last = clock.ready(flush=True)
    assert last is not None
    np.testing.assert_allclose(np.concatenate([*times, last[0]]) * 1e-9, true_s, atol=2e-9)
    assert (counts.samples, counts.lost) == (600, 200)


JITTER_S = 0.004
"""Arrivals that scatter so much leave open at first whether a count has missed a wrap (of 128 ms)."""


def jittery(samples: np.ndarray, late_s: float | np.ndarray = 0.0) -> np.ndarray:
    """Return arrivals (n,) in order, exponentially late, of samples that are sent later by ``late_s``."""
    jitter_s = np.random.default_rng(8).exponential(JITTER_S, len(samples))
    return np.maximum.accumulate(samples * COUNTER_PERIOD_S + late_s + jitter_s)


@pytest.mark.parametrize("wraps", [1.0, 1.5])
def test_a_late_sender_on_a_jittery_line_is_no_lost_wrap(wraps: float) -> None:
    samples = np.arange(125 * 15)
    true_s = samples * COUNTER_PERIOD_S
    behind = (true_s >= 10.0) & (true_s < 10.25)
    _, _, t_s, counts = stamped(samples, jittery(samples, wraps * MODULUS * TICK_S * behind), 1)
    assert (counts.samples, counts.lost, counts.repeated) == (len(samples), 0, 0)
    assert counts.late >= np.count_nonzero(behind)
    np.testing.assert_allclose(t_s[true_s > 5], true_s[true_s > 5], atol=0.5e-3)


@pytest.mark.parametrize(("wraps", "first"), [(1, 1250), (1, 1280), (2, 1260)])
def test_a_lost_wrap_on_a_jittery_line_is_found_once_samples_have_stayed_late(wraps: int, first: int) -> None:
    lost = wraps * MODULUS // TICKS
    samples = np.delete(np.arange(125 * 15), np.arange(first, first + lost))
    true_s = samples * COUNTER_PERIOD_S
    _, _, t_s, counts = stamped(samples, jittery(samples), 1)
    assert counts.lost == lost
    assert counts.samples == len(samples)
    assert np.all(np.diff(t_s) > 0)
    since_s = true_s - (first + lost) * COUNTER_PERIOD_S
    not_yet, found = (since_s >= 0) & (since_s < 0.29), since_s > 0.61  # all of a stretch of 0.3 s must be late
    np.testing.assert_allclose(t_s[not_yet], true_s[not_yet] - lost * COUNTER_PERIOD_S, atol=0.5e-3)
    np.testing.assert_allclose(t_s[found], true_s[found], atol=0.5e-3)


def behind_for_seconds(
    count: int, lag_s: float, pace_s: float, jitter_s: float = 1e-3
) -> tuple[np.ndarray, np.ndarray]:
    """Return true times and arrivals (n,) of a sender that from 10 s on is behind by ever more, from 13 s by ``lag_s``.

    At 15 s it begins to catch up, with ``pace_s`` from sample to sample.
    """
    true_s = np.arange(count) * PERIOD_S
    own_s = true_s + np.random.default_rng(9).uniform(0, jitter_s, count)
    arrival_s = own_s + np.interp(true_s, [10.0, 13.0], [0.0, lag_s])
    for i in np.flatnonzero(arrival_s >= 15.0):
        arrival_s[i] = max(own_s[i], max(arrival_s[i - 1], 15.0) + pace_s)
    return true_s, np.maximum.accumulate(arrival_s)


@pytest.mark.parametrize(("lag_s", "pace_s"), [(0.3, 0.0), (0.5, 0.008), (1.0, 0.006), (2.0, 0.002)])
def test_a_sender_that_falls_behind_and_catches_up_loses_what_was_counted_lost(lag_s: float, pace_s: float) -> None:
    true_s, arrival_s = behind_for_seconds(2500, lag_s, pace_s)
    t_s, _, value, counts = timed(np.arange(2500), arrival_s)
    dropped = 2500 - len(value)
    assert dropped == pytest.approx(lag_s / PERIOD_S, rel=0.1)
    assert counts.lost == pytest.approx(dropped, abs=1)
    assert (counts.samples, counts.repeated) == (len(value), 0)
    assert np.all(np.diff(t_s) > 0)
    error_s = t_s - true_s[value.astype(np.int64)]
    assert np.abs(error_s[value < 1000]).max() < 1e-3
    assert np.abs(error_s[value > 2000]).max() < 1e-3


def test_all_that_is_held_comes_out_when_the_stream_ends_while_the_sender_catches_up() -> None:
    _, arrival_s = behind_for_seconds(1560, 0.3, 0.0)
    counts = SourceCounts()
    clock = RegularClock(PERIOD_S, counts)
    for i, at_ns in enumerate(ns(arrival_s)):
        clock.add(int(at_ns), float(i), i.to_bytes(4))
        clock.ready()
        if i >= 1500:
            ending, told = copy.deepcopy((clock, counts))
            ending.ready(flush=True)
            assert told.samples + told.lost >= i


def test_nothing_is_dropped_after_a_break_for_what_was_counted_lost_before_it() -> None:
    _, arrival_s = behind_for_seconds(1530, 2.0, 0.0)
    counts = SourceCounts()
    clock = RegularClock(PERIOD_S, counts)
    for i, at_ns in enumerate(ns(arrival_s)):
        clock.add(int(at_ns), float(i), i.to_bytes(4))
        clock.ready()
    clock.ready(flush=True)
    clock.restart()
    before = counts.samples
    again_s = 100 + np.arange(300) * PERIOD_S
    for i, at_ns in enumerate(ns(again_s)):
        clock.add(int(at_ns), float(i), i.to_bytes(4))
    last = clock.ready(flush=True)
    assert last is not None
    np.testing.assert_allclose(last[0] * 1e-9, again_s, atol=2e-9)
    assert counts.samples == before + 300
