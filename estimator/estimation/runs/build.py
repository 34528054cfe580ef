"""Runs for tracing, built from recordings."""

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np

from estimator.effects.conditions import Conditions
from estimator.effects.disturbances import SAMPLE_HOLD
from estimator.effects.scale import SCALE_ASYMMETRY, SCALE_CUBIC, SCALE_QUADRATIC
from estimator.effects.thermal import THERMAL_BIAS, THERMAL_SCALE
from estimator.errors import InvestigationError
from estimator.estimation.runs.conditions import GRID_S, conditions_of, force_at, temperature_at
from estimator.estimation.runs.measured import even_grid, means_by_samples, means_by_turns, weighed
from estimator.estimation.runs.run import BLOCK_S, FEWEST_TURNS, Run, block_means
from estimator.estimation.runs.samples import means_of
from estimator.geometry.kinematics import EARTH_RATE_RPS, GRAVITY_MPS2
from estimator.observations.defects.examined import examined
from estimator.observations.defects.faults import Fault, held_samples, split_faulty
from estimator.observations.rows import in_order, sample_noise, turn_rows
from estimator.observations.turned import Turned
from estimator.packaged import sentence
from estimator.recordings.memory import check_estimating
from estimator.recordings.recording import ImuData, Recording
from estimator.recordings.reference import Poses, Turns
from estimator.types import Floats

_FEWEST_BLOCKS = 40
_TILTED = 0.02  # rad by which the direction up differs between poses
_SENSED = 0.5  # of a turn: its errors show in gyros about its axis
_TURN_STEPS = 125  # instants within a turn, or a rest


def runs_of(recording: Recording, block_s: float = BLOCK_S, order: int = 0) -> tuple[list[Run], list[str], list[Fault]]:
    """Return the sources of a recording as runs, notes on what was left out, and faults of the data.

    Blocks last ``block_s``, longer in long recordings. A source gives several runs where faulty samples divide it,
    named "SOURCE (2)" and so on from the second on; runs with too few blocks are left out. ``order`` is the number of
    the recording among all. If two sources have gyros of the same name, all names get that of their source in front.
    Values held over several samples are faults, too. Notes begin with the recording's name.

    Raises InvestigationError if the reference is gravity, or no run is left.
    """
    if isinstance(recording.reference, Poses):
        raise InvestigationError(sentence("estimation.untraced_gravity", recording=recording.name))
    names = [name for data in recording.sources.values() for name in data.array.names]
    if len(set(names)) < len(names):
        recording = replace(recording, sources={name: _called(name, data) for name, data in recording.sources.items()})
    seen = examined(recording)
    runs: list[Run] = []
    notes = [f"{recording.name}: {note}" for note in seen.notes]
    faults: list[Fault] = []
    for source, its in seen.sources.items():
        if its.held > 1:
            data = recording.sources[source]
            delay_s = 0.5 * (its.held - 1) * float(np.median(np.diff(data.t_ns))) * 1e-9  # on the average
            values = (("samples", float(its.held), "1"), ("delay", delay_s, "s"))
            faults += [Fault(SAMPLE_HOLD.name, name, values) for name in data.array.names]
        faults += its.faults
        notes += [f"{recording.name}: {note}" for note in its.usable.notes]
        notes += [f"{recording.name}: {e.name} is excluded: {e.reason}" for e in its.usable.excluded]
        for number, part in enumerate(p for whole in its.usable.parts for p in split_faulty(whole)):
            label = source if not number else f"{source} ({number + 1})"
            run = _run(seen.recording, label, part, block_s, order, its.held)
            if run is not None:
                runs.append(run)
    if not runs and recording.turns is not None:
        raise InvestigationError(
            f"{recording.name}: {len(recording.turns.sd_rad)} turns and rests of known angle are too few to trace "
            f"an effect: at least {FEWEST_TURNS} are needed, with turns in both directions at several rates"
        )
    if not runs:
        raise InvestigationError(
            sentence("estimation.untraced_short", recording=recording.name, length_s=_FEWEST_BLOCKS * BLOCK_S)
        )
    return runs, notes, faults


def _called(source: str, data: ImuData) -> ImuData:
    """Return a source whose gyros are called by it, too."""
    return replace(data, array=replace(data.array, names=tuple(f"{source} {n}" for n in data.array.names)))


def runs_of_all(
    recordings: Sequence[Recording], first: int = 0, block_s: float = BLOCK_S
) -> tuple[list[Run], list[str], list[Fault]]:
    """Return runs, notes and faults of several recordings together, as ``runs_of``; the first recording has number
    ``first``.

    Raises InvestigationError, and RecordingError if memory does not suffice for so many samples.
    """
    check_estimating(*recordings)
    runs, notes, faults = list[Run](), list[str](), list[Fault]()
    for order, recording in enumerate(recordings, first):
        its = runs_of(recording, block_s, order)
        runs, notes, faults = runs + its[0], notes + its[1], faults + its[2]
    return runs, notes, faults


def run_of(recording: Recording, source: str, data: ImuData) -> Run | None:
    """Return one cleaned source as a run; None if it has too few blocks."""
    fine = recording.table is not None
    return _run(recording, source, data, BLOCK_S, 0, held_samples(data) if fine else 1)


