"""From a recording on a table to the calibration of its accelerometers."""

from dataclasses import replace

from estimator.calibration.accelerometer import ForceCalibration
from estimator.calibration.values import unseen_notes
from estimator.errors import RecordingError
from estimator.estimation.accelerometers.estimate import estimate_forces
from estimator.estimation.accelerometers.samples import checked
from estimator.recordings.recording import Recording
from estimator.sensors.accelerometers import ACCELEROMETER


def calibrate_forces(recording: Recording) -> tuple[tuple[ForceCalibration, ...], list[str]]:
    """Return the calibrations of the accelerometers by source, and notes.

    Calibrated are those with a data sheet, on a table. A source of which too little was recorded has a note only.
    """
    table = recording.table
    found: list[ForceCalibration] = []
    notes: list[str] = []
    if table is None:
        return (), notes
    for source, data in recording.sources.items():
        if data.accel_mps2 is None or data.accel_sheet is None:
            continue
        seen = checked(data, table)
        notes += seen.notes
        doubts = [f"{one.name} is not calibrated: {one.reason}" for one in seen.excluded]
        if seen.samples is None:
            notes += doubts
            continue
        try:
            own = estimate_forces(recording, source, seen.samples, data.accel_sheet.noise)
        except RecordingError as error:
            notes += doubts
            notes.append(f"{source}: the accelerometers are not calibrated: {error}")
            continue
        for one in own.accelerometers:
            notes += unseen_notes(one.name, one.covariance, seen.samples.prior, ACCELEROMETER.states)
        found.append(replace(own, excluded=seen.excluded, doubts=tuple(doubts)))
    return tuple(found), notes
