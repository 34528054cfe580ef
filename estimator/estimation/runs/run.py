"""One run for tracing: block means of output errors, and the conditions of the gyros."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Self

import numpy as np
from numpy.typing import NDArray

from estimator.effects.conditions import Conditions
from estimator.effects.effect import Effect
from estimator.geometry.array import SensorArray
from estimator.geometry.model import StatePrior, regressor_maps
from estimator.observations.turned import REST_RPS
from estimator.packaged import sentence
from estimator.recordings.recording import ImuData, Recording
from estimator.types import Floats

BLOCK_S = 0.2
"""Shortest block: ramps of half a second still show their shape."""
FEWEST_TURNS = 12
"""Turns and rests of known angle below which nothing is traced."""


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class Run:
    """One source of one recording, as means over blocks of ``length_s``.

    ``t_s`` (b,) is the middle of each block on the recording's clock, ``w_rps`` (b, 3) and ``z_rps`` (b, m) are means
    of body rate and output error, ``weight`` (b,) is 1 at rest, less where noise has grown with the rate (``growth_s``,
    see ``measured``), 0 for blocks that hold too few samples. ``grid`` are the conditions at even instants, ``fold``
    takes columns on that grid (N, c) to block means (b, c). ``stretch`` (b,) numbers stretches without a gap; blocks
    are evenly spaced within each. ``order`` is the number of the recording among all that are examined, ``held`` for
    how many samples each value is held.

    For turns of which only the angle is known, a block is a turn or a rest, from its beginning to its end; ``length_s``
    is their mean distance, ``weight`` follows their stated uncertainty, and ``stated_rps`` is the uncertainty at weight
    1 (else 0).

    ``pose`` (b,) numbers the poses of a body at rest whose heading is unknown; ``earth_rps`` (b, m) is how much of the
    horizontal part of Earth rate, one sigma, each gyro may have in them. Both are None where the heading is known or
    this part is a constant.
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
    order: int = 0
    held: int = 1
    stated_rps: float = 0.0
    pose: NDArray[np.intp] | None = None
    earth_rps: Floats | None = None
    growth_s: float = 0.0

    @property
    def array(self) -> SensorArray:
        """The gyros."""
        return self.data.array

    @property
    def prior(self) -> StatePrior:
        """Their data sheet."""
        return self.data.prior

    def columns(self, effect: Effect, gyro: int) -> Floats:
        """Return the block means (b, parameters) of an effect's regressors for one gyro."""
        return self.fold(effect.columns(self.grid, self.array, gyro))

    def weighed(self, columns: Floats, gyro: int) -> Floats:
        """Return columns (b, c) times the weights of the blocks, without the part that an unknown heading allows in
        each pose.

        That part is a constant in each pose, removed as far as Earth rate may exceed the noise. It applies only if
        ``pose`` is known.
        """
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
        return np.asarray(one @ regressor_maps(self.array).transpose(0, 2, 1))

    @property
    def step_s(self) -> float:
        """Return the usual time between readings of the reference."""
        return self.recording.reference.step_s

    @property
    def turns(self) -> bool:
        """Whether the body turns, faster than the Earth."""
        return bool(np.abs(self.w_rps).max(initial=0.0) > REST_RPS)

    @property
    def by_another(self) -> bool:
        """Whether the body turns and another instrument measures it, whose errors are then in the residual."""
        return self.turns and self.recording.reference.by_turns

    def coarse(self) -> Self:
        """Return the run with a fifth of its grid: a few instants in each block do where many functions are tried."""
        blocks = len(self.t_s)
        stride = 5 if len(self.grid.t_s) // blocks % 5 == 0 else 1
        thinned = self.grid.thinned(stride // 2, stride)
        return replace(self, grid=thinned, fold=lambda columns: block_means(columns, blocks))

    def stretches(self) -> list[slice]:
        """Return the blocks of each stretch."""
        edges = np.flatnonzero(np.diff(self.stretch)) + 1
        starts = np.concatenate([[0], edges, [len(self.stretch)]])
        return [slice(int(a), int(b)) for a, b in pairwise(starts.tolist())]


def block_means(columns: Floats, blocks: int) -> Floats:
    """Return the means (blocks, c) of columns (N, c) over as many blocks of the same number of rows."""
    parts = columns.reshape(blocks, len(columns) // blocks, -1)
    return np.asarray(np.einsum("bsc->bc", parts) / parts.shape[1])


def with_gyro(runs: Sequence[Run], name: str) -> list[tuple[int, Run, int]]:
    """Return the runs that have a gyro of this name: their number, the run, and the gyro's number in it."""
    return [(n, run, run.array.names.index(name)) for n, run in enumerate(runs) if name in run.array.names]


def growth_notes(runs: Sequence[Run]) -> list[str]:
    """Return a sentence for each run whose noise grows with the rate."""
    found = []
    for run in (run for run in runs if run.growth_s):
        fastest = float(np.linalg.norm(run.w_rps, axis=1).max())
        times = float(np.hypot(1, run.growth_s * fastest))
        found.append(
            sentence("estimation.noise_grows", run=run.name or run.source, times=times, fastest_dps=np.degrees(fastest))
        )
    return found


def same_devices(first: Sequence[Run], other: Sequence[Run]) -> str:
    """Return how the gyros of two recordings differ, in words; empty if they are the same gyros of the same device.

    Names are compared first, then axes to 0.001, then devices where both state one.
    """
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