def _run(recording: Recording, source: str, data: ImuData, block_s: float, order: int, held: int) -> Run | None:
    """Return one source as a run of block means, None with too few; of a recording of turns each turn or rest is one.

    Blocks last about ``block_s``; in gaps of up to 5 s blocks without samples are filled in with weight 0, longer ones
    divide stretches. ``order`` is the place of the run among others, ``held`` the number of samples for which each
    value is held. At rest the output errors are means over the samples.
    """
    if recording.turns is not None:
        return _run_of_turns(recording, recording.turns, source, data, order)
    means = means_by_turns if recording.reference.by_turns else means_by_samples
    measured = means(recording, data, block_s)
    if measured is None or len(measured.index) < _FEWEST_BLOCKS:
        return None
    index, where = even_grid(measured.index, measured.length_s)
    b, m, length_s = len(index), len(data.array), measured.length_s
    w, z, weight = np.zeros((b, 3)), np.zeros((b, m)), np.zeros(b)
    w[where], z[where], weight[where] = measured.w_rps, measured.z_rps, measured.full
    stretch = np.cumsum(np.diff(index, prepend=index[:1]) > 1).astype(np.intp)
    growth_s = 0.0
    if not recording.reference.by_turns:  # otherwise errors that grow with the motion are the other instrument's
        weight, growth_s = weighed(w, z, weight, stretch)
    t_s = np.asarray(measured.origin_s + (index + 0.5) * length_s, dtype=np.float64)
    steps = max(round(length_s / GRID_S), 1)
    offsets = (np.arange(steps) + 0.5) / steps * length_s
    grid_s = (t_s[:, None] - 0.5 * length_s + offsets).ravel()

    @lru_cache(maxsize=12)  # every gyro asks for the same
    def delayed_rps(delay_s: float) -> Floats:
        ago = w.copy()
        past = measured.past_rps(delay_s)
        ago[where] = np.where(np.isfinite(past), past, w[where])
        return np.repeat(ago, steps, axis=0)

    grid = replace(conditions_of(recording, data, grid_s, w, steps), delayed_rps=delayed_rps)
    run = Run(
        name=recording.name,
        source=source,
        data=data,
        length_s=length_s,
        t_s=t_s,
        w_rps=w,
        z_rps=z,
        weight=weight,
        stretch=stretch,
        grid=grid,
        fold=lambda columns: block_means(columns, b),
        recording=recording,
        order=order,
        held=held,
        growth_s=growth_s,
    )
    if recording.reference.at_rest:
        run = replace(run, z_rps=_sample_means(run))
    return run if run.turns or grid.gimbals else replace(run, **_unknown_earth(run))


def _sample_means(run: Run) -> Floats:
    """Return output errors (b, m) as means over the samples of each block: at rest there is nothing to integrate."""
    t_ns, rate_rps = in_order(run.data)
    means, counts = means_of(run, np.asarray(t_ns * 1e-9, dtype=np.float64), rate_rps)
    return np.where(counts > 0, means - run.w_rps @ run.array.p.T, run.z_rps)


def _unknown_earth(run: Run) -> dict[str, Any]:
    """Return ``pose`` (b,) and ``earth_rps`` (b, m) for a run without a table, or an empty dict where they are not
    needed.

    The former numbers the poses of the blocks from 0, the latter is the standard deviation of Earth rate about each
    sense axis, as the heading is not known. A new pose begins after a break if the direction of gravity has changed.
    The dict is empty where gravity is not known, the body rate holds the horizontal part of Earth rate, or each file
    has only one pose.
    """
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
    files = run.recording.file_of(run.t_s)
    if not pose[-1] or len(set(zip(files.tolist(), pose.tolist(), strict=True))) == files.max() + 1:
        return {}  # of one pose a file the Earth is a part of the bias that each file has
    across = 1 - np.clip((ups @ run.array.p.T) ** 2, 0.0, 1.0)
    return {"pose": pose, "earth_rps": size * np.sqrt(across / 2)}


def _run_of_turns(recording: Recording, turns: Turns, source: str, data: ImuData, order: int) -> Run | None:
    """Return turns and rests as a run with one block each, None for fewer than ``FEWEST_TURNS`` with samples.

    The rate within a turn is that of the gyros, with the mean that the reference states. Turns, not rests, weigh less
    if they scatter more than stated.
    """
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
        t_s=grid_s,
        w_rps=w.reshape(-1, 3),
        wdot_rps2=slope.reshape(-1, 3),
        angle_rad=none,
        rate_rps=none,
        acceleration_rps2=none,
        gimbals=(),
        specific_force_mps2=force_at(recording, data, grid_s),
        temperature_c=temperature_at(data, grid_s),
        site=recording.site,
    )
    run = Run(
        name=recording.name,
        source=source,
        data=data,
        length_s=float(t_s[-1] - t_s[0]) / (len(t_s) - 1),
        t_s=t_s,
        w_rps=rows.w_rps,
        z_rps=rows.y_rps - rows.w_rps @ data.array.p.T,
        weight=rows.weight / rows.weight.max(),
        stretch=np.zeros(len(t_s), dtype=np.intp),
        grid=grid,
        fold=lambda columns: block_means(columns, len(t_s)),
        recording=recording,
        order=order,
        held=1,
        stated_rps=float(sample_noise(data).max() / rows.weight.max()),
    )
    return replace(run, weight=run.weight / np.where(turning, _more_than_stated(run), 1.0))


def _more_than_stated(run: Run) -> float:
    """Return by what factor (at least 1) turns are less accurate than stated, one for all.

    It is the scatter that remains after laws of scale factor and, if it was measured, of temperature are fitted, over
    the stated noise. A turn counts for the gyros about whose axis more than half of it is.
    """
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
