"""One run as tracing sees it: block means of output errors, and what the gyros went through meanwhile."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.effects.conditions import Conditions
from estimator.effects.disturbances import SAMPLE_HOLD
from estimator.effects.effect import Effect
from estimator.effects.scale import SCALE_ASYMMETRY, SCALE_CUBIC, SCALE_QUADRATIC
from estimator.effects.thermal import THERMAL_BIAS, THERMAL_SCALE
from estimator.errors import InvestigationError
from estimator.estimation.runs.growth import weighed
from estimator.geometry.array import SensorArray
from estimator.geometry.kinematics import AXES, EARTH_RATE_RPS, GRAVITY_MPS2, specific_force
from estimator.geometry.model import Prior, regressor_maps
from estimator.observations.blocks import BlockSums
from estimator.observations.defects.faults import Fault, held_samples, saturations, split_faulty, without_stuck
from estimator.observations.health import usable
from estimator.observations.rows import sample_noise, table_rows, turn_rows
from estimator.observations.turned import REST_RPS, Turned, by_turns
from estimator.recordings.recording import ImuData, Recording
from estimator.recordings.reference import AttitudeReadings, BodyRates, Poses, TableReadings, Turns

Floats = NDArray[np.float64]
Stamps = NDArray[np.int64]

BLOCK_S = 0.2
"""Shortest block: ramps of half a second still show their shape."""
_MOVED_S = 0.1  # where no table makes the motion: hands and shafts turn about within a second
_TURNS_RAD = 0.5
_SMOOTH_PERIODS = 10  # in a block: fewer would show what turns are smoothed by
_MOST_BLOCKS = 8000
_GRID_S = 0.02  # instants at which conditions are worked out, within blocks
_FINE_S = 0.005  # samples closer than this are taken together where the rate of before is looked up
_GAP_S = 5.0  # a longer gap ends a stretch: what the noise did meanwhile is not known
_FEWEST_BLOCKS = 40
_JUMP, _JUMP_C = 8.0, 0.5  # sigmas, degC
_SMOOTH_S = 0.2  # accelerometers also feel vibration
FEWEST_TURNS = 12
"""Turns and rests of known angle below which nothing is traced."""
_TILTED = 0.02  # rad by which the direction up differs between poses
_SENSED = 0.5  # of a turn: what it is off by shows in gyros about its axis
_TURN_STEPS = 125  # instants within a turn, or a rest


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """One source of one recording, as means over blocks of ``length_s``.

    ``t_s`` (b,) is the middle of each block on the recording's clock, ``w_rps`` (b, 3) and ``z_rps`` (b, m) are means
    of body rate and output error, ``weight`` (b,) is 1 at rest, less where noise has
    grown with the rate (``growth_s``, see ``tracing.growth``), 0 for blocks that hold too few samples. ``grid`` are the
    conditions at even instants, ``fold`` takes columns on that grid (N, c) to block means (b, c). ``stretch`` (b,)
    numbers stretches without a gap; blocks are evenly spaced within each. ``order`` is the number of the recording
    among all that are looked at, ``held`` for how many samples each value is held.

    Of turns of which only the angle is known a block is a turn or a rest, from its beginning to its end; ``length_s``
    is their mean distance, ``weight`` goes by their doubt, and ``stated_rps`` is the doubt at weight 1 (else 0).

    ``pose`` (b,) numbers poses of a body at rest of which nobody knows the heading; ``earth_rps`` (b, m) is how much of
    the horizontal part of Earth rate, one sigma, each gyro may have in them. None where that is known, or one constant.
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
    stated_rps: float = 0.0
    pose: NDArray[np.intp] | None = None
    earth_rps: Floats | None = None
    growth_s: float = 0.0

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

    def weighed(self, columns: Floats, gyro: int) -> Floats:
        """Return columns (b, c) as they count of a gyro; of what it may have of the Earth in a pose they are rid."""
        out = columns * self.weight[:, None]
        if self.pose is None or self.earth_rps is None:
            return out
        first = np.flatnonzero(np.diff(self.pose, prepend=-1))
        sizes = np.diff([*first, len(out)])
        count = np.maximum(np.add.reduceat(self.weight, first), 1.0)
        steps = np.diff(self.z_rps[:, gyro])[(self.weight[1:] > 0) & (self.weight[:-1] > 0)]
        noise = max(float(np.median(np.abs(steps))) / 0.954, 1e-12)
        # A constant with an expectation, taken out of white noise: the root of the inverse of their covariance.
        share = 1 - 1 / np.hypot(1.0, np.sqrt(count) * self.earth_rps[first, gyro] / noise)
        mean = np.add.reduceat(out, first, axis=0) * (share / count)[:, None]
        return np.asarray(out - np.repeat(mean, sizes, axis=0) * self.weight[:, None])

    def state_columns(self) -> Floats:
        """Return the regressors (m, b, 4) of the states of every gyro."""
        one = np.column_stack([np.ones(len(self.t_s)), self.w_rps])
        return np.asarray(np.einsum("bj,mij->mbi", one, regressor_maps(self.array)))

    @property
    def step_s(self) -> float:
        """Return the usual time between readings of the reference."""
        reference = self.recording.reference
        return 0.0 if isinstance(reference, (Turns, Poses)) else float(np.median(np.diff(reference.t_ns))) * 1e-9

    @property
    def turns(self) -> bool:
        """Whether the body turns, faster than the Earth."""
        return bool(np.abs(self.w_rps).max(initial=0.0) > REST_RPS)

    def coarse(self) -> Run:
        """Return the run with a fifth of its grid: a few instants in each block do where many functions are tried."""
        blocks = len(self.t_s)
        stride = 5 if len(self.grid.t_s) // blocks % 5 == 0 else 1
        thinned = self.grid.rows(slice(stride // 2, None, stride))

        def fold(columns: Floats) -> Floats:
            return np.asarray(columns.reshape(blocks, len(thinned.t_s) // blocks, -1).mean(axis=1))

        return replace(self, grid=thinned, fold=fold)

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
            faults += [Fault(SAMPLE_HOLD.name, name, values) for name in data.array.names]
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
    if isinstance(recording.reference, Poses):
        raise InvestigationError(
            f"{recording.name}: gravity between rests tells what three gyros do together, for which nothing is traced; "
            'station calibrate gives the states, and imported with kind = "rest" the rests can be traced'
        )
    if not runs and isinstance(recording.reference, Turns):
        raise InvestigationError(
            f"{recording.name}: {len(recording.reference.sd_rad)} turns and rests of known angle are too few to trace "
            f"anything: at least {FEWEST_TURNS} are needed, with turns of both signs, of several rates"
        )
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
    if isinstance(recording.reference, Turns):
        return _run_of_turns(recording, recording.reference, source, data, order)
    measured = (
        _by_turns(recording, data, block_s) if by_turns(recording.reference) else _by_samples(recording, data, block_s)
    )
    if measured is None or len(measured.index) < _FEWEST_BLOCKS:
        return None
    index, where = _even(measured.index, measured.length_s)
    b, m, length_s = len(index), len(data.array), measured.length_s
    w, z, weight = np.zeros((b, 3)), np.zeros((b, m)), np.zeros(b)
    w[where], z[where], weight[where] = measured.w_rps, measured.z_rps, measured.full
    stretch = np.cumsum(np.diff(index, prepend=index[:1]) > 1).astype(np.intp)
    growth_s = 0.0
    if not by_turns(recording.reference):  # else what grows with the motion is what the other instrument gets wrong
        weight, growth_s = weighed(w, z, weight, stretch)
    t_s = np.asarray(measured.origin_s + (index + 0.5) * length_s, dtype=np.float64)
    steps = max(round(length_s / _GRID_S), 1)
    offsets = (np.arange(steps) + 0.5) / steps * length_s
    grid_s = (t_s[:, None] - 0.5 * length_s + offsets).ravel()

    @lru_cache(maxsize=12)  # every gyro asks for the same
    def delayed_rps(delay_s: float) -> Floats:
        ago = w.copy()
        past = measured.past_rps(delay_s)
        ago[where] = np.where(np.isfinite(past), past, w[where])
        return np.repeat(ago, steps, axis=0)

    grid = replace(_conditions(recording, data, grid_s, w, steps), delayed_rps=delayed_rps)
    stretch = np.cumsum(np.diff(index, prepend=index[:1]) > 1)
    run = Run(
        recording.name,
        source,
        data,
        length_s,
        t_s,
        w,
        z,
        weight,
        stretch,
        grid,
        lambda columns: columns.reshape(b, steps, -1).mean(axis=1),
        recording,
        float(np.median(np.diff(data.t_ns))) * 1e-9,
        order,
        held,
        growth_s=growth_s,
    )
    return run if run.turns or grid.gimbals else replace(run, **_unknown_earth(run))


def _unknown_earth(run: Run) -> dict[str, Any]:
    """Return ``pose`` and ``earth_rps`` of a run at rest, where there are several poses and north is not stated."""
    up, good, site = run.fold(run.grid.specific_force_mps2) / GRAVITY_MPS2, run.weight > 0, run.recording.site
    size = EARTH_RATE_RPS * (np.cos(site.latitude_rad) if site else np.sqrt(0.5))
    if not good.any() or not np.isfinite(up).all():
        return {}
    level = run.w_rps - np.sum(run.w_rps * up, axis=1, keepdims=True) * up
    if site and np.median(np.linalg.norm(level[good], axis=1)) > 0.5 * size:
        return {}
    # A pose ends where the body was moved and points elsewhere then.
    pose, ups, before = np.zeros(len(up), dtype=np.intp), np.zeros_like(up), -1
    begins = good & (np.diff(np.where(good, run.stretch, -1), prepend=-1) != 0)
    starts = np.flatnonzero(begins).tolist()
    for start, stop in pairwise([*starts, len(up)]):
        mean = np.median(up[start:stop][good[start:stop]], axis=0)
        new = before >= 0 and np.linalg.norm(mean - ups[before]) > _TILTED
        pose[start:] += new
        ups[start:] = mean if new or before < 0 else ups[before]
        before = start
    if not pose[-1]:
        return {}
    across = 1 - np.clip((ups @ run.array.p.T) ** 2, 0.0, 1.0)
    return {"pose": pose, "earth_rps": size * np.sqrt(across / 2)}


def _run_of_turns(recording: Recording, turns: Turns, source: str, data: ImuData, order: int) -> Run | None:
    """Return turns and rests as blocks; how a body turned on the way to its stop the gyros themselves tell."""
    rows, which = turn_rows(data, turns)
    if len(which) < FEWEST_TURNS:
        return None
    assert rows.weight is not None
    start_s, end_s = turns.t_start_ns[which] * 1e-9, turns.t_end_ns[which] * 1e-9
    edges = np.linspace(start_s, end_s, _TURN_STEPS + 1, axis=1)
    first, last = edges[:, :-1].ravel(), edges[:, 1:].ravel()
    felt = Turned.of_rates(data.t_ns, data.rate_rps, np.inf).means(first, last) @ np.linalg.pinv(data.array.p).T
    felt = np.nan_to_num(felt).reshape(len(which), _TURN_STEPS, 3)
    turning = np.abs(turns.turn_rad[which]).max(axis=1) > 0
    w = (felt - felt.mean(axis=1, keepdims=True)) * turning[:, None, None] + rows.w_rps[:, None]
    grid_s, t_s = 0.5 * (first + last), 0.5 * (start_s + end_s)
    slope = np.gradient(w, axis=1) / np.diff(edges, axis=1)[:, :, None]
    none = np.empty((len(grid_s), 0))
    grid = Conditions(
        grid_s,
        w.reshape(-1, 3),
        slope.reshape(-1, 3),
        *(none, none, none),
        (),
        _force(recording, data, grid_s),
        _temperature(data, grid_s),
        recording.site,
    )
    run = Run(
        recording.name,
        source,
        data,
        float(t_s[-1] - t_s[0]) / (len(t_s) - 1),
        t_s,
        rows.w_rps,
        rows.y_rps - rows.w_rps @ data.array.p.T,
        rows.weight / rows.weight.max(),
        np.zeros(len(t_s), dtype=np.intp),
        grid,
        lambda columns: columns.reshape(len(t_s), len(columns) // len(t_s), -1).mean(axis=1),
        recording,
        float(np.median(np.diff(data.t_ns))) * 1e-9,
        order,
        1,
        float(sample_noise(data).max() / rows.weight.max()),
    )
    return replace(run, weight=run.weight / np.where(turning, _more_than_stated(run), 1.0))


def _more_than_stated(run: Run) -> float:
    """Return how many times as wrong as stated turns are, at least 1, by what no law of scale or temperature fits."""
    known = [SCALE_ASYMMETRY, SCALE_QUADRATIC, SCALE_CUBIC]
    known += [THERMAL_SCALE, THERMAL_BIAS] if run.grid.temperature_c is not None else []
    effects = [record.effect() for record in known]
    squares = freedom = 0.0
    for i, states in enumerate(run.state_columns()):
        columns = np.hstack([states, *(run.columns(effect, i) for effect in effects)]) * run.weight[:, None]
        left, size, _ = np.linalg.svd(columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-30), full_matrices=False)
        left = left[:, size > 1e-6 * size[0]]
        turning = np.abs(run.w_rps @ run.array.p[i]) > _SENSED * np.linalg.norm(run.w_rps, axis=1)
        z = run.z_rps[:, i] * run.weight
        squares += float(np.sum((z - left @ (left.T @ z))[turning] ** 2))
        freedom += float(np.sum(1 - np.sum(left**2, axis=1)[turning]))
    return max(float(np.sqrt(squares / max(freedom, 1.0))) / run.stated_rps, 1.0)


@dataclass(frozen=True, slots=True, eq=False)
class _Measured:
    """Blocks (B,) from ``origin_s`` on: number, mean body rate (B, 3), output error (B, m), whether they are ``full``.

    ``past_rps`` gives their body rate (B, 3) some seconds ago, NaN where it is not known.
    """

    origin_s: float
    length_s: float
    index: NDArray[np.int64]
    w_rps: Floats
    z_rps: Floats
    full: NDArray[np.bool_]
    past_rps: Callable[[float], Floats]


def _by_samples(recording: Recording, data: ImuData, block_s: float) -> _Measured | None:
    """Return means over samples, the body rate at each of them."""
    reference = recording.reference
    assert isinstance(reference, TableReadings)
    period_s = float(np.median(np.diff(data.t_ns))) * 1e-9
    length_s = _length_s(recording, data, block_s, period_s)
    origin_ns = int(reference.t_ns[0])
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
    # Every few samples together, by the middle of their instants: what is linear in between has the same means.
    number = (t_ns - origin_ns) // round(length_s * 1e9)
    first = np.flatnonzero(np.diff(number, prepend=number[0] - 1))
    within = np.arange(len(t_ns)) - np.repeat(first, np.diff(np.append(first, len(t_ns))))
    group = np.flatnonzero(within % max(round(_FINE_S / period_s), 1) == 0)
    count = np.diff(np.append(group, len(t_ns)))
    instants = t_ns[0] + np.round(np.add.reduceat(t_ns - t_ns[0], group) / count).astype(np.int64)
    start = np.searchsorted(group, first)
    rates = BodyRates.of(reference, recording.site)

    def past_rps(delay_s: float) -> Floats:
        at = np.maximum(instants - round(delay_s * 1e9), origin_ns)
        w = rates.at(np.minimum(at, rates.final_until_ns)) * count[:, None]
        return np.asarray(np.add.reduceat(w, start, axis=0) / blocks.rows[:, None])

    full = blocks.rows >= 0.5 * np.median(blocks.rows)
    return _Measured(origin_ns * 1e-9, length_s, blocks.index, blocks.w_rps, blocks.z_rps, full, past_rps)


def _by_turns(recording: Recording, data: ImuData, block_s: float) -> _Measured | None:
    """Return mean rates of the body and of the outputs over the same intervals."""
    if len(data.t_ns) < 2:
        return None
    gyros, body = Turned.of_rates(data.t_ns, data.rate_rps), Turned.of_reference(recording.reference, recording.site)
    least_s = 2 * _step_s(gyros)
    if np.abs(body.integral).max() > _TURNS_RAD:  # of a body at rest a few readings tell all
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
        float(origin_s),
        length_s,
        index.astype(np.int64),
        w[index],
        (y - w @ data.array.p.T)[index],
        np.ones(len(index), dtype=np.bool_),
        lambda delay_s: body.means(first - delay_s, last - delay_s),
    )


def _step_s(turned: Turned) -> float:
    return float(np.median(np.diff(turned.t_s)))


def _length_s(recording: Recording, data: ImuData, block_s: float, least_s: float) -> float:
    span_s = float(data.t_ns[-1] - data.t_ns[0]) * 1e-9
    most = _MOST_BLOCKS * max(BLOCK_S / block_s, 1.0)
    return max(block_s, least_s, np.ceil(span_s / most / 0.1 - 1e-9) * 0.1 if span_s > most * block_s else 0.0)


def _even(known: NDArray[np.int64], length_s: float) -> tuple[NDArray[np.int64], NDArray[np.intp]]:
    """Return block numbers with short gaps filled, and where the blocks that hold data are among them."""
    most = max(int(_GAP_S / length_s), 1)
    filled = [known[:1]]
    for before, after in pairwise(known.tolist()):
        filled.append(np.arange(before + 1, after + 1) if after - before <= most else np.array([after]))
    index = np.concatenate(filled).astype(np.int64)
    return index, np.searchsorted(index, known)


def _conditions(recording: Recording, data: ImuData, grid_s: Floats, w_rps: Floats, steps: int) -> Conditions:
    temperature = _temperature(data, grid_s)
    reference = recording.reference
    if by_turns(reference):
        return _conditions_by_turns(recording, data, grid_s, w_rps, steps, temperature)
    assert isinstance(reference, TableReadings)
    angle, rate, acceleration = _gimbals(reference, grid_s)
    return Conditions.on_table(
        grid_s, angle, rate, acceleration, reference.gimbals, temperature_c=temperature, site=recording.site
    )


def _conditions_by_turns(
    recording: Recording, data: ImuData, grid_s: Floats, w_rps: Floats, steps: int, temperature_c: Floats | None
) -> Conditions:
    """Return conditions of which rate and acceleration are those of whole blocks."""
    reference = recording.reference
    body = Turned.of_reference(reference, recording.site)
    period_s = grid_s[1] - grid_s[0]
    length_s = steps * period_s
    first_s = grid_s[::steps] - 0.5 * period_s
    change = body.rates(first_s + length_s) - body.rates(first_s)
    wdot = np.repeat(np.where(np.isfinite(change), change, 0.0) / length_s, steps, axis=0)
    w = np.repeat(w_rps, steps, axis=0)
    if isinstance(reference, TableReadings):
        column = AXES.index(reference.gimbals[0])
        angle = np.interp(grid_s, reference.t_ns * 1e-9, np.unwrap(reference.angle_rad[:, 0]))[:, None]
        rate, slope, gimbals = w[:, [column]], wdot[:, [column]], reference.gimbals
        force = specific_force(angle, gimbals) if data.accel_mps2 is None else _force(recording, data, grid_s)
    else:
        angle = rate = slope = np.empty((len(grid_s), 0))
        gimbals, force = (), _force(recording, data, grid_s)
    return Conditions(grid_s, w, wdot, angle, rate, slope, gimbals, force, temperature_c, recording.site)


def _temperature(data: ImuData, grid_s: Floats) -> Floats | None:
    if data.temperature_c is None or not np.isfinite(data.temperature_c).any():
        return None
    known = np.isfinite(data.temperature_c)
    t_s = np.asarray(data.t_ns[known] * 1e-9, dtype=np.float64)
    return _smooth_temperature(t_s, data.temperature_c[known], grid_s)


def _gimbals(reference: TableReadings, grid_s: Floats) -> tuple[Floats, Floats, Floats]:
    rates, grid_ns = BodyRates.of(reference, None), np.round(grid_s * 1e9).astype(np.int64)
    return *rates.gimbals_at(grid_ns), rates.accelerations_at(grid_ns)


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


def growth_notes(runs: Sequence[Run]) -> list[str]:
    """Return, in words, which runs have noise that grows with the rate."""
    found = []
    for run in (run for run in runs if run.growth_s):
        fastest = float(np.linalg.norm(run.w_rps, axis=1).max())
        times = float(np.hypot(1, run.growth_s * fastest))
        found.append(
            f"{run.name or run.source}: noise grows with the rate, to {times:.1f} times that at rest at "
            f"{np.degrees(fastest):.0f} deg/s: fast motion counts for less"
        )
    return found


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
