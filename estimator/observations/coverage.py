"""The time over which a recording can show that scale factors, alignments and gearing stayed the same.

What changes while an axis rests shows only as a difference between its turns before and after. A change is therefore
found only if there is enough turning about the axis on both sides of it: at least a quarter before it and a quarter
after it. Turning counts as information does, by the square of the rate and the number of samples, so that a brief or
slow turn beside a long and fast one counts little.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from estimator.geometry.kinematics import AXES, body_rate
from estimator.observations.rows import MEAN_S
from estimator.packaged import sentence
from estimator.recordings.recording import ImuData, Recording
from estimator.recordings.reference import REST_RPS, TableReadings
from estimator.types import Floats, Stamps

STATES_OF_TURNS = ("k", "sigma_j", "sigma_k")
GEARING = "gearing"
_SIDE = 0.25  # share of the turning that must lie on each side of a change
_FAR = 1 / 3  # share of a recording that counts as far apart in time; turning spread evenly over it reaches one half
_TURNED_RPS = 10 * REST_RPS
_TURNED_SHARE = 0.05  # of the fastest axis: slower rotation may be its leak into another axis
_GAP_STEPS, _GAP_S = 4.0, 1.0  # a reading is valid until the next one, but no longer than both


@dataclass(frozen=True, slots=True, kw_only=True)
class AxisCoverage:
    """The time over which constancy about one axis is proved, in seconds since the first sample.

    ``covered_s`` is (start, end), None if there is none; ``length_s`` is the length of the recording. ``concerns``
    names the states, and the gearing of a table axis, that may have changed unnoticed at other times.
    """

    axis: str
    covered_s: tuple[float, float] | None
    length_s: float
    concerns: tuple[str, ...]

    @property
    def proved(self) -> bool:
        """Whether the covered time is a real part of the recording."""
        return self.covered_s is not None and self.covered_s[1] - self.covered_s[0] >= _FAR * self.length_s

    @property
    def not_proved_s(self) -> tuple[tuple[float, float], ...]:
        """Times (start, end) outside the covered one."""
        if self.covered_s is None:
            return ((0.0, self.length_s),)
        return (0.0, self.covered_s[0]), (self.covered_s[1], self.length_s)


@dataclass(frozen=True, slots=True, eq=False)
class _Turning:
    """Mean rates (n, 3) about x, y, z in time spans (n,), in ns; ``gearing`` for a table's own axes."""

    start_ns: Floats
    end_ns: Floats
    rate_rps: Floats
    gearing: bool = False


def coverage(recording: Recording, sources: Sequence[ImuData]) -> tuple[AxisCoverage, ...]:
    """Return the coverage of each axis about which a recording turns, in order x, y, z.

    ``sources`` are the samples in use. Axes are those of the body, whose states may change, and of the table, whose
    gearing may. For axes of the same name, and several sources, the time covered by all of them counts. Empty if no
    axis turns or no sample is finite.
    """
    seen = []
    for data in sources:
        known = np.logical_or.reduce([np.isfinite(column) for column in data.rate_rps.T])
        instants_ns = data.t_ns if known.all() else data.t_ns[known]
        if len(instants_ns):
            seen.append((instants_ns, list(_turnings(recording, data))))
    return _of_turnings(seen)


def planned_coverage(readings: TableReadings) -> tuple[AxisCoverage, ...]:
    """Return the coverage of a recording with this planned motion and evenly spaced samples."""
    return _of_turnings([(readings.t_ns, list(_table_turnings(readings)))])


