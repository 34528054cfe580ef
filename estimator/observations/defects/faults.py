"""Faults of the data themselves: values that stick, samples that are held, limits that are reached."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from estimator.effects.disturbances import SATURATION, STUCK
from estimator.observations.defects.held import updates
from estimator.recordings.recording import ImuData

_STUCK_S = 0.25
_FEWEST = 10
_UNUSUAL = 5  # a value that sticks does so this much longer than values repeat by chance


@dataclass(frozen=True, slots=True)
class Fault:
    """A fault of one gyro, by the name that the catalogue gives it; ``values`` are its numbers: name, value, unit."""

    kind: str
    gyro: str
    values: tuple[tuple[str, float, str], ...]


def held_samples(data: ImuData) -> int:
    """Return for how many samples each value of a source is held; 1 if each sample is new."""
    fresh = updates(data.rate_rps)
    return 1 if fresh is None else round(len(data.t_ns) / len(fresh))


def without_stuck(data: ImuData) -> tuple[ImuData, list[Fault]]:
    """Return a source with the values that stick taken out, and what stuck: neither its extremes nor all of it."""
    if len(data.t_ns) < 100:
        return data, []
    period_s = float(np.median(np.diff(data.t_ns))) * 1e-9
    least = max(round(_STUCK_S / period_s), _FEWEST)
    faults: list[Fault] = []
    rate = data.rate_rps
    for i, name in enumerate(data.array.names):
        column = data.rate_rps[:, i]
        starts = np.flatnonzero(np.diff(column, prepend=np.nan) != 0)
        lengths = np.diff(np.append(starts, len(column)))
        usual = max(float(np.quantile(lengths, 0.99)), 1.0)
        low, high = np.nanmin(column), np.nanmax(column)
        for start, length in zip(starts.tolist(), lengths.tolist(), strict=True):
            if length < max(least, _UNUSUAL * usual) or length > 0.9 * len(column) or column[start] in (low, high):
                continue
            if rate is data.rate_rps:
                rate = data.rate_rps.copy()
            rate[start : start + length, i] = np.nan
            first, last = data.t_ns[start] * 1e-9, data.t_ns[start + length - 1] * 1e-9
            faults.append(Fault(STUCK.name, name, (("from", float(first), "s"), ("until", float(last), "s"))))
    return (data if rate is data.rate_rps else replace(data, rate_rps=rate)), faults


def split_faulty(data: ImuData) -> list[ImuData]:
    """Return a source in parts of gyros that have the same samples: a fault of one costs the others nothing."""
    bad = ~np.isfinite(data.rate_rps)
    groups: dict[bytes, list[int]] = {}
    for i in range(len(data.array)):
        groups.setdefault(bad[:, i].tobytes() if bad[:, i].any() else b"", []).append(i)
    if len(groups) == 1:
        return [data]
    return [replace(data, array=data.array.select(rows), rate_rps=data.rate_rps[:, rows]) for rows in groups.values()]


def saturations(notes: Sequence[str], data: ImuData) -> list[Fault]:
    """Return the gyros of a source whose outputs reach a limit, as the notes on its channels say."""
    faults = []
    for i, name in enumerate(data.array.names):
        if any(note.startswith(f"{name}: saturates") for note in notes):
            limit = float(np.nanmax(np.abs(data.rate_rps[:, i])))
            faults.append(Fault(SATURATION.name, name, (("limit", limit, "rad/s"),)))
    return faults
