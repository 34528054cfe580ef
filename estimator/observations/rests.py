"""Rests of a recording, their noise, and what the motion leaves unobserved."""

import numpy as np

from estimator.errors import RecordingError
from estimator.geometry.array import accelerometer_names
from estimator.observations.allan.sensor import FORCE, RATE, SensorNoise, Series, sensor_noise
from estimator.packaged import sentence
from estimator.recordings.recording import ImuData, Recording
from estimator.recordings.reference import REST_RPS, REST_S, Reference


def rest_noise(data: ImuData, reference: Reference) -> list[SensorNoise]:
    """Return the noise of each gyro of a source while the body rests; empty if it never rests for five seconds.

    Empty, too, if an output is constant or silent, or more than a twentieth of the samples is missing.
    """
    try:
        series = gyro_series(data, reference.rests_ns)
    except RecordingError:
        return []
    if not series.long_enough or series.constant or series.silent:
        return []
    return sensor_noise(series, coarse=True)


def sensor_series(recording: Recording) -> tuple[dict[str, list[Series]], list[str]]:
    """Return by source the series of its gyros and accelerometers while the body rests, and notes on those not usable.

    That of the gyros is first. A source without accelerometers has no series of them, and no note. A source of which no
    series is usable has an empty list. RecordingError, with what to do, if no rest is known.
    """
    spans = recording.reference.rests_ns
    if not spans:
        raise RecordingError(sentence("allan.no_rest", recording=recording.name, length_s=REST_S))
    found: dict[str, list[Series]] = {}
    notes: list[str] = []
    for source, data in recording.sources.items():
        found[source] = []
        for series in (gyro_series, accelerometer_series):
            if series is accelerometer_series and data.accel_mps2 is None:
                continue
            try:
                found[source].append(series(data, spans))
            except RecordingError as error:
                notes.append(f"{source}: {error}")
    return found, notes


def gyro_series(data: ImuData, spans_ns: list[tuple[int, int]]) -> Series:
    """Return the rates of the gyros of a source within spans of rest."""
    return Series.of(data.array.names, RATE, data.t_ns, data.rate_rps, spans_ns)


def accelerometer_series(data: ImuData, spans_ns: list[tuple[int, int]]) -> Series:
    """Return the specific force along the axes of a source, as recorded, within spans of rest."""
    assert data.accel_mps2 is not None
    columns = data.accel_mps2.reshape(len(data.accel_mps2), -1)
    return Series.of(accelerometer_names(columns.shape[1]), FORCE, data.t_ns, columns, spans_ns)


def motion_notes(recording: Recording) -> list[str]:
    """Return sentences on what the motion of the table leaves unobserved: axes that never turn, and a lack of rests.

    Of a table that never turns at all only the former is said. Empty if there is nothing, and for other references.
    """
    table = recording.table
    if table is None:
        return []
    fastest_rps = np.abs(table.rate_rps).max(axis=0, initial=0.0).tolist()
    moving = sorted(axis for axis, most in zip(table.gimbals, fastest_rps, strict=True) if most > 10 * REST_RPS)
    notes = []
    if not moving:
        notes.append(sentence("observations.table_rests"))
    elif len(moving) < 3:
        notes.append(sentence("observations.table_one_axis", axes=" and ".join(moving)))
    if moving and not table.rests_ns:
        notes.append(sentence("observations.no_rest", length_s=REST_S))
    return notes
