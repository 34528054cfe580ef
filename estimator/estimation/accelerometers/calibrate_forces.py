"""From a recording on a table to the calibration of its accelerometers."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from estimator.calibration.accelerometer import ForceCalibration
from estimator.calibration.error_model import KnownForceEffect
from estimator.errors import RecordingError
from estimator.estimation.accelerometers.estimate import estimate_forces
from estimator.estimation.accelerometers.samples import Checked, checked
from estimator.geometry.model import ForcePrior
from estimator.observations.health import Excluded
from estimator.packaged import sentence
from estimator.recordings.recording import Recording
from estimator.sensors.accelerometers import ACCELEROMETER

_UNSEEN = 0.5  # share of the prior's sigma above which a run did not show a state


def calibrate_forces(
    recording: Recording, effects: Sequence[KnownForceEffect] = ()
) -> tuple[tuple[ForceCalibration, ...], list[str]]:
    """Return the calibrations of the accelerometers by source, and notes.

    Calibrated are accelerometers with a data sheet, on a table; those of which too little was recorded are excluded.
    Doubts name each that is excluded, states that the run did not show, and outputs that stuck or come in coarse steps.
    A source none of whose accelerometers can be calibrated has a result without any, whose doubts give the reasons. The
    ``effects`` of a model are estimated with the states; ModelError for one that cannot be. If no source has usable
    accelerometers, a note says that they are unused. Notes are otherwise those of the examination.
    """
    found: list[ForceCalibration] = []
    notes: list[str] = []
    usable = usable_forces(recording)
    if effects and not usable:
        names = ", ".join(effect.name for effect in effects)
        notes.append(sentence("estimation.accelerometer_effects_unused", effects=names))
    for source, seen in usable:
        data = recording.sources[source]
        notes += seen.notes
        doubts = [f"{one.name} is not calibrated: {one.reason}" for one in seen.excluded]
        if seen.samples is None:
            found.append(_none(source, data.device, seen.excluded, doubts))
            continue
        try:
            noise = data.accel_sheet.noise if data.accel_sheet is not None else None
            own = estimate_forces(recording, source, seen.samples, noise, effects)
        except RecordingError as error:
            lost = [Excluded(name, str(error)) for name in seen.samples.array.names]
            doubts += [f"{one.name} is not calibrated: {one.reason}" for one in lost]
            found.append(_none(source, data.device, [*seen.excluded, *lost], doubts))
            continue
        doubts += [*seen.doubts, *own.doubts, *undetermined(own, seen.samples.prior)]
        found.append(replace(own, excluded=seen.excluded, doubts=tuple(doubts)))
    return tuple(found), notes


def undetermined(calibration: ForceCalibration, prior: ForcePrior) -> list[str]:
    """Return a sentence for each accelerometer with states whose sigmas are more than half of those of the data sheet.

    It names these states.
    """
    sentences = []
    for one in calibration.accelerometers:
        ratio = np.sqrt(np.diag(one.covariance) / prior.variances())
        unseen = [s.symbol for s, share in zip(ACCELEROMETER.states, ratio, strict=True) if share > _UNSEEN]
        if unseen:
            sentences.append(sentence("estimation.accelerometer_undetermined", name=one.name, states=", ".join(unseen)))
    return sentences


def usable_forces(recording: Recording) -> list[tuple[str, Checked]]:
    """Return by source what can be used of its accelerometers; empty without a table or a data sheet for them.

    A device with a data sheet for accelerometers that sent none of their outputs is in the list once, by its first
    source, with its accelerometers excluded. Pairs of source and result are in the order of the recording; one without
    ``samples`` tells in ``excluded`` why.
    """
    table = recording.table
    if table is None:
        return []
    found: list[tuple[str, Checked]] = []
    stated = {source: data for source, data in recording.sources.items() if data.accel_sheet is not None}
    told = {data.device for data in stated.values() if data.accel_mps2 is not None}
    for source, data in stated.items():
        if data.accel_mps2 is not None:
            found.append((source, checked(data, table)))
        elif data.device not in told:
            told.add(data.device)
            silent = Excluded(f"{data.device or source} accelerometers", sentence("estimation.accelerometers_silent"))
            found.append((source, Checked(samples=None, excluded=(silent,), notes=())))
    return found


def _none(source: str, device: str, excluded: Sequence[Excluded], doubts: Sequence[str]) -> ForceCalibration:
    """Return the calibration of a source none of whose accelerometers can be calibrated; arm and gravity are NaN."""
    nothing = np.zeros((0, 0))
    return ForceCalibration(
        source=source,
        device=device,
        accelerometers=(),
        covariance=nothing,
        arm_m=np.full(3, np.nan),
        arm_covariance_m2=np.full((3, 3), np.nan),
        gravity_mps2=np.nan,
        excluded=tuple(excluded),
        doubts=tuple(doubts),
    )
