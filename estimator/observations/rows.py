"""Rows of body rate and output, which everything is estimated from: of a table, a rate, an attitude or turns."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from estimator.observations.blocks import Blocks, BlockSums
from estimator.observations.turned import Turned
from estimator.recordings.motion.body_rates import BodyRates
from estimator.recordings.recording import ImuData, Recording
from estimator.recordings.reference import RateReadings, Reference, TableReadings, Turns
from estimator.types import Floats, Stamps, least_steps

BLOCK_S = 0.2
"""Length of a block of the live filter."""
MEAN_S = 0.1
"""Length of the means over which an attitude reference is compared: a low pass of 10 Hz on both sides."""
_CHUNK_ROWS = 65536
_COARSE = 1e-4  # variance of the errors of a rate reference, in that of the rate, that would lessen the slope
_COARSE_MEAN = 1e-5  # its share in means
_MEANS_S = (0.1, 0.2, 0.5, 1.0)
_FINE = 1.5  # steps of the samples: a reference with longer steps does not give the rate at each sample
_GAP_STEPS = 3.5  # usual steps: a longer gap within a turn leaves it unknown


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """Rows of body rate (rows, 3) and output (rows, m), with their instants if they are samples.

    ``weight`` is 1 / noise relative to other rows.
    """

    w_rps: Floats
    y_rps: Floats
    weight: Floats | None = None
    t_ns: Stamps | None = None


def block_rows(data: ImuData, length_s: float = BLOCK_S) -> int:
    """Return how many samples of this source make a block, by default of the live filter."""
    if len(data.t_ns) < 2:
        return 1
    return max(round(length_s / (float(np.median(np.diff(data.t_ns))) * 1e-9)), 1)


def observations(recording: Recording, data: ImuData) -> Iterator[Observations]:
    """Yield rows of body rate and output of one source, in parts of limited size, in order of time.

    Nothing for poses, between which no rate is known (``poses``). Against turns there is a row for each; against an
    attitude, and a coarse rate reference, rows are means.
    """
    if recording.table is not None:
        yield from table_rows(recording, data)
        return
    if recording.turns is not None:
        yield turn_rows(data, recording.turns)[0]
        return
    rates = recording.reference.external_rates()
    if rates is None:
        return
    if recording.reference.attitude is not None:
        yield from _means(data, rates, MEAN_S)
    else:
        yield from _rate_rows(rates, data)


def table_rows(recording: Recording, data: ImuData) -> Iterator[Observations]:
    """Yield rows of body rate and output at the samples that the readings of the table, the reference, cover.

    Where the table tells only how far it turned, its rates are means over short intervals. Samples whose body rate is
    not known are left out. AssertionError for any other reference.
    """
    reference = recording.table
    assert reference is not None, "rows against a table need one"
    if reference.by_turns:
        turned = Turned.of_reference(reference, recording.site)
        first_ns, last_ns = int(reference.t_ns[0]), int(reference.t_ns[-1])
        yield from _sampled(
            data, first_ns, last_ns, lambda t_ns: turned.rates(np.asarray(t_ns * 1e-9, dtype=np.float64))
        )
        return
    rates = BodyRates.of(reference, recording.site)
    yield from _sampled(data, rates.starts_ns, rates.final_until_ns, rates.at)


def _sampled(data: ImuData, first_ns: int, last_ns: int, at: Callable[[Stamps], Floats]) -> Iterator[Observations]:
    """Yield rows of the samples between two instants, these included, whose body rate ``at(t_ns)`` (n, 3) is finite.

    They come in parts of whole blocks of the live filter.
    """
    t_ns, rate = in_order(data)
    start, stop = np.searchsorted(t_ns, first_ns, side="left"), np.searchsorted(t_ns, last_ns, side="right")
    t_ns, rate = t_ns[start:stop], rate[start:stop]
    # Parts of whole blocks, so that a replay is cut as the live run was.
    block = block_rows(data)
    chunk = max(_CHUNK_ROWS // block, 1) * block
    for first in range(0, len(t_ns), chunk):
        t, y = t_ns[first : first + chunk], rate[first : first + chunk]
        w = at(t)
        known = np.isfinite(w).all(axis=1)
        yield Observations(w, y, None, t) if known.all() else Observations(w[known], y[known], None, t[known])


def source_blocks(recording: Recording, data: ImuData, length_s: float = BLOCK_S) -> Blocks:
    """Return body rates and output errors of one source against a table or a rate, averaged by block of ``length_s``.

    An output error is the output less the body rate about the nominal sense axis. The first block begins at the first
    reading of the reference. Without rows there are no blocks. AssertionError for any other reference.
    """
    reference = recording.reference
    assert isinstance(reference, (TableReadings, RateReadings)), "blocks are against a table or a rate"
    t_ns = data.t_ns
    period_s = float(np.median(np.diff(t_ns))) * 1e-9 if len(t_ns) > 1 else length_s
    sums = BlockSums(len(data.array), int(reference.t_ns[0]), length_s, period_s)
    for part in observations(recording, data):
        sums.add(part.t_ns, part.w_rps, part.y_rps - part.w_rps @ data.array.p.T)  # type: ignore[arg-type]
    return sums.blocks()


def _rate_rows(reference: RateReadings, data: ImuData) -> Iterator[Observations]:
    """Yield rows against a rate: by sample, or as means if the readings are coarse; nothing if no rate is known."""
    known = np.isfinite(reference.rate_rps).all(axis=1)
    if not known.any():
        return
    length_s = mean_length_s(reference)
    if length_s:
        yield from _means(data, reference, length_s)
        return
    at = reference.t_ns[known]  # rates next to unknown ones are unknown as well
    yield from _sampled(data, int(at[0]), int(at[-1]), lambda t_ns: _between(reference, t_ns))


def _between(reference: RateReadings, t_ns: Stamps) -> Floats:
    return np.column_stack([np.interp(t_ns, reference.t_ns, reference.rate_rps[:, c]) for c in range(3)])


def mean_length_s(reference: RateReadings) -> float:
    """Return the length in s of means over which to compare a rate reference: 0 for samples, more if it is coarse.

    Errors of single readings, as of an encoder that counts per sample, would make every gyro look less sensitive. It is
    one of ``_MEANS_S``: the shortest in which these errors hardly count, else the longest. 0 for too few readings.
    """
    rate = reference.rate_rps
    differences = np.diff(rate, 4, axis=0)  # of a motion next to nothing is left; of white noise 70 times its variance
    differences = differences[np.isfinite(differences).all(axis=1)]
    if not len(differences):
        return 0.0
    noise = float(np.sum(np.mean(differences**2, axis=0))) / 70
    spread = float(np.sum(np.var(rate[np.isfinite(rate).all(axis=1)], axis=0)))
    if noise <= _COARSE * spread:
        return 0.0
    step_s = float(np.median(np.diff(reference.t_ns))) * 1e-9
    good = [length for length in _MEANS_S if noise * min(step_s / length, 1.0) <= _COARSE_MEAN * spread]
    return good[0] if good else _MEANS_S[-1]


def row_length_s(recording: Recording, data: ImuData) -> float:
    """Return the time in s that a row against an external reference stands for.

    ``MEAN_S`` for an attitude; for rates the length of the means if their steps are coarse. Otherwise the median
    sampling period of ``data``, or ``BLOCK_S`` with fewer than two samples.
    """
    if recording.reference.attitude is not None:
        return MEAN_S
    length_s = mean_length_s(recording.reference) if isinstance(recording.reference, RateReadings) else 0.0
    if length_s or len(data.t_ns) < 2:
        return length_s or BLOCK_S
    return float(np.median(np.diff(data.t_ns))) * 1e-9


def coarser(reference: Reference, data: ImuData) -> bool:
    """Return whether an external reference is read too seldom to give the rate at each sample.

    False for a table with rates; True for an attitude, a table known by its turns, or fewer than two readings or
    samples.
    """
    if not reference.by_turns:
        return False
    if not isinstance(reference, RateReadings):
        return True
    if len(reference.t_ns) < 2 or len(data.t_ns) < 2:
        return True
    return bool(np.median(np.diff(reference.t_ns)) > _FINE * np.median(np.diff(data.t_ns)))


def sample_noise(data: ImuData) -> Floats:
    """Return the white noise of one sample of each channel (m,) in rad/s, one sigma, from differences of neighbours.

    Only samples in which all channels are finite count. It is at least that of rounding to the smallest step, and NaN
    for fewer than two samples.
    """
    # Median of |N(0, 2 s^2)| is 0.954 s; the quantum is the floor for data rounded so that most do not differ.
    rate = in_order(data)[1]
    quantum = _quantum(rate)
    floor = np.where(np.isfinite(quantum), quantum, 1e-9) / np.sqrt(12)
    return np.asarray(np.maximum(np.median(np.abs(np.diff(rate, axis=0)), axis=0) / 0.954, floor))


def _quantum(rate_rps: Floats) -> Floats:
    """Return the smallest step between neighbouring samples of each channel (m,); infinite if all are equal."""
    # Differences of the same two decimals differ in their last binary digits: 1e-9 rad/s is no step.
    return least_steps(np.abs(np.diff(rate_rps, axis=0)))


def in_order(data: ImuData) -> tuple[Stamps, Floats]:
    """Return stamps (n,) and outputs (n, m) of the samples in which all outputs are finite, in order of time."""
    t_ns, rate = data.t_ns, data.rate_rps
    finite = np.isfinite(rate).all(axis=1)
    if not finite.all():
        t_ns, rate = t_ns[finite], rate[finite]
    if np.any(np.diff(t_ns) <= 0):
        order = np.argsort(t_ns, kind="stable")
        t_ns, rate = t_ns[order], rate[order]
    return t_ns, rate


def _means(data: ImuData, reference: RateReadings, length_s: float) -> Iterator[Observations]:
    """Yield means of rates and outputs over blocks, for a reference that is too noisy to be compared by sample.

    Nothing if the reference covers less than a block; blocks with unknown rates are left out.
    """
    t_ns, rate = in_order(data)
    w = _between(reference, t_ns)
    rows = block_rows(data, length_s)
    inside = (t_ns >= reference.t_ns[0]) & (t_ns <= reference.t_ns[-1])
    first = int(np.argmax(inside)) if inside.any() else 0
    count = int(inside.sum()) // rows
    if not count:
        return
    w_mean = w[first : first + count * rows].reshape(count, rows, 3).mean(axis=1)
    y_mean = rate[first : first + count * rows].reshape(count, rows, -1).mean(axis=1)
    t_mean = t_ns[first : first + count * rows].reshape(count, rows)[:, rows // 2]
    whole = np.isfinite(w_mean).all(axis=1)
    yield Observations(w_mean[whole], y_mean[whole], None, t_mean[whole])


def turn_rows(data: ImuData, turns: Turns) -> tuple[Observations, list[int]]:
    """Return a row for each turn (mean rate by its angle, mean output, weight), and the indices of turns that have one.

    Means are over time, not samples, as external samples may be unevenly spaced. A weight of 1 is the noise of a sample
    (``sample_noise``, of the worst channel). Turns of fewer than two samples are left out; so are those with gaps, if
    some samples of the source are not finite.
    """
    t_ns, rate = in_order(data)
    white, quantum = float(sample_noise(data).max()), _quantum(rate)
    # Where samples are left out, the motion is unknown; few files made by hand have even stamps.
    left_out = not np.isfinite(data.rate_rps).all() and len(t_ns) > 1
    longest_ns = _GAP_STEPS * float(np.median(np.diff(t_ns))) if left_out else np.inf
    w, y, weight, which = [], [], [], list[int]()
    limits = zip(turns.t_start_ns, turns.t_end_ns, turns.turn_rad, turns.sd_rad, strict=True)
    for number, (start, end, turn, sd) in enumerate(limits):
        inside = (t_ns >= start) & (t_ns <= end)
        n = int(inside.sum())
        if n < 2 or np.diff(t_ns[inside]).max() > longest_ns:
            continue
        which.append(number)
        t_s, part = (t_ns[inside] - start) * 1e-9, rate[inside]
        length_s = float(t_s[-1] - t_s[0])
        w.append(turn / length_s)
        y.append(np.trapezoid(part, t_s, axis=0) / length_s)
        # Samples that hardly leave one count do not average: their mean is good to the count, however many.
        stuck = np.where(np.isfinite(quantum) & (part.std(axis=0) < quantum / 2), quantum / np.sqrt(12), 0.0)
        # Noise of one sample relative to the noise of this mean.
        weight.append(white / np.sqrt(white**2 / n + (sd / length_s) ** 2 + float(stuck.max()) ** 2))
    if not w:
        return Observations(np.empty((0, 3)), np.empty((0, len(data.array))), np.empty(0)), which
    return Observations(np.array(w), np.array(y), np.array(weight)), which
