"""How right sample times are: clocks with drift, arrivals that jitter, samples that are lost.

python tests/bench/clocks.py                 every kind of delay, 100 Hz to 2 kHz, with a counter and without
python tests/bench/clocks.py --seeds 20 --seconds 120 --delays "usb polls"

Arrival = time taken + delay. Delays scatter by 5 ms rms about their mean. The constant part of a delay cannot be seen
in arrivals, so times are judged against the time taken plus the least delay of the run (rms), and about their own
mean (sd), which is what remains for delays that have no edge. "in order" is a stream: nothing overtakes, so a late
sample holds up those behind it; "free" delays are those of each sample by itself.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray

from drivers.clocks.sampling import Alignment, CounterClock, RegularClock
from drivers.types import SourceCounts

Floats = NDArray[np.float64]

JITTER_S = 5e-3
DRIFT = 50e-6
LOST = 0.01
TICK_S, MODULUS = 1 / 2000, 256  # a STIM300's counter: it wraps every 128 ms
SETTLED_S = 5.0
CHUNK_S = 5e-3  # bytes of so long are taken from the link at once
GATHER_S = 0.03  # and frames


def _uniform(true_s: Floats, rng: np.random.Generator) -> Floats:
    return rng.uniform(0, JITTER_S * np.sqrt(12), len(true_s))


def _exponential(true_s: Floats, rng: np.random.Generator) -> Floats:
    return rng.exponential(JITTER_S, len(true_s))


def _half_normal(true_s: Floats, rng: np.random.Generator) -> Floats:
    return np.abs(rng.normal(0, JITTER_S / np.sqrt(1 - 2 / np.pi), len(true_s)))


def _normal(true_s: Floats, rng: np.random.Generator) -> Floats:
    return np.maximum(25e-3 + rng.normal(0, JITTER_S, len(true_s)), 0.0)


def _usb_polls(true_s: Floats, rng: np.random.Generator) -> Floats:
    """Return delays of a host that polls regularly and gets all that has come."""
    step = JITTER_S * np.sqrt(12)
    return step - np.mod(true_s + rng.uniform(0, step), step)


def _uneven_polls(true_s: Floats, rng: np.random.Generator) -> Floats:
    ends = np.cumsum(rng.exponential(JITTER_S, int(true_s[-1] / JITTER_S * 1.2) + 200))
    return ends[np.searchsorted(ends, true_s)] - true_s


DELAYS: dict[str, tuple[Callable[[Floats, np.random.Generator], Floats], tuple[str, ...]]] = {
    "usb polls": (_usb_polls, ("in order",)),
    "uneven polls": (_uneven_polls, ("in order",)),
    "uniform": (_uniform, ("free", "in order")),
    "exponential": (_exponential, ("free", "in order")),
    "half normal": (_half_normal, ("free", "in order")),
    "normal": (_normal, ("free", "in order")),
}


@dataclass(frozen=True, slots=True, eq=False)
class Timed:
    """Times that a clock gave, with the truth: error (n,) against true time plus least delay, and true time (n,)."""

    error_s: Floats
    true_s: Floats
    t_s: Floats
    lost: float
    held_s: float
    cpu: float
    alignment: Alignment | None
    offset_error_s: float


def stream(
    delay: str, order: str, rate_hz: float, seconds: float, seed: int
) -> tuple[NDArray[np.int64], Floats, Floats]:
    """Return numbers, times and arrivals of the samples that are not lost."""
    rng = np.random.default_rng(seed)
    number = np.flatnonzero((rng.random(int(rate_hz * seconds)) >= LOST) | (np.arange(int(rate_hz * seconds)) == 0))
    true_s = 3.0 + number / rate_hz * (1 + drift_of(seed))
    arrival_s = true_s + DELAYS[delay][0](true_s, rng)
    return number, true_s, np.maximum.accumulate(arrival_s) if order == "in order" else arrival_s


def drift_of(seed: int) -> float:
    """Return the drift of a run."""
    return DRIFT if seed % 2 else -DRIFT


def counted(delay: str, order: str, rate_hz: float, seconds: float, seed: int) -> Timed:
    """Time a stream by its counter."""
    number, true_s, arrival_s = stream(delay, order, rate_hz, seconds, seed)
    ticks = max(round(1 / (TICK_S * rate_hz)), 1)
    clock = CounterClock(TICK_S, MODULUS, ticks)
    counter, arrival_ns = number * ticks % MODULUS, np.round(arrival_s * 1e9).astype(np.int64)
    rows = max(int(rate_hz * CHUNK_S), 1)
    parts, began = [], time.process_time()
    for i in range(0, len(number), rows):
        parts.append(clock.stamp(counter[i : i + rows], arrival_ns[i : i + rows]))
    cpu = (time.process_time() - began) / seconds
    kept = np.concatenate([keep for keep, _ in parts])
    t_s = np.concatenate([t for _, t in parts]) * 1e-9
    return _timed(t_s, true_s[kept], arrival_s[kept], number, clock.counts, 0.0, cpu, clock.alignment)


def regular(delay: str, order: str, rate_hz: float, seconds: float, seed: int) -> Timed:
    """Time a stream by its rhythm."""
    number, true_s, arrival_s = stream(delay, order, rate_hz, seconds, seed)
    counts = SourceCounts()
    clock = RegularClock(1 / rate_hz, counts)
    every = max(int(rate_hz * GATHER_S), 1)
    parts, given, held_s, began = [], 0, 0.0, time.process_time()
    for i, arrival_ns in enumerate(np.round(arrival_s * 1e9).astype(np.int64).tolist()):
        clock.add(arrival_ns, float(i), i.to_bytes(8))
        if i % every == 0 and clock.due and (ready := clock.ready()) is not None:
            parts.append(ready[0])
            given += len(ready[0])
            held_s = max(held_s, arrival_s[i] - arrival_s[given])
    last = clock.ready(flush=True)
    cpu = (time.process_time() - began) / seconds
    t_s = np.concatenate([*parts, *([] if last is None else [last[0]])]) * 1e-9
    return _timed(t_s, true_s, arrival_s, number, counts, held_s, cpu, clock.alignment)


def _timed(
    t_s: Floats,
    true_s: Floats,
    arrival_s: Floats,
    number: NDArray[np.int64],
    counts: SourceCounts,
    held_s: float,
    cpu: float,
    alignment: Alignment | None,
) -> Timed:
    error_s = t_s - true_s - (arrival_s - true_s).min()
    lost = counts.lost / max(int(number[-1]) + 1 - len(number), 1)
    return Timed(error_s, true_s - true_s[0], t_s, lost, held_s, cpu, alignment, float(error_s[-1]))


def figures(run: Callable[[int], Timed], seeds: int) -> str:
    """Return a line of figures over seeds."""
    done = [(seed, run(seed)) for seed in range(seeds)]
    late = [t.error_s[t.true_s >= SETTLED_S] for _, t in done]

    def rms_ms(errors: list[Floats]) -> float:
        return 1e3 * float(np.sqrt(np.mean([np.mean(e**2) for e in errors])))

    aligned = [(seed, t, t.alignment) for seed, t in done if t.alignment is not None]
    drift = [(a.drift_ppm - 1e6 * drift_of(seed)) / max(a.sd_drift_ppm, 1e-3) for seed, _, a in aligned]
    return (
        f"{rms_ms(late):7.3f} {rms_ms([e - e.mean() for e in late]):7.3f} {rms_ms([t.error_s for _, t in done]):7.3f}  "
        f"{min(t.lost for _, t in done):5.2f} {max(t.lost for _, t in done):5.2f}  "
        f"{max(t.held_s for _, t in done):5.2f}  {100 * float(np.mean([t.cpu for _, t in done])):5.1f}  "
        f"{1e3 * min(float(np.diff(t.t_s).min()) for _, t in done):8.3f}  "
        f"{float(np.mean([a.sd_offset_s for _, _, a in aligned])) * 1e3:7.3f} "
        f"{float(np.mean([a.sd_drift_ppm for _, _, a in aligned])):6.2f} "
        f"{float(np.sqrt(np.mean(np.square(drift)))):5.1f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--rates", default="100,500,2000")
    parser.add_argument("--delays", default=",".join(DELAYS))
    parser.add_argument("--clocks", default="counter,regular")
    asked = parser.parse_args()
    print("times in ms; lost: counted over true, least and most; held in s; cpu in % of a core; step: least in ms;")
    print("alignment: its standard uncertainties of offset (ms) and drift (ppm), rms of drift error over the latter")
    print(f"{'':38s}  rms>5s   sd>5s rms all    lost        held    cpu      step   sd off  drift   e/sd")
    for name in asked.clocks.split(","):
        timed = {"counter": counted, "regular": regular}[name]
        for delay in asked.delays.split(","):
            for order in DELAYS[delay][1]:
                for rate in map(float, asked.rates.split(",")):
                    run = partial(timed, delay, order, rate, asked.seconds)
                    print(f"{name:8s} {delay:13s} {order:9s} {rate:5.0f} {figures(run, asked.seeds)}", flush=True)


if __name__ == "__main__":
    main()
