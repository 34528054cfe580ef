"""One run as tracing sees it: block means of output errors, and what the gyros went through meanwhile."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from estimator.array import SensorArray
from estimator.blocks import Blocks, BlockSums
from estimator.effects.conditions import Conditions
from estimator.effects.effect import Effect
from estimator.health import usable
from estimator.kinematics import GRAVITY_MPS2
from estimator.model import Prior, regressor_maps
from estimator.recording import ImuData, Recording
from estimator.reference import AttitudeReadings, BodyRates, TableReadings, Turns
from estimator.rows import MEAN_S, observations
from estimator.tracing.faults import Fault, held_samples, saturations, split_faulty, without_stuck
from estimator.tracing.investigation import InvestigationError

Floats = NDArray[np.float64]
Stamps = NDArray[np.int64]

BLOCK_S = 0.2
"""Shortest block: ramps of half a second still show their shape."""
_MOST_BLOCKS = 6000
_GRID_S = 0.02  # instants at which conditions are worked out, within blocks
_GAP_S = 5.0  # a longer gap ends a stretch: what the noise did meanwhile is not known
_FEWEST_BLOCKS = 40
_JUMP, _JUMP_C = 8.0, 0.5  # sigmas, degC
_SMOOTH_S = 0.2  # accelerometers also feel vibration


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """One source of one recording, as means over blocks of ``length_s``.

    ``t_s`` (b,) is the middle of each block on the recording's clock, ``w_rps`` (b, 3) and ``z_rps`` (b, m) are means
    of body rate and output error, ``weight`` (b,) is 1, or 0 for blocks that hold too few samples. ``grid`` are the
    conditions at even instants, ``fold`` takes columns on that grid (N, c) to block means (b, c). ``stretch`` (b,)
    numbers stretches without a gap; blocks are evenly spaced within each. ``order`` is the number of the recording
    among all that are looked at, ``held`` for how many samples each value is held.
    """

    name: str
    source: str
    data: ImuData
    length_s: float
    t_s: Floats
    w_rps: Floats
    z_rps: Floats
    weight: Floats
    stretch: NDArray[np.intp]
    grid: Conditions
    fold: Callable[[Floats], Floats]
    recording: Recording
    period_s: float
    order: int
    held: int

    @property
    def array(self) -> SensorArray:
        """The gyros."""
        return self.data.array

    @property
    def prior(self) -> Prior:
        """Their data sheet."""
        return self.data.prior

    def columns(self, effect: Effect, gyro: int) -> Floats:
        """Return the block means (b, parameters) of an effect's regressors for one gyro."""
        return self.fold(effect.columns(self.grid, self.array, gyro))

    def state_columns(self) -> Floats:
        """Return the regressors (m, b, 4) of the states of every gyro."""
        one = np.column_stack([np.ones(len(self.t_s)), self.w_rps])
        return np.asarray(np.einsum("bj,mij->mbi", one, regressor_maps(self.array)))

    def stretches(self) -> list[slice]:
        """Return the blocks of each stretch."""
        edges = np.flatnonzero(np.diff(self.stretch)) + 1
        starts = np.concatenate([[0], edges, [len(self.stretch)]])
        return [slice(int(a), int(b)) for a, b in pairwise(starts.tolist())]


def runs_of(recording: Recording, block_s: float = BLOCK_S, order: int = 0) -> tuple[list[Run], list[str], list[Fault]]:
    """Return the sources of a recording that can be traced, notes on what was left out, and faults of the data.

    Blocks last ``block_s``, longer in long recordings.

    Raises InvestigationError if there is nothing to trace in it.
    """
    if isinstance(recording.reference, Turns):
        raise InvestigationError(
            f"{recording.name}: of turns only their angles are known, not what happens within them; effects are traced "
            "against a table, a rate, an attitude, or rests"
        )
    fine = isinstance(recording.reference, TableReadings)
    runs: list[Run] = []
    notes: list[str] = []
    faults: list[Fault] = []
    names = [name for data in recording.sources.values() for name in data.array.names]
    for source, original in recording.sources.items():
        data = original
        if len(set(names)) < len(names):
            data = replace(data, array=replace(data.array, names=tuple(f"{source} {n}" for n in data.array.names)))
        held = held_samples(data) if fine else 1
        if held > 1:
            values = (("samples", float(held), "1"), ("delay", _hold_delay_s(data, held), "s"))
            faults += [Fault("sample_hold", name, values) for name in data.array.names]
        elif fine:
            data, stuck = without_stuck(data)
            faults += stuck
        found = usable(data, fine=fine)
        faults += saturations(found.notes, data)
        notes += [f"{recording.name}: {note}" for note in found.notes]
        notes += [f"{recording.name}: {e.name} is left out: {e.reason}" for e in found.excluded]
        for number, part in enumerate(p for whole in found.parts for p in split_faulty(whole)):
            label = source if not number else f"{source} ({number + 1})"
            run = _run(recording, label, part, block_s, order, held)
            if run is not None:
                runs.append(run)
    if not runs:
        raise InvestigationError(
            f"{recording.name}: too little data: no source has {_FEWEST_BLOCKS * BLOCK_S:g} s of samples that the "
            "reference covers"
        )
    return runs, notes, faults


