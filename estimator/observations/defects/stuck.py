"""Sources that repeat the same few samples while the table turns them differently."""

import math

import numpy as np

from estimator.recordings.motion.body_rates import BodyRates
from estimator.recordings.recording import ImuData, Recording
from estimator.types import Flags, runs_of

_LONG_S, _AWRY_NS = 1.0, 400_000_000  # stamps may be off the table's by the second, so that a rest is not "stuck"
_TOGETHER_S, _TOGETHER = 0.05, 8  # samples of this length, and this number, may be sent and repeated together
# By which the sensed rate changes meanwhile: no resolution is so coarse.
_OTHERWISE_RPS = float(np.radians(1.0))
_BY_CHANCE, _FEWEST_EQUAL = 1e-6, 4.0  # that so many samples in a row are equal; never fewer than so many


def longest_by_chance(alike: float) -> float:
    """Return how many samples in a row are equal by chance, at least four; infinite where nothing changes.

    ``alike``, from 0 to 1, is the probability that a sample equals the one before.
    """
    if alike >= 1:
        return math.inf
    return max(math.log(_BY_CHANCE) / math.log(alike), _FEWEST_EQUAL) if alike > 0 else _FEWEST_EQUAL


def stuck_doubts(recording: Recording) -> list[str]:
    """Return sentences on the sources that repeated old samples while the table turned differently, and when.

    They repeat them for more than a second, in which the rate about a sense axis changes by more than 1 deg/s. Empty
    without a table.
    """
    table = recording.table
    if table is None:
        return []
    doubts, rates = [], None
    for source, data in recording.sources.items():
        # Coarse counts repeat by chance in tens of thousands of runs, nearly all of them short.
        runs = np.array(runs_of(_seen_before(data)), dtype=np.intp).reshape(-1, 2)
        spans_ns = data.t_ns[np.column_stack([np.maximum(runs[:, 0] - 1, 0), runs[:, 1] - 1])]
        for first_ns, last_ns in spans_ns[np.ptp(spans_ns, axis=1) > _LONG_S * 1e9]:
            rates = rates or BodyRates.of(table, recording.site)
            within_ns = np.clip([first_ns + _AWRY_NS, last_ns - _AWRY_NS], rates.starts_ns, rates.final_until_ns - 1)
            turned = rates.at(np.linspace(within_ns[0], within_ns[1], 200).astype(np.int64)) @ data.array.p.T
            if np.ptp(turned, axis=0).max() > _OTHERWISE_RPS:
                after_s = (first_ns - table.t_ns[0]) * 1e-9
                doubts.append(
                    f"{data.device or source}: the same samples were repeated from {after_s:.1f} s on for "
                    f"{(last_ns - first_ns) * 1e-9:.1f} s in which it was turned otherwise: it is stuck"
                )
    return list(dict.fromkeys(doubts))


def _seen_before(data: ImuData) -> Flags:
    """Return as flags (n,) which samples equal, bit by bit, those of a moment before; samples all at a limit do not
    count.

    A moment is 50 ms, or eight samples if that is longer.
    """
    values = np.ascontiguousarray(data.rate_rps, dtype=np.float64)
    bits = values.view(np.int64)
    key = (bits * np.arange(0x9E3779B97F4A7C1, 0x9E3779B97F4A7C1 + 2 * bits.shape[1], 2)).sum(axis=1)
    order = np.argsort(key, kind="stable")
    rows_ago = np.full(len(key), len(key))
    rows_ago[order[1:]] = np.where(np.diff(key[order]) == 0, np.diff(order), len(key))
    step_s = max(float(np.median(np.diff(data.t_ns[:10000]))) * 1e-9, 1e-6) if len(key) > 1 else _LONG_S
    low, top = np.fmin.reduce(values, initial=np.inf), np.fmax.reduce(values, initial=-np.inf)
    return np.asarray((rows_ago <= max(_TOGETHER_S / step_s, _TOGETHER)) & ((low < values) & (values < top)).any(1))
