"""The examination of a recording for faults of its samples and its reference, before any estimate."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from estimator.observations.alignment import Following, following
from estimator.observations.defects.comparison import ReferenceComparison
from estimator.observations.defects.faults import Fault, held_samples, saturations, stuck_notes, without_stuck
from estimator.observations.defects.glitches import without_glitches
from estimator.observations.health import Usable, in_order, usable
from estimator.recordings.recording import ImuData, Recording

Ordered = tuple[ImuData, Sequence[str]]
"""Samples in order, and what is to be told of them."""


@dataclass(frozen=True, slots=True, eq=False)
class Source:
    """The usable data of one source, its faults, and for how many samples each of its values is held."""

    usable: Usable
    faults: Sequence[Fault]
    held: int


@dataclass(frozen=True, slots=True, eq=False)
class Examined:
    """A recording with its reference corrected, notes on that, and its sources by name."""

    recording: Recording
    notes: Sequence[str]
    sources: Mapping[str, Source]


def examined(recording: Recording) -> Examined:
    """Return the usable part of a recording: spikes, stuck and limited values and glitches of the reference removed.

    Glitches are found by the source that follows the reference best, and not looked for if none does; if there are any,
    all is examined once more without them. The samples of the recording in the result stay as they were; usable ones
    are in its ``sources``.
    """
    ordered = {name: in_order(data) for name, data in recording.sources.items()}
    lines = _lines(recording, ordered)
    sources = {name: _source(recording, *pair, lines[name]) for name, pair in ordered.items()}
    # All sources have one reference: the one that follows it best shows best where it is wrong.
    told = [(float(line.scatter_rps.min()), name) for name, line in lines.items() if line is not None]
    line = lines[min(told)[1]] if told else None
    if line is None:
        return Examined(recording, [], sources)
    right, notes = without_glitches(recording, _together(sources[min(told)[1]], ordered[min(told)[1]][0]), line)
    if notes:
        lines = _lines(right, ordered)
        sources = {name: _source(right, *pair, lines[name]) for name, pair in ordered.items()}
    return Examined(right, notes, sources)


def _lines(recording: Recording, ordered: Mapping[str, Ordered]) -> dict[str, Following | None]:
    return {name: following(data, recording.reference, recording.site) for name, (data, _) in ordered.items()}


def _together(source: Source, data: ImuData) -> ImuData:
    """Return all gyros of a source in order that can be used, NaN where one cannot."""
    rate = np.full(data.rate_rps.shape, np.nan)
    for part in source.usable.parts:
        for name, column in zip(part.array.names, part.rate_rps.T, strict=True):
            rate[:, data.array.names.index(name)] = column
    return replace(data, rate_rps=rate)


def _source(recording: Recording, data: ImuData, notes: Sequence[str], line: Following | None) -> Source:
    """Return the usable data of one source, with its faults and notes, ``notes`` first.

    ``line`` is how its outputs follow the reference; without it nothing is expected of them. How many samples a value
    is held for is counted against a table only, else it is 1; stuck values are searched only if it is 1.
    """
    fine = recording.table is not None
    held = held_samples(data) if fine else 1
    beside = ReferenceComparison.of(data, recording.reference, recording.site, line)
    faults: list[Fault] = []
    if held == 1:
        data, faults = without_stuck(data, beside)
    found = usable(data, fine=fine, comparison=beside)
    begin_s = float(data.t_ns[0]) * 1e-9 if len(data.t_ns) else 0.0
    told = (*notes, *stuck_notes(faults, begin_s), *found.notes)
    return Source(Usable(found.parts, told, found.excluded), [*faults, *saturations(found.notes, data)], held)
