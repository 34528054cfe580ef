"""Channels that cannot be trusted: constant, saturated, not a number; or dead, judged by the reference."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimator.observations.defects.comparison import ReferenceComparison
from estimator.observations.defects.odd_samples import without_odd
from estimator.packaged import sentence
from estimator.recordings.recording import ImuData
from estimator.recordings.writing import columns_of
from estimator.types import Flags, Floats, Stamps, runs_of

_RUN_S = 0.25  # equal extreme values for longer than this are a limit, not a coincidence
_UNUSUAL = 5  # a limit repeats a value so many times longer than chance does
_MARGIN_S = 0.5  # close to a limit the noise is cut on one side only
_FILTER_S = 0.02  # around samples at a limit shown by a reference: the memory of a filter
_DEG = 180 / np.pi


@dataclass(frozen=True, slots=True)
class Excluded:
    """A gyro that cannot be estimated, and why."""

    name: str
    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class Usable:
    """The usable part of a source: data of channels that share their valid samples, notes, excluded gyros."""

    parts: tuple[ImuData, ...]
    notes: tuple[str, ...]
    excluded: tuple[Excluded, ...]


def usable(data: ImuData, *, fine: bool, comparison: ReferenceComparison | None = None) -> Usable:
    """Return the channels of an ordered source (``in_order``) that can be estimated.

    With ``fine`` readings, as on a moving table, a constant output is a defect, and a channel that stays at its extreme
    values is a part of its own, in which these are NaN. Coarse readings may rest on one count. ``comparison`` with the
    reference shows both in any case. All channels without limits are one part, the first; excluded are dead channels
    and those without a valid number. Notes are on limits and dead zones.
    """
    notes: list[str] = []
    excluded: list[Excluded] = []
    whole: list[int] = []
    parts: list[ImuData] = []
    for i, name in enumerate(data.array.names):
        column = data.rate_rps[:, i]
        finite = np.isfinite(column)
        if not finite.any():
            excluded.append(Excluded(name, "no sample is a valid number"))
            continue
        if reason := _dead(column, i, fine=fine, comparison=comparison):
            excluded.append(Excluded(name, reason))
            continue
        limited, levels = _limited(data, i, fine=fine, comparison=comparison)
        if limited.any():
            notes.append(sentence("observations.saturates", gyro=name, levels=levels, share=limited.mean()))
            parts.append(_only(data, [i], limited))
        else:
            whole.append(i)
        if comparison is not None and (zone_rps := comparison.dead_zone_rps(i)) is not None:
            share = float(np.mean(column == 0.0))
            notes.append(sentence("observations.dead_zone", gyro=name, share=share, zone_dps=zone_rps * _DEG))
    if whole:
        parts.insert(0, data if len(whole) == len(data.array) else _only(data, whole, None))
    return Usable(tuple(parts), tuple(notes), tuple(excluded))


def in_order(data: ImuData) -> tuple[ImuData, list[str]]:
    """Return a source in order of time without spikes and repetitions, and notes on its samples.

    Samples that are not finite stay; a note for each gyro counts them, as excluded, unless it has no others.
    """
    data = _rows(data, np.argsort(data.t_ns, kind="stable"))
    kept, notes = without_odd("gyro", np.asarray(data.t_ns * 1e-9, dtype=np.float64), data.rate_rps, data.array.names)
    data = _rows(data, kept)
    for name, finite in zip(data.array.names, np.isfinite(data.rate_rps).T, strict=True):
        if finite.any() and not finite.all():
            notes.append(f"{name}: {int((~finite).sum())} of {len(finite)} samples are not numbers and were excluded")
    return data, notes


def _dead(column: Floats, gyro: int, *, fine: bool, comparison: ReferenceComparison | None) -> str:
    """Return why the channel ``column`` (n,) of a gyro, by its number, is dead; "" if it is not.

    A constant output counts if readings are ``fine``, or ``comparison`` shows that the gyro turned. So does one that
    does not follow the reference while other gyros do.
    """
    low, high = float(np.nanmin(column)), float(np.nanmax(column))
    if low == high and (fine or (comparison is not None and comparison.turns(gyro))):
        return f"its output is constant at {low * _DEG:.4g} deg/s: disconnected or stuck"
    if comparison is not None and comparison.dead(gyro):
        return "its output does not follow the reference while those of other gyros do: it is dead or disconnected"
    return ""


def _limited(data: ImuData, gyro: int, *, fine: bool, comparison: ReferenceComparison | None) -> tuple[Flags, str]:
    """Return as flags (n,) which samples of gyro number ``gyro`` are at or beside a limit, and its levels in words.

    The words are "" if there is no limit; one output is finite at least. Extreme values count as limits only if
    readings are ``fine``; ``comparison`` shows further ones below the range.
    """
    column = data.rate_rps[:, gyro]
    low, high = float(np.nanmin(column)), float(np.nanmax(column))
    limited = at_limits(data.t_ns, column, low, high) if fine else np.zeros(len(column), dtype=bool)
    levels = [level for level in (low, high) if (limited & (column == level)).any()]
    for limit in comparison.limits[gyro] if comparison is not None else ():
        assert comparison is not None
        reached = limit.reached(column, comparison.expected_at(data.t_ns, gyro))
        if not (reached & ~limited).any():
            continue
        limited |= widened(reached, data.t_ns)
        if not any(abs(level - limit.level_rps) <= limit.width_rps for level in levels):
            levels.append(limit.level_rps)
    return limited, " and ".join(f"{level * _DEG:.4g} deg/s" for level in sorted(levels))


def widened(flags: Flags, t_ns: Stamps) -> Flags:
    """Return flags (n,) of samples at a limit, at instants in ns (n,), extended to those that a filter mixes with them.

    Each run of flags grows by 20 ms, and at least three samples, to both sides. The period of the samples is the median
    over the first ten thousand; there are at least two samples, else ValueError. The flags given are not changed.
    """
    period_s = float(np.median(np.diff(t_ns[:10000]))) * 1e-9
    margin = max(round(_FILTER_S / period_s), 3)
    wide = flags.copy()
    for start, stop in runs_of(flags):
        wide[max(start - margin, 0) : stop + margin] = True
    return wide


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


def at_limits(t_ns: Stamps, column: Floats, low: float, high: float) -> Flags:
    """Return as flags (n,) which samples at instants (n,) are in or beside a run of an extreme value (low, high).

    A run counts if it is longer than 0.25 s, and than outputs repeat values elsewhere. Flags reach 0.5 s to each side.
    """
    limited = np.zeros(len(column), dtype=bool)
    if len(column) < 3 or not (_repeats(column, low) or _repeats(column, high)):
        return limited
    period_s = float(np.median(np.diff(t_ns[:10000]))) * 1e-9
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
