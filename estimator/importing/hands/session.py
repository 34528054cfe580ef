"""Sessions in which hands laid a device in many poses: external files and a mapping become a calibration."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from estimator.errors import RecordingError
from estimator.importing.hands.board import board_session
from estimator.importing.hands.known import known_session
from estimator.importing.hands.log import HandLog, read_log
from estimator.importing.hands.mapping import PoseMapping
from estimator.poses.calibration import GyroTurnCalibration, PoseCalibration, PoseSession
from estimator.poses.session import PoseSamples, calibrate_poses
from estimator.poses.turns import FewTurns, GyroSamples, calibrate_turns


def calibrate_by_hand(mapping: PoseMapping, data_paths: Sequence[Path]) -> PoseSession:
    """Return the calibration from all files of one device, in known or unknown poses, or of several IMUs on a board.

    A file that cannot be read is left out, with its reason in the result; a board must have a single one, which can be
    read. RecordingError if none is named, with every reason if none is left, and for gross errors. Gyros that cannot be
    calibrated in unknown poses are left out, with a note.
    """
    if not data_paths:
        raise RecordingError("no data file is given. Name at least one after the mapping")
    if mapping.imus:
        return board_session(mapping, data_paths)
    logs: list[HandLog] = []
    refused: list[str] = []
    for path in data_paths:
        try:
            logs.append(read_log(mapping, path))
        except RecordingError as error:
            refused.append(f"{path.name}: {str(error).removeprefix(path.name).removeprefix(':').strip()}")
    if not logs:
        raise RecordingError("nothing to import: " + "; ".join(refused))
    if mapping.known is not None:
        return known_session(mapping, mapping.known, logs, refused)
    samples = [
        PoseSamples(name=log.name, t_s=log.t_s, outputs=log.force, scale_known=mapping.scale_known) for log in logs
    ]
    accelerometer = calibrate_poses(samples, mapping.gravity, mapping.least_s)
    gyro, gyro_notes = _gyro(mapping, logs, accelerometer)
    return PoseSession(
        device=mapping.device,
        licence=mapping.licence,
        source=mapping.source,
        mapping=mapping.text,
        files=tuple(log.name for log in logs),
        accelerometer=accelerometer,
        gyro=gyro,
        notes=(*(note for log in logs for note in log.notes), *gyro_notes),
        refused_files=tuple(refused),
    )


def _gyro(
    mapping: PoseMapping, logs: Sequence[HandLog], accelerometer: PoseCalibration
) -> tuple[GyroTurnCalibration | None, list[str]]:
    """Return the calibration of the gyros by the turns, and why there is none if it is None.

    It is None without gyros, which needs no reason, unless there are three about three axes, if the rests do not show
    all of the accelerometers, and for too few turns. RecordingError if gyros and accelerometers contradict each other.
    """
    if mapping.gyro is None:
        return None, []
    p = mapping.gyro.array.p
    if p.shape != (3, 3) or np.linalg.matrix_rank(p, tol=0.1) < 3:
        return None, ["gyros are calibrated by the turns between rests only if there are three, about three axes"]
    if not accelerometer.shown.all():
        return None, ["the gyros are not calibrated: the rests do not show the direction of gravity to them"]
    into_body = np.linalg.inv(p).T
    samples = [
        GyroSamples(name=log.name, t_s=log.t_s, rate_rps=log.rate_rps @ into_body)
        for log in logs
        if log.t_s is not None and log.rate_rps is not None
    ]
    try:
        return calibrate_turns(samples, accelerometer), []
    except FewTurns as error:
        return None, [f"the gyros are not calibrated: {error}"]
