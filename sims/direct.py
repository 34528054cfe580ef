"""Runs made straight from the physics, without a wire: for campaigns over hundreds of seeds."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sims.body import Body
from sims.geometry import Mounting
from sims.gyro import GyroArray, GyroTruth
from sims.motion import AxisMotion

Floats = NDArray[np.float64]
Stamps = NDArray[np.int64]

_NO_LIMIT = 1e3


@dataclass(frozen=True, slots=True)
class TimedMove:
    """Go to an angle from home, beginning at an instant."""

    start_s: float
    axis: str
    angle_rad: float
    rate_rps: float
    acceleration_rps2: float


@dataclass(frozen=True, slots=True, eq=False)
class DirectRun:
    """Readings of the table (k, gimbals) and outputs of the gyros (n, m)."""

    table_t_ns: Stamps
    angle_rad: Floats
    rate_rps: Floats
    t_ns: Stamps
    output_rps: Floats


def direct_run(
    moves: Sequence[TimedMove],
    duration_s: float,
    mounting: Mounting,
    truth: GyroTruth,
    seed: tuple[int, ...],
    *,
    gimbals: Sequence[str] = ("z", "y", "x"),
    latitude_rad: float = math.pi / 4,
    heading_rad: float = 0.0,
    rate_hz: float = 100.0,
    table_rate_hz: float = 20.0,
    counts_per_turn: int = 65536,
    earth_turns: bool = True,
) -> DirectRun:
    """Return what a table that carries out these moves, and gyros on it, would report.

    Angles are whole encoder counts; rates are exact, as a drive's own set-point is.
    """
    motions = {axis: AxisMotion(0.0, _NO_LIMIT, _NO_LIMIT) for axis in gimbals}
    for motion in motions.values():
        motion.keep_all()
    for move in moves:
        motions[move.axis].move(move.start_s, move.angle_rad, move.rate_rps, move.acceleration_rps2)
    body = Body(gimbals, lambda axis, t: motions[axis].angles(t), lambda: 0, latitude_rad, heading_rad, earth_turns)
    gyros = GyroArray(mounting, truth, body, rate_hz, seed)
    t_s = np.arange(1, round(duration_s * rate_hz) + 1) / rate_hz
    output = gyros.sample_all(t_s)
    table_s = np.arange(round(duration_s * table_rate_hz) + 2) / table_rate_hz
    count = 2 * math.pi / counts_per_turn
    angle = np.column_stack([np.round(motions[g].angles(table_s) / count) * count for g in gimbals])
    rate = np.column_stack([[motions[g].at(float(t))[1] for t in table_s] for g in gimbals])
    return DirectRun(_ns(table_s), angle, rate, _ns(t_s), output)


def _ns(t_s: Floats) -> Stamps:
    return np.asarray(np.round(t_s * 1e9), dtype=np.int64)
