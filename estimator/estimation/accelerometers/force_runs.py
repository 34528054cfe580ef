"""Runs of specific force: block means of the force at the accelerometers of a source, and of their output errors."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimator.effects.conditions import Conditions, body_acceleration
from estimator.estimation.noise_evidence import TooShort
from estimator.estimation.runs.conditions import GRID_S, temperature_at
from estimator.estimation.runs.measured import even_grid
from estimator.estimation.runs.run import BLOCK_S, Run, block_means
from estimator.geometry.array import SensorArray
from estimator.geometry.kinematics import body_rate, into_body, turns_of
from estimator.geometry.model import ForcePrior
from estimator.observations.blocks import BlockSums
from estimator.packaged import sentence
from estimator.recordings.motion.body_rates import BodyRates
from estimator.recordings.recording import ImuData, Recording
from estimator.recordings.reference import TableReadings
from estimator.types import Flags, Floats, Stamps

_GROUP_S = 0.005  # samples closer than this are averaged before the force at them is computed
_FULL = 0.5  # share of the usual number of samples below which a block does not count
_FEWEST_BLOCKS = 40


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class ForceSamples:
    """Outputs (n, a) of the accelerometers of a source at instants (n,), in order of time, NaN where one is unusable.

    ``array`` has their nominal axes in the body.
    """

    array: SensorArray
    t_ns: Stamps
    output_mps2: Floats
    prior: ForcePrior


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class ForceRun(Run):
    """A run of accelerometers: ``w_rps`` (b, 3) is the specific force, ``z_rps`` (b, a) are output errors, in m/s2."""

    samples: ForceSamples

    @property
    def array(self) -> SensorArray:
        """The accelerometers."""
        return self.samples.array

    @property
    def prior(self) -> ForcePrior:
        """Their data sheet."""
        return self.samples.prior

    def weighed(self, columns: Floats, gyro: int) -> Floats:
        """Return columns (b, c) times the weights of the blocks, both interpolated over blocks without samples; they
        are the same for each ``gyro``.

        A hole would let the large part of a bias that wanders slowly show at all frequencies, where the noise models
        have only white noise: a bias would seem to be known from the edges of holes.
        """
        known = np.flatnonzero(self.weight > 0)
        blocks = np.arange(len(self.weight))
        weight = np.interp(blocks, known, self.weight[known])
        filled = np.column_stack([np.interp(blocks, known, column[known]) for column in columns.T])
        return np.asarray(filled * weight[:, None])


def force_run(
    recording: Recording,
    source: str,
    samples: ForceSamples,
    *,
    arm_m: Floats,
    delay_s: float,
    gravity_mps2: float,
    block_s: float = BLOCK_S,
) -> ForceRun:
    """Return the accelerometers of a source on a table as a run; TooShort for too few blocks.

    The input is the specific force ``arm_m`` (3,) from where the axes meet, ``delay_s`` before the stamps; outputs are
    errors against it. Instants with NaN, or unknown motion, are left out; blocks less than half full weigh 0.
    """
    table, data = recording.table, recording.sources[source]
    assert table is not None, "specific force is computed from the readings of a table"
    rates = BodyRates.of(table, None)
    t_ns, outputs = _grouped(samples)
    t_ns = t_ns - round(delay_s * 1e9)
    known = _known(rates, t_ns, outputs)
    t_ns, outputs = t_ns[known], outputs[known]
    if len(t_ns) < _FEWEST_BLOCKS:
        raise TooShort(sentence("estimation.short_for_effects", recording=recording.name, source=source))
    force = force_at_place(rates, table.gimbals, t_ns, arm_m, gravity_mps2)
    period_s = float(np.median(np.diff(t_ns))) * 1e-9
    length_s = max(block_s, 2 * period_s)
    origin_ns = int(table.t_ns[0])
    sums = BlockSums(len(samples.array), origin_ns, length_s, period_s)
    sums.add(t_ns, force, outputs - force @ samples.array.p.T)
    blocks = sums.blocks()
    if len(blocks.index) < _FEWEST_BLOCKS:
        raise TooShort(sentence("estimation.short_for_effects", recording=recording.name, source=source))
    index, where = even_grid(blocks.index, length_s)
    count = len(index)
    w = np.zeros((count, 3))
    z = np.zeros((count, len(samples.array)))
    weight = np.zeros(count)
    w[where] = blocks.w_rps
    z[where] = blocks.z_rps
    weight[where] = blocks.rows >= _FULL * np.median(blocks.rows)
    t_s = np.asarray(origin_ns * 1e-9 + (index + 0.5) * length_s, dtype=np.float64)
    share = _shares(t_ns - origin_ns, index, length_s)
    return ForceRun(
        name=recording.name,
        source=source,
        data=data,
        length_s=length_s,
        t_s=t_s,
        w_rps=w,
        z_rps=z,
        weight=weight,
        stretch=np.cumsum(np.diff(index, prepend=index[:1]) > 1).astype(np.intp),
        grid=_conditions(recording, data, table, rates, t_s, length_s, arm_m, gravity_mps2),
        fold=lambda columns: block_means(columns * share[:, None], count),
        recording=recording,
        samples=samples,
    )


def _known(rates: BodyRates, t_ns: Stamps, outputs: Floats) -> Flags:
    """Return as flags (n,) at which instants all outputs (n, a) are finite and it is known what they ought to be."""
    known = (t_ns >= rates.starts_ns) & (t_ns <= rates.final_until_ns) & np.isfinite(outputs).all(axis=1)
    if known.any():
        known[known] = rates.felt_known(t_ns[known])
    return np.asarray(known)


def force_at_place(
    rates: BodyRates, gimbals: Sequence[str], t_ns: Stamps, arm_m: Floats, gravity_mps2: float
) -> Floats:
    """Return the specific force (n, 3) at instants (n,), in body axes: g + a x r + w x (w x r).

    ``arm_m`` (3,) is the place r from the point in which the axes of the table meet.
    """
    angle, rate, acceleration = rates.felt_at(t_ns)
    turns = turns_of(angle, gimbals)
    force = into_body(np.array([0.0, 0.0, gravity_mps2]), angle, gimbals, turns)
    if not np.any(arm_m):
        return force
    w = body_rate(angle, rate, gimbals, turns=turns)
    wdot = body_acceleration(angle, rate, acceleration, gimbals, turns=turns)
    return np.asarray(force + np.cross(wdot, arm_m) + np.cross(w, np.cross(w, arm_m)))


def _grouped(samples: ForceSamples) -> tuple[Stamps, Floats]:
    """Return instants (q,) and outputs (q, a) as means over samples within ``_GROUP_S``; NaN with any that is NaN.

    Samples that are further apart than that are returned as they are. Groups across a gap, and samples at the end that
    make no full group, are left out.
    """
    t_ns, outputs = samples.t_ns, samples.output_mps2
    if len(t_ns) < 2:
        return t_ns, outputs
    each = round(_GROUP_S / (float(np.median(np.diff(t_ns))) * 1e-9))
    if each < 2:
        return t_ns, outputs
    count = len(t_ns) // each
    since_ns = t_ns[: count * each].reshape(count, each) - t_ns[0]
    together = np.ptp(since_ns, axis=1) < 2 * _GROUP_S * 1e9
    means = outputs[: count * each].reshape(count, each, -1).mean(axis=1)
    instants = t_ns[0] + np.round(since_ns.mean(axis=1)).astype(np.int64)
    return instants[together], means[together]


def _steps(length_s: float) -> int:
    """Return how many instants of the grid of conditions are in a block of this length."""
    return max(round(length_s / GRID_S), 1)


def _shares(since_ns: Stamps, index: NDArray[np.int64], length_s: float) -> Floats:
    """Return how much each instant of the grid (b * steps,) counts in the mean of its block, 1 on average.

    ``since_ns`` (n,) are the instants of samples from the beginning of block 0, ``index`` (b,) the blocks. Block means
    of laws and of outputs are over the same part of a block: gravity would else seem to differ from scale factors. In
    a block without samples all count alike.
    """
    steps = _steps(length_s)
    cell = since_ns * steps // round(length_s * 1e9)
    place = np.minimum(np.searchsorted(index, cell // steps), len(index) - 1)
    held = index[place] == cell // steps
    counts = np.bincount((place * steps + cell % steps)[held], minlength=len(index) * steps).reshape(-1, steps)
    total = counts.sum(axis=1, keepdims=True)
    return np.asarray(np.where(total > 0, counts * steps / np.maximum(total, 1), 1.0).ravel())


def _conditions(
    recording: Recording,
    data: ImuData,
    table: TableReadings,
    rates: BodyRates,
    t_s: Floats,
    length_s: float,
    arm_m: Floats,
    gravity_mps2: float,
) -> Conditions:
    """Return the conditions on an even grid of about ``GRID_S`` within blocks of ``length_s`` around ``t_s`` (b,).

    The specific force is that at the place ``arm_m`` (3,).
    """
    steps = _steps(length_s)
    offsets = (np.arange(steps) + 0.5) / steps * length_s
    grid_s = (t_s[:, None] - 0.5 * length_s + offsets).ravel()
    grid_ns = np.round(grid_s * 1e9).astype(np.int64)
    return force_conditions(
        rates, table.gimbals, grid_ns, arm_m, gravity_mps2, t_s=grid_s, temperature_c=temperature_at(data, grid_s)
    )


def force_conditions(
    rates: BodyRates,
    gimbals: Sequence[str],
    t_ns: Stamps,
    arm_m: Floats,
    gravity_mps2: float,
    *,
    t_s: Floats | None = None,
    temperature_c: Floats | None = None,
) -> Conditions:
    """Return the conditions at instants (n,), with the specific force at a place ``arm_m`` (3,).

    Earth rate is left out. ``t_s`` (n,) are the instants in s, unrounded if they are known so; ``temperature_c`` (n,)
    is None if not known.
    """
    angle, rate, acceleration = rates.felt_at(t_ns)
    conditions = Conditions.on_table(
        np.asarray(t_ns * 1e-9) if t_s is None else t_s,
        angle,
        rate,
        acceleration,
        gimbals,
        temperature_c=temperature_c,
        site=None,
    )
    return replace(conditions, specific_force_mps2=force_at_place(rates, gimbals, t_ns, arm_m, gravity_mps2))