def run_of(recording: Recording, source: str, data: ImuData) -> Run | None:
    """Return one source, cleaned of what cannot be used, as tracing sees it; None if it holds too little."""
    fine = isinstance(recording.reference, TableReadings)
    return _run(recording, source, data, BLOCK_S, 0, held_samples(data) if fine else 1)


def _hold_delay_s(data: ImuData, held: int) -> float:
    """Return by how much held samples lag on the average."""
    return 0.5 * (held - 1) * float(np.median(np.diff(data.t_ns))) * 1e-9


def _run(recording: Recording, source: str, data: ImuData, block_s: float, order: int, held: int) -> Run | None:
    blocks = _blocks(recording, data, block_s)
    if len(blocks.index) < _FEWEST_BLOCKS:
        return None
    index, where = _even(blocks)
    b, m = len(index), len(data.array)
    w, z, weight = np.zeros((b, 3)), np.zeros((b, m)), np.zeros(b)
    full = np.median(blocks.rows)
    good = blocks.rows >= 0.5 * full
    w[where], z[where] = blocks.w_rps, blocks.z_rps
    weight[where[good]] = 1.0
    origin_s = _origin_ns(recording, data) * 1e-9
    t_s = np.asarray(origin_s + (index + 0.5) * blocks.length_s, dtype=np.float64)
    steps = max(round(blocks.length_s / _GRID_S), 1)
    offsets = (np.arange(steps) + 0.5) / steps * blocks.length_s
    grid_s = (t_s[:, None] - 0.5 * blocks.length_s + offsets).ravel()
    grid = _conditions(recording, data, grid_s, w, steps)
    stretch = np.cumsum(np.diff(index, prepend=index[:1]) > 1)
    return Run(
        recording.name,
        source,
        data,
        blocks.length_s,
        t_s,
        w,
        z,
        weight,
        stretch.astype(np.intp),
        grid,
        lambda columns: columns.reshape(b, steps, -1).mean(axis=1),
        recording,
        blocks.period_s,
        order,
        held,
    )


def _origin_ns(recording: Recording, data: ImuData) -> int:
    reference = recording.reference
    return int(reference.t_ns[0]) if isinstance(reference, TableReadings) else int(data.t_ns[0])


def _blocks(recording: Recording, data: ImuData, block_s: float) -> Blocks:
    span_s = float(data.t_ns[-1] - data.t_ns[0]) * 1e-9 if len(data.t_ns) > 1 else 0.0
    period_s = float(np.median(np.diff(data.t_ns))) * 1e-9 if len(data.t_ns) > 1 else 1.0
    if isinstance(recording.reference, AttitudeReadings):
        period_s = max(period_s, MEAN_S)
    most = _MOST_BLOCKS * max(BLOCK_S / block_s, 1.0)
    length_s = max(block_s, period_s, np.ceil(span_s / most / 0.1 - 1e-9) * 0.1 if span_s > most * block_s else 0.0)
    sums = BlockSums(len(data.array), _origin_ns(recording, data), length_s, period_s)
    part_of = Recording({"it": data}, recording.reference, recording.site, path=recording.path)
    for part in observations(part_of, "it"):
        if part.t_ns is not None:
            sums.add(part.t_ns, part.w_rps, part.y_rps - part.w_rps @ data.array.p.T)
    return sums.blocks()


def _even(blocks: Blocks) -> tuple[NDArray[np.int64], NDArray[np.intp]]:
    """Return block numbers with short gaps filled, and where the blocks that hold data are among them."""
    most = max(int(_GAP_S / blocks.length_s), 1)
    filled = [blocks.index[:1]]
    for before, after in zip(blocks.index[:-1].tolist(), blocks.index[1:].tolist(), strict=True):
        filled.append(np.arange(before + 1, after + 1) if after - before <= most else np.array([after]))
    index = np.concatenate(filled).astype(np.int64)
    return index, np.searchsorted(index, blocks.index)


def _conditions(recording: Recording, data: ImuData, grid_s: Floats, w_rps: Floats, steps: int) -> Conditions:
    temperature = None
    if data.temperature_c is not None and np.isfinite(data.temperature_c).any():
        known = np.isfinite(data.temperature_c)
        temperature = _smooth_temperature(_seconds(data.t_ns[known]), data.temperature_c[known], grid_s)
    reference = recording.reference
    if isinstance(reference, TableReadings):
        angle, rate, acceleration = _gimbals(reference, grid_s)
        return Conditions.on_table(
            grid_s,
            angle,
            rate,
            acceleration,
            reference.gimbals,
            temperature_c=temperature,
            site=recording.site,
        )
    w = np.repeat(w_rps, steps, axis=0)
    wdot = np.repeat(np.gradient(w_rps, steps * (grid_s[1] - grid_s[0]), axis=0), steps, axis=0)
    none = np.empty((len(grid_s), 0))
    force = _force(recording, data, grid_s)
    return Conditions(grid_s, w, wdot, none, none, none, (), force, temperature, recording.site)


