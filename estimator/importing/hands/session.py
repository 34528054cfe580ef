"""Sessions in which hands laid a device in many poses: external files and a mapping become a calibration."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from estimator.errors import RecordingError
from estimator.importing.columns import read_table
from estimator.importing.hands.mapping import PoseMapping
from estimator.importing.log import timed, wanted
from estimator.importing.mapping.mapping import Timing
from estimator.importing.table import Wanted
from estimator.observations.defects.faults import updates
from estimator.poses.calibration import GyroTurnCalibration, PoseCalibration, PoseSession
from estimator.poses.session import PoseSamples, calibrate_poses
from estimator.poses.turns import FewTurns, GyroSamples, calibrate_turns
from estimator.types import Floats


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class _HandLog:
    """Samples of one file: instants (n,) or None for given means, accelerometers (n, 3), gyros (n, m) if there are."""

    name: str
    t_s: Floats | None
    force: Floats
    rate_rps: Floats | None
    notes: Sequence[str]


def calibrate_by_hand(mapping: PoseMapping, data_paths: Sequence[Path]) -> PoseSession:
    """Return the calibration from all files of one device.

    A file that cannot be read is left out; RecordingError, with every reason, if none is left, and for gross errors.
    """
    if not data_paths:
        raise RecordingError("no data file is given. Name at least one after the mapping")
    logs: list[_HandLog] = []
    refused: list[str] = []
    for path in data_paths:
        try:
            logs.append(_read(mapping, path))
        except RecordingError as error:
            refused.append(f"{path.name}: {str(error).removeprefix(path.name).removeprefix(':').strip()}")
    if not logs:
        raise RecordingError("nothing to import: " + "; ".join(refused))
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
    mapping: PoseMapping, logs: Sequence[_HandLog], accelerometer: PoseCalibration
) -> tuple[GyroTurnCalibration | None, list[str]]:
    """Return the calibration of the gyros by the turns, None without gyros, and why there is none.

    RecordingError if gyros and accelerometers contradict each other.
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


def _read(mapping: PoseMapping, path: Path) -> _HandLog:
    """Return the samples of a file; RecordingError if it cannot be used."""
    if mapping.timing is None:
        table = read_table(path, mapping.format, Wanted((), tuple(mapping.names)))
        force = table.values(mapping.accelerometer, "[accelerometer] columns")
        return _HandLog(name=path.name, t_s=None, force=force, rate_rps=None, notes=table.notes)
    return _timed(mapping, mapping.timing, path)


def _timed(mapping: PoseMapping, timing: Timing, path: Path) -> _HandLog:
    """Return the samples of a file of samples, without held values and without rows that lack the accelerometers."""
    table = read_table(path, mapping.format, wanted(timing, mapping.names))
    force = table.values(mapping.accelerometer, "[accelerometer] columns")
    rate = table.values(mapping.gyro.columns, "[gyro] columns") if mapping.gyro else None
    if rate is not None and len(rate) != len(force):
        raise RecordingError(f"{path.name} has {len(rate)} gyro rows but {len(force)} accelerometer rows")
    log = timed(path, table, timing, mapping.format, force if rate is None else np.hstack([force, rate]))
    rows, t_s = log.time.rows, log.time.t_s
    notes = [f"{path.name}: {note}" for note in [log.time.text, *log.notes]]
    seen = np.isfinite(force[rows]).any(axis=1)
    kept = np.flatnonzero(seen)
    if len(kept) < 2:
        raise RecordingError(f"{path.name} has no number of the accelerometer. Check [accelerometer] columns")
    fresh = updates(force[rows[kept]])
    if fresh is not None and len(fresh) > 1:
        share = len(kept) / len(fresh)
        notes.append(f"{path.name}: the accelerometer is new in one row of {share:.2g}; rows between were skipped")
        kept = kept[fresh]
    rates = None if rate is None else rate[rows[kept]]
    return _HandLog(name=path.name, t_s=t_s[kept], force=force[rows[kept]], rate_rps=rates, notes=notes)
