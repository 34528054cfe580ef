"""Channels that cannot be trusted, seen in their samples alone: constant, saturated, not a number."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimator.observations.defects.odd_samples import without_odd
from estimator.packaged import sentence
from estimator.recordings.recording import ImuData
from estimator.recordings.writing import columns_of
from estimator.types import Flags, Floats, runs_of

_RUN_S = 0.25  # equal extreme values for longer than this are a limit, not a coincidence
_UNUSUAL = 5  # a limit holds a value so much longer than values repeat by chance
_MARGIN_S = 0.5  # close to a limit the noise is cut on one side only
_DEG = 180 / np.pi


@dataclass(frozen=True, slots=True)
class Excluded:
    """A gyro that cannot be estimated, and why."""

    name: str
    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class Usable:
    """What is left of a source: data of channels that share their good samples, notes, gyros left out."""

    parts: tuple[ImuData, ...]
    notes: tuple[str, ...]
    excluded: tuple[Excluded, ...]


def usable(data: ImuData, *, fine: bool) -> Usable:
    """Return the channels of a source that can be estimated, in order of time, without spikes and repeated samples.

    With ``fine`` readings, as of a gyro on a moving table, an output that never changes is a defect, and a channel
    that stays at its extreme values is given by itself with those cut out. Coarse ones may rest on a count.
    """
    data = _rows(data, np.argsort(data.t_ns, kind="stable"))
    kept, notes = without_odd("gyro", np.asarray(data.t_ns * 1e-9, dtype=np.float64), data.rate_rps, data.array.names)
    data = _rows(data, kept)
    excluded: list[Excluded] = []
    whole: list[int] = []
    parts: list[ImuData] = []
    for i, name in enumerate(data.array.names):
        column = data.rate_rps[:, i]
        finite = np.isfinite(column)
        if not finite.any():
            excluded.append(Excluded(name, "not one sample is a number"))
            continue
        if not finite.all():
            notes.append(f"{name}: {int((~finite).sum())} of {len(column)} samples are no numbers; they are left out")
        if not fine:
            whole.append(i)
            continue
        low, high = float(np.nanmin(column)), float(np.nanmax(column))
        if low == high:
            excluded.append(Excluded(name, f"its output is constant at {low * _DEG:.4g} deg/s: disconnected or stuck"))
            continue
        limited = _at_limits(data, column, low, high)
        if limited.any():
            share = limited.mean()
            levels = " and ".join(
                f"{level * _DEG:.4g} deg/s" for level in (low, high) if (limited & (column == level)).any()
            )
            notes.append(sentence("observations.saturates", gyro=name, levels=levels, share=share))
            parts.append(_only(data, [i], limited))
        else:
            whole.append(i)
    if whole:
        parts.insert(0, data if len(whole) == len(data.array) else _only(data, whole, None))
    return Usable(tuple(parts), tuple(notes), tuple(excluded))


def _rows(data: ImuData, rows: NDArray[np.intp]) -> ImuData:
    """Return a source with these rows; itself where they are all in order."""
    if np.array_equal(rows, np.arange(len(data.t_ns))):
        return data
    return replace(data, **{key: values[rows] for key, values in columns_of(data).items()})


def _only(data: ImuData, channels: list[int], cut: Flags | None) -> ImuData:
    rate = data.rate_rps[:, channels]
    if cut is not None:
        rate = np.where(cut[:, None], np.nan, rate)
    return replace(data, array=data.array.select(channels), rate_rps=rate)


def _at_limits(data: ImuData, column: Floats, low: float, high: float) -> Flags:
    """Return which samples (n,) lie in or beside a run of one extreme value."""
    limited = np.zeros(len(column), dtype=bool)
    if len(column) < 3 or not (_repeats(column, low) or _repeats(column, high)):
        return limited
    period_s = float(np.median(np.diff(data.t_ns[:10000]))) * 1e-9
    # Coarse outputs repeat any value: at a limit they do so for much longer than elsewhere.
    usual = float(np.quantile(np.diff(np.flatnonzero(np.diff(column, prepend=np.nan, append=np.nan) != 0)), 0.99))
    least, margin = max(round(_RUN_S / period_s), 5, round(_UNUSUAL * usual)), max(round(_MARGIN_S / period_s), 1)
    for extreme in (low, high):
        for start, stop in runs_of(column == extreme):
            if stop - start >= least:
                limited[max(start - margin, 0) : stop + margin] = True
    return limited


def _repeats(column: Floats, extreme: float) -> bool:
    at = column == extreme
    return bool(np.count_nonzero(at) > 5 and (at[1:] & at[:-1]).any())