def _seconds(t_ns: Stamps) -> Floats:
    return np.asarray(t_ns * 1e-9, dtype=np.float64)


def _gimbals(reference: TableReadings, grid_s: Floats) -> tuple[Floats, Floats, Floats]:
    rates = BodyRates.of(reference, None)
    known_s = reference.t_ns * 1e-9
    slopes = np.diff(reference.rate_rps, axis=0) / np.diff(known_s)[:, None]
    between = np.clip(np.searchsorted(known_s, grid_s, side="right") - 1, 0, len(slopes) - 1)
    angle, rate = rates.gimbals_at(np.round(grid_s * 1e9).astype(np.int64))
    return angle, rate, slopes[between]


def _smooth_temperature(t_s: Floats, temperature_c: Floats, grid_s: Floats) -> Floats:
    """Return the temperature at instants, with the steps of its readings smoothed over ten seconds."""
    width = 10.0
    edges = np.arange(t_s[0], t_s[-1] + width, width)
    number = np.clip(np.searchsorted(edges, t_s, side="right") - 1, 0, None)
    counts = np.bincount(number)
    held = counts > 0
    mean_t = np.bincount(number, t_s)[held] / counts[held]
    mean_c = np.bincount(number, temperature_c)[held] / counts[held]
    if len(mean_t) < 4:
        return np.asarray(np.interp(grid_s, t_s, temperature_c))
    from scipy.interpolate import PchipInterpolator

    inside = np.clip(grid_s, mean_t[0], mean_t[-1])
    smooth = np.asarray(PchipInterpolator(mean_t, mean_c)(inside))
    # A temperature that jumps is not smoothed: where the two differ by more than noise, the readings count.
    noise = float(np.median(np.abs(np.diff(temperature_c)))) / 0.954
    raw = np.interp(inside, t_s, temperature_c)
    smooth = np.where(np.abs(raw - smooth) > np.maximum(_JUMP * noise, _JUMP_C), raw, smooth)
    # Beyond the first and last mean the temperature goes on as it began and ended.
    first = (mean_c[1] - mean_c[0]) / (mean_t[1] - mean_t[0])
    last = (mean_c[-1] - mean_c[-2]) / (mean_t[-1] - mean_t[-2])
    return np.asarray(
        smooth + first * np.minimum(grid_s - mean_t[0], 0.0) + last * np.maximum(grid_s - mean_t[-1], 0.0)
    )


def _force(recording: Recording, data: ImuData, grid_s: Floats) -> Floats:
    """Return the specific force (N, 3) in body axes: of the attitude if there is one, else of an accelerometer."""
    reference = recording.reference
    if isinstance(reference, AttitudeReadings):
        good = np.isfinite(reference.attitude_wxyz).all(axis=1)
        at = reference.t_ns[good] * 1e-9
        w, x, y, z = reference.attitude_wxyz[good].T
        up = np.column_stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]) * GRAVITY_MPS2
        return np.column_stack([np.interp(grid_s, at, column) for column in up.T])
    if data.accel_mps2 is None:
        return np.full((len(grid_s), 3), np.nan)
    good = np.isfinite(data.accel_mps2).all(axis=1)
    t_s, accel = data.t_ns[good] * 1e-9, data.accel_mps2[good]
    if not len(t_s):
        return np.full((len(grid_s), 3), np.nan)
    width = max(round(_SMOOTH_S / max(float(np.median(np.diff(t_s))), 1e-6)), 1)
    kernel = np.ones(width) / width
    smooth = [np.convolve(np.pad(c, width, mode="edge"), kernel, "same")[width:-width] for c in accel.T]
    return np.column_stack([np.interp(grid_s, t_s, column) for column in smooth])


def same_devices(first: Sequence[Run], other: Sequence[Run]) -> str:
    """Return in which way the gyros of two recordings differ, empty if they are the same gyros of the same device."""
    ours = {(n, tuple(np.round(p, 3))) for run in first for n, p in zip(run.array.names, run.array.p, strict=True)}
    theirs = {(n, tuple(np.round(p, 3))) for run in other for n, p in zip(run.array.names, run.array.p, strict=True)}
    if {n for n, _ in ours} != {n for n, _ in theirs}:
        return f"gyros {', '.join(sorted(n for n, _ in ours))} and {', '.join(sorted(n for n, _ in theirs))}"
    if ours != theirs:
        return "gyros of the same names along other axes"
    devices = {r.data.device for r in first if r.data.device}, {r.data.device for r in other if r.data.device}
    if all(devices) and devices[0] != devices[1]:
        return f"devices {', '.join(sorted(devices[0]))} and {', '.join(sorted(devices[1]))}"
    return ""
