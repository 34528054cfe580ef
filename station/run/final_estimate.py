"""The estimate at the end of a run from the recorded samples, compared with that of the live filter."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from estimator.calibration.calibration_file import write_calibration
from estimator.calibration.error_model import ErrorModel
from estimator.calibration.values import Calibration
from estimator.estimation.calibrate import calibrate
from estimator.estimation.live.forces import white_forces
from estimator.estimation.live.sample_columns import white_solution
from estimator.recordings.reading import read_recording
from estimator.recordings.recording import Recording
from estimator.recordings.writing import write_attributes
from station.run.live import LiveEstimate
from station.run.source_report import SourceReport


def final_estimate(
    path: Path,
    live: LiveEstimate,
    model: ErrorModel | None,
    excluded: frozenset[str] | None,
    reports: Mapping[str, SourceReport],
) -> tuple[Calibration, float, dict[str, SourceReport]]:
    """Calibrate a closed recording and store the results and reports in it; return calibration, agreement and reports.

    The agreement is the largest difference between live filter and batch estimate, in sigmas. ``model`` and
    ``excluded`` are as for ``calibrate``. The notes of ``live`` are added to those of the calibration. The reports
    returned, by source, are ``reports`` with the time offsets found. The live estimate must be finished. EstimatorError
    if the samples do not suffice or the file cannot be read or written.
    """
    recording = read_recording(path, trusted=True)
    found = calibrate(recording, model=model, excluded=excluded)
    calibration = replace(found, notes=(*found.notes, *live.notes))
    agreement = _agreement(recording, live)
    fuller = {name: replace(reports[name], offset=calibration.offsets.get(name)) for name in live.sources}
    write_attributes(path, {}, *((name, report.attributes()) for name, report in fuller.items()))
    write_calibration(path, calibration, {"live_batch_difference_sigma": agreement})
    return calibration, agreement, fuller


def _agreement(recording: Recording, live: LiveEstimate) -> float:
    """Return the largest difference between live filter and batch estimate, in sigmas of the latter, with white noise.

    It is over all states of gyros and accelerometers; accelerometers without a block are left out. 0 without sources.
    """
    largest = 0.0
    for name, source in live.sources.items():
        about = source.effects, source.prior, source.noise_rps, source.offset_sd_s, source.history.taken_off
        batch = white_solution(recording, recording.sources[name], *about)
        x, _ = source.filter.state()
        sd = np.sqrt(np.diagonal(batch.covariance, axis1=1, axis2=2))
        largest = max(largest, float(np.abs((x - batch.x) / sd).max()))
    for name, forces in live.forces.items():
        if forces.blocks:
            found, (all_x, _) = white_forces(recording, name, forces), forces.state()
            all_sd = np.sqrt(np.diag(found.covariance))
            largest = max(largest, float(np.abs((all_x - found.x) / all_sd).max()))
    return largest
