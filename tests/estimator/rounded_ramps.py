"""Runs of a whole IMU on a table whose drives round the corners of their ramps, or lag behind them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from estimator.recordings.recording import Recording
from sims.physics.accelerometer import Accelerometers
from sims.physics.body import Body
from sims.physics.motion import AxisMotion
from station.bench.bench import Bench
from station.opening.simulate import simulate_bench
from station.opening.twins import force_truth_of, mounting_of
from station.scripts.script import Script

NO_LIMIT = 1e3
COUNT_RAD = 2 * np.pi / 65536
PARTS = 41


def s_curve(length_s: float) -> np.ndarray:
    """Return delays (n,) whose mean makes straight ramps S-curves: the acceleration changes within ``length_s``."""
    return length_s * (np.arange(PARTS) + 0.5) / PARTS


def lag(time_constant_s: float) -> np.ndarray:
    """Return delays (n,) whose mean is a motion that lags behind straight ramps, as a first-order low pass does."""
    return -time_constant_s * np.log(1 - (np.arange(PARTS) + 0.5) / PARTS)


def rounded(bench: Bench, script: Script, seed: int, delays_s: Sequence[float] | np.ndarray) -> Recording:
    """Return a run of the only device of a bench, with accelerometers, where each axis is the mean of its straight
    ramps at these delays (n,).

    The readings of the table are those of the rounded motion, at the instants of a straight one. Gyros feel the
    straight ramps: their outputs are not to be used.
    """
    recording, (imu,) = simulate_bench(bench, script, seed), bench.imus
    table, data = recording.table, recording.sources[bench.imus[0].name]
    felt = force_truth_of(bench.twin.truths.again(), imu, bench.site)
    assert table is not None
    assert bench.site is not None
    assert felt is not None
    straight = {axis: AxisMotion(0.0, NO_LIMIT, NO_LIMIT) for axis in table.gimbals}
    for motion in straight.values():
        motion.keep_all()
    for timed in script.timeline():
        for start_s, turn in timed.turns():
            straight[turn.axis].move(start_s, turn.to_rad, abs(turn.rate_rps), turn.acceleration_rps2)

    def angles(axis: str, t_s: np.ndarray) -> np.ndarray:
        return np.asarray(np.mean([straight[axis].angles(t_s - delay_s) for delay_s in delays_s], axis=0))

    def rates(axis: str, t_s: np.ndarray) -> np.ndarray:
        return np.asarray(np.mean([straight[axis].rates(t_s - delay_s) for delay_s in delays_s], axis=0))

    body = Body(
        gimbals=table.gimbals,
        angles=angles,
        revision=lambda: 0,
        latitude_rad=bench.site.latitude_rad,
        heading_rad=bench.site.heading_rad,
    )
    truth, gravity_mps2 = felt
    mounting = mounting_of(bench.twin.truths.again(), imu)
    forces = Accelerometers(
        mounting=mounting,
        truth=truth,
        body=body,
        rate_hz=imu.rate_hz,
        seed=(seed, 61),
        gravity_mps2=gravity_mps2,
        warmth_c=lambda t_s: np.zeros(len(t_s)),
    )
    read_s = table.t_ns * 1e-9
    read = [np.column_stack([one(axis, read_s) for axis in table.gimbals]) for one in (angles, rates)]
    readings = replace(table, angle_rad=np.round(read[0] / COUNT_RAD) * COUNT_RAD, rate_rps=read[1])
    outputs = forces.sample_all(np.asarray(data.t_ns * 1e-9, dtype=np.float64))
    return replace(recording, reference=readings, sources={imu.name: replace(data, accel_mps2=outputs)})
