"""Rests of a recording, and what its motion leaves unseen."""

from dataclasses import dataclass

import numpy as np

from estimator.geometry.noise import NoiseModel, allan_deviation_of_parts, identify
from estimator.packaged import sentence
from estimator.recordings.recording import ImuData, Recording
from estimator.recordings.reference import RateReadings, TableReadings
from estimator.types import Floats, runs_of

REST_RPS = float(np.radians(0.05))
REST_S = 5.0
_FINEST_S = 0.01  # what is below tells of the sensor's filter and its steps, not of its random walks


@dataclass(frozen=True, slots=True, eq=False)
class RestNoise:
    """What ``span_s`` of rest show of one gyro: Allan deviation (t,) at ``tau_s`` (t,), and the noise it tells of."""

    span_s: float
    tau_s: Floats
    deviation_rps: Floats
    noise: NoiseModel


def rest_noise(data: ImuData, reference: TableReadings | RateReadings) -> list[RestNoise]:
    """Return the noise of each gyro of a source while the table rests; none if it never does for five seconds.

    A sample that is missing is passed over: its neighbours count as neighbours.
    """
    t_ns = data.t_ns
    if len(t_ns) < 2:
        return []
    period_s = float(np.median(np.diff(t_ns))) * 1e-9
    width = max(round(_FINEST_S / period_s), 1)
    parts = []
    for first, last in rest_spans(reference):
        part = data.rate_rps[np.searchsorted(t_ns, first) : np.searchsorted(t_ns, last, side="right")]
        part = part[np.isfinite(part).all(axis=1)]
        rows = len(part) // width
        if rows:
            parts.append(part[: rows * width].reshape(rows, width, -1).mean(axis=1))
    tau_s, deviation_rps = allan_deviation_of_parts(parts, width * period_s)
    if not len(tau_s) or not (deviation_rps > 0).all():
        return []
    span_s = sum(map(len, parts)) * width * period_s
    found = identify(tau_s, deviation_rps, span_s)
    return [RestNoise(span_s, tau_s, own, noise) for own, noise in zip(deviation_rps.T, found, strict=True)]


def rest_spans(reference: TableReadings | RateReadings) -> list[tuple[int, int]]:
    """Return the spans (first, last) in ns of five seconds and more in which no axis of the table moves."""
    rate_rps = reference.centred_rps if isinstance(reference, TableReadings) else reference.rate_rps
    still = np.asarray((np.abs(rate_rps) < REST_RPS).all(axis=1))
    found = [(int(reference.t_ns[a]), int(reference.t_ns[b - 1])) for a, b in runs_of(still)]
    return [(a, b) for a, b in found if b - a >= REST_S * 1e9]


def motion_notes(recording: Recording) -> list[str]:
    """Return what the motion of a recording leaves unseen, in words."""
    reference = recording.reference
    if not isinstance(reference, TableReadings):
        return []
    fastest_rps = np.abs(reference.rate_rps).max(axis=0, initial=0.0).tolist()
    moving = sorted(axis for axis, most in zip(reference.gimbals, fastest_rps, strict=True) if most > 10 * REST_RPS)
    notes = []
    if not moving:
        notes.append(sentence("observations.table_rests"))
    elif len(moving) < 3:
        notes.append(sentence("observations.table_one_axis", axes=" and ".join(moving)))
    if moving and not rest_spans(reference):
        notes.append(sentence("observations.no_rest", length_s=REST_S))
    return notes