def _of_turnings(seen: Sequence[tuple[Stamps, Sequence[_Turning]]]) -> tuple[AxisCoverage, ...]:
    """Return for each axis that turned the span of time that all sources cover, from samples (n,) in ns and turnings.

    Empty without sources; the span is None where the sources have none in common. An axis turned if its fastest rate is
    above that of rests, and is no mere leak of the fastest axis.
    """
    if not seen:
        return ()
    first_ns = min(float(instants_ns[0]) for instants_ns, _ in seen)
    length_s = (max(float(instants_ns[-1]) for instants_ns, _ in seen) - first_ns) * 1e-9
    spans: dict[str, list[tuple[float, float]]] = {}
    concerns: dict[str, list[str]] = {}
    for instants_ns, turnings in seen:
        for turning in turnings:
            if not len(turning.rate_rps):
                continue
            # In whole nanoseconds: for others numpy would copy all instants.
            first, last = (np.searchsorted(instants_ns, t.astype(np.int64)) for t in (turning.start_ns, turning.end_ns))
            peaks = np.abs(turning.rate_rps).max(axis=0)
            least = max(min(_TURNED_RPS, _TURNED_SHARE * float(peaks.max())), REST_RPS)
            for column in np.flatnonzero(peaks > least).tolist():
                start_ns, end_ns = _middle(turning, turning.rate_rps[:, column] ** 2 * (last - first))
                spans.setdefault(AXES[column], []).append(((start_ns - first_ns) * 1e-9, (end_ns - first_ns) * 1e-9))
                concerns.setdefault(AXES[column], []).extend([GEARING] if turning.gearing else STATES_OF_TURNS)
    found = []
    for axis in sorted(spans):
        start_s = max(start for start, _ in spans[axis])
        end_s = min(end for _, end in spans[axis])
        covered_s = (start_s, end_s) if start_s < end_s else None
        named = tuple(dict.fromkeys(concerns[axis]))
        found.append(AxisCoverage(axis=axis, covered_s=covered_s, length_s=length_s, concerns=named))
    return tuple(found)


def coverage_object(coverage: AxisCoverage) -> dict[str, Any]:
    """Return a coverage as a JSON object of its fields, ``proved`` and ``not_proved_s``; times in s since the start.

    The start is the first sample. ``covered_s`` is a list of start and end or None, ``not_proved_s`` a list of such.
    """
    return {
        "axis": coverage.axis,
        "proved": coverage.proved,
        "covered_s": None if coverage.covered_s is None else list(coverage.covered_s),
        "not_proved_s": [list(span) for span in coverage.not_proved_s],
        "length_s": coverage.length_s,
        "concerns": list(coverage.concerns),
    }


def coverage_of(values: Mapping[str, Any]) -> AxisCoverage:
    """Return a coverage from its JSON object; KeyError, TypeError or ValueError if it is not one.

    ``proved`` and ``not_proved_s`` are not read: they follow from the others.
    """
    covered_s = None
    if values["covered_s"] is not None:
        start_s, end_s = values["covered_s"]
        covered_s = float(start_s), float(end_s)
    return AxisCoverage(
        axis=str(values["axis"]),
        covered_s=covered_s,
        length_s=float(values["length_s"]),
        concerns=tuple(map(str, values["concerns"])),
    )


def not_proved(axes: Sequence[AxisCoverage]) -> str:
    """Return a few words for a verdict: the axes without proof of constancy, else the time for which all have it.

    All axes are named if they have no such time in common; "" if nothing turned.
    """
    if weak := [one.axis for one in axes if not one.proved]:
        return sentence("observations.constancy_not_proved", axes=", ".join(weak))
    covered = [one.covered_s for one in axes if one.covered_s is not None]
    if not covered:
        return ""
    start_s = max(start for start, _ in covered)
    end_s = min(end for _, end in covered)
    if start_s >= end_s:
        return sentence("observations.constancy_not_proved", axes=", ".join(one.axis for one in axes))
    return sentence("observations.constancy_proved_between", start_s=start_s, end_s=end_s)


def coverage_notes(axes: Sequence[AxisCoverage]) -> list[str]:
    """Return one note on all axes without proof of constancy, with what to do; an empty list if there are none."""
    weak = [one for one in axes if not one.proved]
    if not weak:
        return []
    times = ", ".join(f"{one.axis} {_times(one.covered_s)}" for one in weak)
    return [
        sentence(
            "observations.constancy_note",
            axes=_listed([one.axis for one in weak]),
            times=times,
            length_s=weak[0].length_s,
            what="scale factor, alignment or gearing" if GEARING in weak[0].concerns else "scale factor or alignment",
        )
    ]


