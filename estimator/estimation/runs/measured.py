"""Block means of output errors and body rates, from samples or from turns between them, and their weights.

Noise may grow with the rate (scale factor noise): variance s0^2 (1 + (g w)^2), as steady rates show it. Second
differences of block means hold neither bias nor scale factor error nor any effect of a steady rate.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from estimator.estimation.runs.run import BLOCK_S
from estimator.observations.blocks import BlockSums
from estimator.observations.rows import table_rows
from estimator.observations.turned import Turned
from estimator.recordings.motion.body_rates import BodyRates
from estimator.recordings.recording import ImuData, Recording
from estimator.types import Floats

_FINE_S = 0.005  # samples closer than this share one lookup of the earlier rate
_GAP_S = 5.0  # a longer gap ends a stretch: the noise in it is unknown
_MOVED_S = 0.1  # where no table makes the motion: hands and shafts turn about within a second
_TURNS_RAD = 0.5
_SMOOTH_PERIODS = 10  # in a block: with fewer the smoothing of turns would show
_MOST_BLOCKS = 8000
_STEADY = 0.02  # change of rate over three blocks, as a share of the largest rate, that is still steady
_FEWEST = 40
_SHARED = 1.944  # second differences overlap: so many values are worth one
_BY_CHANCE = 7.5  # natural logarithm of how much more probable growth must be: once in ten thousand by chance
_LARGEST = np.geomspace(0.1, 300.0, 33)  # growth at the largest rate, over the noise at rest
_LEAST_RPS = 1e-12


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class _Measured:
    """Block means: ``index`` (B,) are block numbers counted from ``origin_s``, blocks last ``length_s``.

    ``w_rps`` (B, 3) is the mean body rate, ``z_rps`` (B, m) the mean output error, ``full`` (B,) whether the block
    holds enough samples. ``past_rps`` gives the body rates (B, 3) a number of seconds ago, NaN where unknown.
    """

    origin_s: float
    length_s: float
    index: NDArray[np.int64]
    w_rps: Floats
    z_rps: Floats
    full: NDArray[np.bool_]
    past_rps: Callable[[float], Floats]


def means_by_samples(recording: Recording, data: ImuData, block_s: float) -> _Measured | None:
    """Return block means over samples, with the body rate of a table at each sample; None if no sample is covered.

    A block is full from half the usual number of samples on. ``past_rps`` averages the rate over groups of neighbouring
    samples, which is faster; before the first and after the last reading it takes the rate there.
    """
    table = recording.table
    assert table is not None, "samples are compared with the readings of a table"
    period_s = float(np.median(np.diff(data.t_ns))) * 1e-9
    length_s = _length_s(recording, data, block_s, period_s)
    origin_ns = int(table.t_ns[0])
    sums = BlockSums(len(data.array), origin_ns, length_s, period_s)
    known = []
    for part in table_rows(recording, data):
        assert part.t_ns is not None
        sums.add(part.t_ns, part.w_rps, part.y_rps - part.w_rps @ data.array.p.T)
        known.append(part.t_ns)
    blocks = sums.blocks()
    if not len(blocks.index):
        return None
    t_ns = np.concatenate(known)
    # Every few samples together, at the mean of their instants: a rate that is linear in between has the same means.
    number = (t_ns - origin_ns) // round(length_s * 1e9)
    first = np.flatnonzero(np.diff(number, prepend=number[0] - 1))
    within = np.arange(len(t_ns)) - np.repeat(first, np.diff(np.append(first, len(t_ns))))
    group = np.flatnonzero(within % max(round(_FINE_S / period_s), 1) == 0)
    count = np.diff(np.append(group, len(t_ns)))
    instants = t_ns[0] + np.round(np.add.reduceat(t_ns - t_ns[0], group) / count).astype(np.int64)
    start = np.searchsorted(group, first)
    rates = BodyRates.of(table, recording.site)

    def past_rps(delay_s: float) -> Floats:
        at = np.maximum(instants - round(delay_s * 1e9), origin_ns)
        w = rates.at(np.minimum(at, rates.final_until_ns)) * count[:, None]
        return np.asarray(np.add.reduceat(w, start, axis=0) / blocks.rows[:, None])

    full = blocks.rows >= 0.5 * np.median(blocks.rows)
    return _Measured(
        origin_s=origin_ns * 1e-9,
        length_s=length_s,
        index=blocks.index,
        w_rps=blocks.w_rps,
        z_rps=blocks.z_rps,
        full=full,
        past_rps=past_rps,
    )


def means_by_turns(recording: Recording, data: ImuData, block_s: float) -> _Measured | None:
    """Return block means of body rate and outputs from how far both turned over the same intervals; None below two
    samples.

    If the body moves, both are smoothed over the coarser of their periods first, and blocks are short. Blocks in which
    either is not known are left out; all others count as full.
    """
    if len(data.t_ns) < 2:
        return None
    gyros, body = Turned.of_rates(data.t_ns, data.rate_rps), Turned.of_reference(recording.reference, recording.site)
    least_s = 2 * _step_s(gyros)
    if np.abs(body.integral).max() > _TURNS_RAD:  # for a body at rest a few readings suffice
        period_s = max(_step_s(gyros), _step_s(body))
        gyros, body = gyros.smoothed(period_s), body.smoothed(period_s)
        block_s, least_s = min(block_s, _MOVED_S), _SMOOTH_PERIODS * period_s
    length_s = _length_s(recording, data, block_s, least_s)
    origin_s = max(gyros.t_s[0], body.t_s[0]) + np.ceil(body.reach_s / length_s) * length_s
    count = int((min(gyros.t_s[-1], body.t_s[-1]) - body.reach_s - origin_s) / length_s + 1e-6)
    edges = origin_s + np.arange(count + 1) * length_s
    w, y = body.means(edges[:-1], edges[1:]), gyros.means(edges[:-1], edges[1:])
    index = np.flatnonzero(np.isfinite(w).all(axis=1) & np.isfinite(y).all(axis=1))
    first, last = edges[index], edges[index + 1]
    return _Measured(
        origin_s=float(origin_s),
        length_s=length_s,
        index=index.astype(np.int64),
        w_rps=w[index],
        z_rps=(y - w @ data.array.p.T)[index],
        full=np.ones(len(index), dtype=np.bool_),
        past_rps=lambda delay_s: body.means(first - delay_s, last - delay_s),
    )


def _step_s(turned: Turned) -> float:
    return float(np.median(np.diff(turned.t_s)))


def _length_s(recording: Recording, data: ImuData, block_s: float, least_s: float) -> float:
    span_s = float(data.t_ns[-1] - data.t_ns[0]) * 1e-9
    most = _MOST_BLOCKS * max(BLOCK_S / block_s, 1.0)
    return max(block_s, least_s, np.ceil(span_s / most / 0.1 - 1e-9) * 0.1 if span_s > most * block_s else 0.0)


def even_grid(known: NDArray[np.int64], length_s: float) -> tuple[NDArray[np.int64], NDArray[np.intp]]:
    """Return block numbers with short gaps filled, and the places of the ``known`` numbers in them.

    Gaps longer than ``_GAP_S`` stay open.
    """
    most = max(int(_GAP_S / length_s), 1)
    filled = [known[:1]]
    for before, after in pairwise(known.tolist()):
        filled.append(np.arange(before + 1, after + 1) if after - before <= most else np.array([after]))
    index = np.concatenate(filled).astype(np.int64)
    return index, np.searchsorted(index, known)


def weighed(w_rps: Floats, z_rps: Floats, weight: Floats, stretch: NDArray[np.intp]) -> tuple[Floats, float]:
    """Return the weight (b,) of blocks, 1 at rest, and the growth g of the noise in s.

    Arguments by block: rates (b, 3), output errors (b, m), 1 or 0 for enough data (b,), number of the stretch (b,).
    """
    growth_s = _growth_of(w_rps, z_rps, weight, stretch)
    return weight / np.hypot(1, growth_s * np.linalg.norm(w_rps, axis=1)), growth_s


def _growth_of(w_rps: Floats, z_rps: Floats, weight: Floats, stretch: NDArray[np.intp]) -> float:
    """Return the growth g of the noise with the rate, in s (sd ~ sqrt(1 + (g w)^2)), one for all gyros.

    It is estimated from second differences of output errors at steady rates, whose three blocks are of one stretch, all
    with weight. Arguments by block: rates (b, 3), output errors (b, m), weights (b,), number of the stretch (b,). 0 for
    fewer than 40 blocks or steady second differences, without motion, or if the growth is within chance.
    """
    speed = np.linalg.norm(w_rps, axis=1)
    size = float(speed.max(initial=0.0))
    if len(weight) < _FEWEST or size <= 0:
        return 0.0
    parts = slice(None, -2), slice(1, -1), slice(2, None)
    known = np.all([(weight[p] > 0) & (stretch[p] == stretch[1:-1]) for p in parts], axis=0)
    around = np.array([w_rps[p] for p in parts])
    steady = known & (np.ptp(around, axis=0).max(axis=1) <= _STEADY * size)
    if steady.sum() < _FEWEST:
        return 0.0
    squares = (z_rps[:-2] - 2 * z_rps[1:-1] + z_rps[2:])[steady] ** 2 + _LEAST_RPS**2
    rate = speed[1:-1][steady] / size
    grown = 1 + (np.append(0.0, _LARGEST)[:, None] * rate) ** 2
    levels = np.log(np.array([np.mean(squares / one[:, None], axis=0) for one in grown]))
    log = -0.5 * (len(rate) * levels.sum(axis=1) + squares.shape[1] * np.log(grown).sum(axis=1)) / _SHARED
    best = int(np.argmax(log))
    return float(_LARGEST[best - 1] / size) if log[best] - log[0] > _BY_CHANCE else 0.0
