"""Recordings of one device in several mountings: which may be joined, and their joined calibration."""

from collections.abc import Sequence

import numpy as np

from estimator.estimation.mountings.join import JoinedCalibration, join_mountings
from estimator.recordings.recording import Recording
from station.bench.bench import read_excluded
from station.errors import UsageError, sentence
from station.run.outcome import Outcome, ended_of

_UNFINISHED = (Outcome.ABORTED, Outcome.FAULT, Outcome.MANUAL)


def joined_of(
    recordings: Sequence[Recording], undeclared: tuple[frozenset[str] | None] | None = None
) -> JoinedCalibration:
    """Return the calibration of the one device of all recordings, each made in another mounting.

    ``undeclared`` holds one value, the effects that a file rules out, or None; without it they come from the bench file
    or mapping in each recording. UsageError for devices with different serial numbers, for runs that did not come to
    their end and for a run that is given twice, EstimatorError for others that cannot be joined.
    """
    _check(recordings)
    _check_distinct(recordings)
    excluded = [undeclared[0] if undeclared is not None else _excluded(recording) for recording in recordings]
    return join_mountings(recordings, excluded=excluded)


def _check(recordings: Sequence[Recording]) -> None:
    """Raise UsageError for recordings of devices with different serial numbers, or of a run that did not end.

    Such a run was aborted, in fault or driven by hand. Recordings without a serial number or an outcome are accepted.
    There must be at least one.
    """
    first = recordings[0]
    serial = ""
    for recording in recordings:
        own = str(recording.attributes.get("device_serial", ""))
        if own and serial and own != serial:
            raise UsageError(
                sentence("calibrate.other_serial", first=first.name, serial=serial, second=recording.name, other=own)
            )
        serial = serial or own
        ended = ended_of(recording.attributes)
        if ended is not None and ended.outcome in _UNFINISHED:
            raise UsageError(sentence("calibrate.unfinished", recording=recording.name, outcome=str(ended.outcome)))


def _check_distinct(recordings: Sequence[Recording]) -> None:
    """Raise UsageError for two recordings with the same samples: one run, or a copy of its file."""
    for number, first in enumerate(recordings):
        for second in recordings[number + 1 :]:
            if _samples_equal(first, second):
                raise UsageError(sentence("calibrate.joined_twice", first=first.name, second=second.name))


def _samples_equal(first: Recording, second: Recording) -> bool:
    """Return whether all gyros of two recordings have the same outputs at the same instants."""
    return first.sources.keys() == second.sources.keys() and all(
        np.array_equal(own.t_ns, second.sources[name].t_ns)
        and np.array_equal(own.rate_rps, second.sources[name].rate_rps, equal_nan=True)
        for name, own in first.sources.items()
    )


def _excluded(recording: Recording) -> frozenset[str] | None:
    """Return the effects that the bench file or the mapping in a recording rules out."""
    declared = str(recording.attributes.get("bench", "")) or str(recording.attributes.get("mapping", ""))
    return read_excluded(declared, recording.attributes.get("plugins", ()))