def _times(covered_s: tuple[float, float] | None) -> str:
    return "none" if covered_s is None else f"{covered_s[0]:.0f} to {covered_s[1]:.0f} s"


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def _middle(turning: _Turning, amount: Floats) -> tuple[float, float]:
    """Return the instants in ns between which the middle part of an amount (n,) lies, the narrower span if in doubt.

    If nothing turned, the end comes before the start.
    """
    done = np.concatenate([[0.0], np.cumsum(amount)])
    total = done[-1]
    if total <= 0:
        return float(turning.end_ns[-1]), float(turning.start_ns[0])
    first = int(np.searchsorted(done, _SIDE * total, side="right")) - 1
    last = int(np.searchsorted(done, (1 - _SIDE) * total, side="left")) - 1
    shares = (_SIDE * total - done[first]) / amount[first], ((1 - _SIDE) * total - done[last]) / amount[last]
    start, end = (
        turning.start_ns[row] + share * (turning.end_ns[row] - turning.start_ns[row])
        for row, share in zip((first, last), shares, strict=True)
    )
    return float(start), float(end)


def _turnings(recording: Recording, data: ImuData) -> Iterator[_Turning]:
    """Yield the motion of the body and, for a table, that of its axes as a second one.

    Without turns, table or rates the gyros of the source themselves, less their medians, give the motion. A motion may
    have no rows.
    """
    turns = recording.turns
    rates = recording.reference.external_rates()
    if turns is not None:
        yield _Turning(turns.t_start_ns.astype(np.float64), turns.t_end_ns.astype(np.float64), turns.mean_rates_rps)
    elif recording.table is not None:
        yield from _table_turnings(recording.table)
    elif rates is not None:
        yield _means(rates.t_ns.astype(np.float64), rates.rate_rps)
    else:  # poses: only the gyros measure the turns by hand between them
        rate = np.nan_to_num(data.rate_rps - np.nanmedian(data.rate_rps, axis=0))
        yield _means(data.t_ns.astype(np.float64), rate @ np.linalg.pinv(data.array.p).T)


def _table_turnings(readings: TableReadings) -> Iterator[_Turning]:
    t_ns = readings.t_ns.astype(np.float64)
    yield _means(t_ns, body_rate(readings.angle_rad, readings.rate_rps, readings.gimbals))
    own = np.zeros((len(t_ns), 3))
    for axis, column in zip(readings.gimbals, readings.rate_rps.T, strict=True):
        own[:, AXES.index(axis)] = column
    yield _means(t_ns, own, gearing=True)


def _means(t_ns: Floats, rate_rps: Floats, *, gearing: bool = False) -> _Turning:
    """Return rates (k, 3) at instants (k,) as means over 0.1 s, or unchanged if they are less frequent.

    Rates that are not finite are left out. Each mean lasts to the next, but not over a gap. ``gearing``: they are rates
    of the table's axes.
    """
    known = np.flatnonzero(np.isfinite(rate_rps).all(axis=1))
    known = known[np.argsort(t_ns[known], kind="stable")]
    t_ns = t_ns[known]
    rate_rps = rate_rps[known]
    if not len(t_ns):
        return _Turning(t_ns, t_ns, rate_rps, gearing)
    _, first, counts = np.unique(
        np.floor((t_ns - t_ns[0]) * 1e-9 / MEAN_S).astype(np.int64), return_index=True, return_counts=True
    )
    means = np.add.reduceat(rate_rps, first, axis=0) / counts[:, None]
    start_ns = t_ns[first]
    steps_ns = np.diff(start_ns)
    longest_ns = max(_GAP_STEPS * float(np.median(steps_ns)), _GAP_S * 1e9) if len(steps_ns) else 0.0
    end_ns = start_ns + np.minimum(np.append(steps_ns, longest_ns), longest_ns)
    return _Turning(start_ns, end_ns, means, gearing)
