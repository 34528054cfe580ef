"""Sessions by hand of several IMUs on one board."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from estimator.errors import RecordingError
from estimator.importing.columns import read_table
from estimator.importing.hands.mapping import PoseMapping
from estimator.importing.log import timed, wanted
from estimator.poses.board import ImuSamples, locate
from estimator.poses.calibration import PoseSession
from estimator.poses.session import PoseSamples, calibrate_poses
from estimator.poses.turns import GyroSamples, calibrate_turns


def board_session(mapping: PoseMapping, data_paths: Sequence[Path]) -> PoseSession:
    """Return the calibration of every IMU of a board, and where they are, from one file.

    ``accelerometer`` and ``gyro`` of the result are those of the first IMU, ``board`` has all. The mapping must have a
    timing.

    RecordingError for more than one file, one that cannot be used, gross errors, and rests or turns too few to show all
    parameters of an IMU.
    """
    if len(data_paths) != 1:
        raise RecordingError("the IMUs of a board are calibrated from one file at a time: name one")
    assert mapping.timing is not None
    path = data_paths[0]
    table = read_table(path, mapping.format, wanted(mapping.timing, mapping.names))
    force = [table.values(imu.accelerometer, f"accelerometer of {imu.name}") for imu in mapping.imus]
    rate = [table.values(imu.gyro.columns, f"gyro of {imu.name}") for imu in mapping.imus]
    if len({len(own) for own in [*force, *rate]}) != 1:
        raise RecordingError(f"{path.name}: its columns differ in length")
    log = timed(path, table, mapping.timing, mapping.format, np.hstack([*force, *rate]))
    t_s, rows = log.time.t_s, log.time.rows
    imus = []
    for imu, own_force, own_rate in zip(mapping.imus, force, rate, strict=True):
        name = f"{path.name}, {imu.name}"
        outputs = own_force[rows]
        rate_rps = own_rate[rows] @ np.linalg.inv(imu.gyro.array.p).T
        samples = PoseSamples(name=name, t_s=t_s, outputs=outputs)
        accelerometer = calibrate_poses([samples], mapping.gravity, mapping.least_s)
        if not accelerometer.shown.all():
            raise RecordingError(f"{name}: {'; '.join(accelerometer.notes)}")
        gyro = calibrate_turns([GyroSamples(name=name, t_s=t_s, rate_rps=rate_rps)], accelerometer)
        imus.append(ImuSamples(name=imu.name, force=outputs, rate_rps=rate_rps, accelerometer=accelerometer, gyro=gyro))
    return PoseSession(
        device=mapping.device,
        licence=mapping.licence,
        source=mapping.source,
        mapping=mapping.text,
        files=(path.name,),
        notes=tuple(f"{path.name}: {note}" for note in [log.time.text, *log.notes]),
        refused_files=(),
        accelerometer=imus[0].accelerometer,
        gyro=imus[0].gyro,
        board=locate(imus),
    )
