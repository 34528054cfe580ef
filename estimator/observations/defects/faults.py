"""Faults of the data themselves: values that stick, samples that are held, limits that are reached."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimator.effects.disturbances import SATURATION, STUCK
from estimator.observations.defects.comparison import ReferenceComparison
from estimator.packaged import sentence
from estimator.recordings.recording import ImuData
from estimator.types import Floats, least_steps

_STUCK_S = 0.25
_FEWEST = 10
_UNUSUAL = 5  # a value that sticks does so this much longer than values repeat by chance
_TOGETHER = 0.5  # of the rows in which one gyro sticks: if all stick in so many, the source sticks
_FINE_ROWS = 2  # fine outputs repeat a value in no more rows than these: a longer repetition is stuck, for any motion
_FEWEST_UPDATES = 20
_SHORT_SHARE = 0.05  # of the runs of equal rows, how many may be one row long all the same
_AT_PERIOD = 0.5  # of the runs, how many must last one period of the updates
_ON_PERIOD = 0.9  # of the runs, how many must last whole periods
_FINE_STEPS = 0.2  # of the updates, how many must change by more than one step of the quantisation


@dataclass(frozen=True, slots=True)
class Fault:
    """A fault of one gyro, with its name in the catalogue; ``values`` are (name, value, unit)."""

    kind: str
    gyro: str
    values: tuple[tuple[str, float, str], ...]


def updates(values: Floats) -> NDArray[np.intp] | None:
    """Return the rows (k,) at which held values (rows, m) are new; None if values are not held.

    A source that is slower than the rows repeats its last values. The rows are those of changes, and in between those
    at a steady period, over all rows, since a value may come twice. Values that are equal because of rounding are not
    held: they change at any row, or by single steps. NaN counts as equal to NaN. None as well with fewer than 20
    changes, so for constant or few values, or if no steady period is found.
    """
    same = (values[1:] == values[:-1]) | (np.isnan(values[1:]) & np.isnan(values[:-1]))
    changes = np.flatnonzero(~same.all(axis=1)) + 1
    if len(changes) < _FEWEST_UPDATES:
        return None
    runs = np.diff(changes)
    least = float(np.quantile(runs, _SHORT_SHARE))
    if least < 2:
        return None
    period = float(runs[runs <= 1.5 * least].mean())
    periods = np.maximum(np.round(runs / period), 1)
    if np.mean(periods == 1) < _AT_PERIOD or np.mean(np.abs(runs - periods * period) <= 1) < _ON_PERIOD:
        return None
    steps = np.nan_to_num(np.abs(np.diff(values, axis=0))[changes - 1])
    largest = np.max(steps / least_steps(steps, 1e-12), axis=1)
    if np.mean(largest > 1.5) < _FINE_STEPS:
        return None
    # A value that happens to come twice is an update too: long runs are cut into periods.
    first = changes[0] - period * np.arange(int(changes[0] / period), 0, -1)
    parts = [start + period * np.arange(n) for start, n in zip(changes[:-1], periods, strict=True)]
    last = np.arange(changes[-1], len(values), period)
    rows = np.round(np.concatenate([first, *parts, last])).astype(np.intp)
    return rows[rows < len(values)]


def held_samples(data: ImuData) -> int:
    """Return for how many samples each value of a source is held; 1 if each sample is new."""
    fresh = updates(data.rate_rps)
    return 1 if fresh is None else round(len(data.t_ns) / len(fresh))


def without_stuck(data: ImuData, comparison: ReferenceComparison | None = None) -> tuple[ImuData, list[Fault]]:
    """Return a source with stuck values set to NaN, and a fault of the gyro for each time (``from``, ``until`` in s).

    A value is stuck if it repeats for a quarter of a second, and far longer than others do. Not counted are values at
    the extremes of the output, outputs that never change, and times in which all gyros stand still on a table. Coarse
    outputs, and exact zeros, are stuck only if ``comparison`` with the reference shows that the rate changed. Sources
    of fewer than 100 samples are returned unchanged.
    """
    if len(data.t_ns) < 100:
        return data, []
    period_s = float(np.median(np.diff(data.t_ns))) * 1e-9
    least = max(round(_STUCK_S / period_s), _FEWEST)
    faults: list[Fault] = []
    rate = data.rate_rps
    together = (
        _together(data.rate_rps) if comparison is not None and comparison.table else np.zeros(len(rate), dtype=np.bool_)
    )
    for i, name in enumerate(data.array.names):
        column = data.rate_rps[:, i]
        if np.isnan(column).all():
            continue
        starts = np.flatnonzero(np.diff(column, prepend=np.nan) != 0)
        lengths = np.diff(np.append(starts, len(column)))
        usual = max(float(np.quantile(lengths, 0.99)), 1.0)
        low, high = np.nanmin(column), np.nanmax(column)
        long = np.flatnonzero((lengths >= max(least, _UNUSUAL * usual)) & (lengths <= 0.9 * len(column)))
        fine = usual <= _FINE_ROWS
        zone = comparison is not None and len(long) > 0 and comparison.dead_zone_rps(i) is not None
        for start, length in zip(starts[long].tolist(), lengths[long].tolist(), strict=True):
            value, span = column[start], slice(start, start + length)
            if together[span].mean() > _TOGETHER:
                continue
            if value in (low, high) or (value == 0.0 and zone):
                continue
            changed = comparison.changed(data.t_ns[span], i) if comparison is not None else None
            if not (changed or (fine and value != 0.0)):
                continue
            if rate is data.rate_rps:
                rate = data.rate_rps.copy()
            rate[span, i] = np.nan
            first, last = data.t_ns[start] * 1e-9, data.t_ns[start + length - 1] * 1e-9
            faults.append(Fault(STUCK.name, name, (("from", float(first), "s"), ("until", float(last), "s"))))
    return (data if rate is data.rate_rps else replace(data, rate_rps=rate)), faults


def _together(rate_rps: Floats) -> NDArray[np.bool_]:
    """Return which rows (n,) are the row before in all gyros: there it is the source that is stuck (``stuck``)."""
    same = np.asarray((rate_rps[1:] == rate_rps[:-1]).all(axis=1))
    return np.concatenate([same[:1], same])


def stuck_notes(faults: Sequence[Fault], begin_s: float) -> list[str]:
    """Return, in words, which values stuck, from when on and for how long; instants count from ``begin_s``."""
    spans = [(f.gyro, f.values[0][1] - begin_s, f.values[1][1] - begin_s) for f in faults if f.kind == STUCK.name]
    return [sentence("observations.stuck", gyro=name, since_s=a, length_s=b - a) for name, a, b in spans]


def split_faulty(data: ImuData) -> list[ImuData]:
    """Return a source in parts of gyros with the same valid samples, so that a fault of one does not affect the
    others.

    All samples stay in each part. The source itself is the only part if all gyros have the same.
    """
    bad = ~np.isfinite(data.rate_rps)
    groups: dict[bytes, list[int]] = {}
    for i in range(len(data.array)):
        groups.setdefault(bad[:, i].tobytes() if bad[:, i].any() else b"", []).append(i)
    if len(groups) == 1:
        return [data]
    return [replace(data, array=data.array.select(rows), rate_rps=data.rate_rps[:, rows]) for rows in groups.values()]


def saturations(notes: Sequence[str], data: ImuData) -> list[Fault]:
    """Return a fault for each gyro whose outputs reach a limit, by the notes on its channels.

    ``notes`` are those of ``health.usable``. The fault holds ``limit`` in rad/s, the largest size of its outputs.
    """
    faults = []
    for i, name in enumerate(data.array.names):
        if any(note.startswith(f"{name}: saturates") for note in notes):
            limit = float(np.nanmax(np.abs(data.rate_rps[:, i])))
            faults.append(Fault(SATURATION.name, name, (("limit", limit, "rad/s"),)))
    return faults
