"""Runs made straight from the physics, without a wire: for campaigns over hundreds of seeds."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drivers.types import Floats, Stamps
from sims.physics.accelerometer import Accelerometers, AccelerometerTruth
from sims.physics.body import Body
from sims.physics.geometry import Mounting
from sims.physics.gyro import GyroArray, GyroTruth
from sims.physics.hidden.effects import Hidden
from sims.physics.hidden.table import Motion, TableFaults
from sims.physics.motion import AxisMotion

_NO_LIMIT = 1e3
_READ_EVERY_S, _TEMPERATURE_COUNT_C, _TEMPERATURE_NOISE_C = 1.0, 0.01, 0.005
_OF_TEMPERATURE, _OF_FORCE = 84, 85  # seeds of their own, so that the gyros' noise does not depend on them


@dataclass(frozen=True, slots=True)
class TimedMove:
    """A move to an angle from home that starts at a given instant."""

    start_s: float
    axis: str
    angle_rad: float
    rate_rps: float
    acceleration_rps2: float


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class DirectRun:
    """Readings of the table (k, gimbals), and outputs (n, m) and temperature readings (n,) of the gyros.

    ``force_mps2`` (n, a) are the outputs of the accelerometers, None without any. The first sample is one period after
    the start; readings of the table begin at the start and go on past the end.
    """

    table_t_ns: Stamps
    angle_rad: Floats
    rate_rps: Floats
    t_ns: Stamps
    output_rps: Floats
    temperature_c: Floats
    force_mps2: Floats | None = None


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
    hidden: Hidden | None = None,
    started_s: float = 0.0,
    accelerometers: tuple[Mounting, AccelerometerTruth] | None = None,
    gravity_mps2: float = 9.80665,
) -> DirectRun:
    """Return the readings of a table that carries out ``moves``, and of its gyros, computed without wires or drivers.

    ``mounting`` and ``truth`` are the axes and errors of the gyros; the same ``seed`` gives the same noise. ``gimbals``
    are the axes, outermost first; ``heading_rad`` is the direction of the table's base from north. Gyros sample at
    ``rate_hz`` from one period after 0 up to ``duration_s``; the table is read at ``table_rate_hz`` from 0 to one
    period more. Angles are rounded to encoder counts; rates are exact, as a drive's set point is. Moves have no limits
    but their own. The bench clock, for temperature and ``hidden`` effects, is at ``started_s`` when the run begins.
    ``accelerometers`` are the axes and truth of those that sample with the gyros, in a field of ``gravity_mps2``.
    """
    table = hidden.table if hidden is not None else TableFaults()
    motions = _motions(moves, gimbals)
    true = {axis: table.true_angles(axis, motion.angles, started_s) for axis, motion in motions.items()}
    body = Body(
        gimbals=gimbals,
        angles=lambda axis, t: true[axis](t),
        revision=lambda: 0,
        latitude_rad=latitude_rad,
        heading_rad=heading_rad,
        earth_turns=earth_turns,
        directions=table.directions(gimbals),
    )
    gyros = GyroArray(
        mounting=mounting, truth=truth, body=body, rate_hz=rate_hz, seed=seed, hidden=hidden, started_s=started_s
    )
    t_s = np.arange(1, round(duration_s * rate_hz) + 1) / rate_hz
    output = gyros.sample_all(t_s)
    force = None
    if accelerometers is not None:
        force = _felt(body, gyros, t_s, accelerometers, gravity_mps2=gravity_mps2, seed=(*seed, _OF_FORCE))
    table_s = np.arange(round(duration_s * table_rate_hz) + 2) / table_rate_hz
    count = 2 * math.pi / counts_per_turn
    read = [_read(motions[g], table.read(g, motions[g].at, started_s), table_s) for g in gimbals]
    return DirectRun(
        table_t_ns=_ns(table_s),
        angle_rad=np.column_stack([np.round(angle / count) * count for angle, _ in read]),
        rate_rps=np.column_stack([rate for _, rate in read]),
        t_ns=_ns(t_s),
        output_rps=output,
        temperature_c=_read_temperature(gyros, t_s, (*seed, _OF_TEMPERATURE)),
        force_mps2=force,
    )


def _motions(moves: Sequence[TimedMove], gimbals: Sequence[str]) -> dict[str, AxisMotion]:
    """Return the motion of each axis, which begins at home and carries out its moves, given in order of their times.

    KeyError for a move of an axis that is no gimbal.
    """
    motions = {axis: AxisMotion(0.0, _NO_LIMIT, _NO_LIMIT) for axis in gimbals}
    for motion in motions.values():
        motion.keep_all()
    for move in moves:
        motions[move.axis].move(move.start_s, move.angle_rad, move.rate_rps, move.acceleration_rps2)
    return motions


def _felt(
    body: Body,
    gyros: GyroArray,
    t_s: Floats,
    accelerometers: tuple[Mounting, AccelerometerTruth],
    *,
    gravity_mps2: float,
    seed: tuple[int, ...],
) -> Floats:
    """Return the outputs (n, a) in m/s2 of accelerometers that sample with the gyros and have their temperature.

    ``t_s`` (n,) are evenly spaced, two or more; their errors are stated at the same temperature as those of the gyros.
    """
    axes, errors = accelerometers
    felt = Accelerometers(
        mounting=axes,
        truth=errors,
        body=body,
        rate_hz=1 / float(t_s[1] - t_s[0]),
        seed=seed,
        gravity_mps2=gravity_mps2,
        warmth_c=lambda t: gyros.temperatures_c(t) - gyros.stated_c,
    )
    return felt.sample_all(t_s)


def _read(motion: AxisMotion, read: Motion, t_s: Floats) -> tuple[Floats, Floats]:
    """Return angles and rates (n,) of an axis as the faulty table reads them; computed at once if it has no fault."""
    if read == motion.at:
        return motion.angles(t_s), motion.rates(t_s)
    angle, rate = np.array([*map(read, t_s.tolist())]).T
    return angle, rate


def _read_temperature(gyros: GyroArray, t_s: Floats, seed: tuple[int, ...]) -> Floats:
    """Return temperatures (n,) as a node reports them: read once a second, with a little noise, in whole counts."""
    seconds, since = np.unique(np.floor(t_s / _READ_EVERY_S), return_inverse=True)
    noise = _TEMPERATURE_NOISE_C * np.random.default_rng(seed).standard_normal(len(seconds))
    read = gyros.temperatures_c(seconds * _READ_EVERY_S) + noise
    return np.asarray((np.round(read / _TEMPERATURE_COUNT_C) * _TEMPERATURE_COUNT_C)[since])


def _ns(t_s: Floats) -> Stamps:
    return np.asarray(np.round(t_s * 1e9), dtype=np.int64)
