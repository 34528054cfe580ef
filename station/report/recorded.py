"""Data of a recording for the report beside its samples: calibration, live estimates, steps, events."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from drivers.types import Floats, Stamps
from estimator.calibration.calibration_file import read_calibration
from estimator.calibration.values import Calibration
from estimator.errors import EstimatorError, RecordingError, first_line
from estimator.estimation.mountings.join import MountingFound
from estimator.recordings.reading import read_recording
from estimator.recordings.recording import Recording
from estimator.recordings.writing import plain
from station.errors import UsageError
from station.run.outcome import Outcome

if TYPE_CHECKING:
    from h5py import Group


_NOTE = "note: "  # written by a session before a note
_LAYOUT = "its results do not have the layout of the station: {}"
_MAY_LACK_ESTIMATE = (Outcome.MANUAL, Outcome.FAIL, Outcome.ABORTED, Outcome.FAULT)


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class Course:
    """The course of a live filter: states and sigmas (b, m, 4) at ``t_ns`` (b,).

    NIS and its degrees of freedom (c,) are those of blocks, at ``nis_t_ns`` (c,).
    """

    t_ns: Stamps
    states: Floats
    sd: Floats
    nis_t_ns: Stamps
    nis: Floats
    dof: Floats


@dataclass(frozen=True, slots=True)
class Step:
    """One step of the script as it was driven."""

    label: str
    start_ns: int
    end_ns: int


@dataclass(frozen=True, slots=True)
class Event:
    """Something that happened, or a note by the operator."""

    t_ns: int
    text: str

    @property
    def is_note(self) -> bool:
        """Whether it is a note."""
        return self.text.startswith(_NOTE)

    @property
    def words(self) -> str:
        """Text of the event, or of the note."""
        return self.text.removeprefix(_NOTE)


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class RestNoise:
    """Noise of the gyros at rest: Allan deviations (n, t) at averaging times (n, t), NaN beyond the last.

    ``low`` and ``high`` (n, t) are the ends of their 95 % intervals, ``terms_low`` and ``terms_high`` (n, 3) those of
    N, B and K, with 0 as the lower end of a term that was not seen. None for files of older versions.
    """

    tau_s: Floats
    deviation_rps: Floats
    terms: Floats
    low_rps: Floats | None
    high_rps: Floats | None
    terms_low: Floats | None
    terms_high: Floats | None


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class JoinedRun:
    """A recording of a joined calibration: when it began, how its device was mounted, and the mounting error found.

    ``axes`` (3, 3) has the axes x, y and z of the device in its rows, along those of the table.
    """

    path: Path
    begun_utc: datetime | None
    axes: Floats
    found: MountingFound


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class Recorded:
    """A recording with the results stored in it.

    ``calibration`` is None for a run without an estimate. ``rest`` is the noise at rest, None if not stored.
    ``courses`` and ``source_attributes`` are by source. With ``joined``, the calibration is that of all of these
    recordings together, of which this is the first; no file holds it.
    """

    path: Path
    recording: Recording
    calibration: Calibration | None
    rest: RestNoise | None
    courses: Mapping[str, Course]
    source_attributes: Mapping[str, Mapping[str, Any]]
    steps: tuple[Step, ...]
    events: tuple[Event, ...]
    joined: tuple[JoinedRun, ...] = ()

    def label(self, source: str, name: str) -> str:
        """Return the label of a gyro, different for each."""
        return labels_of(self.recording).get((source, name), name)

    @property
    def labels(self) -> list[str]:
        """Labels of the calibrated gyros."""
        return [self.label(gyro.source, gyro.name) for gyro in self.calibration.gyros] if self.calibration else []

    def text(self, name: str) -> str:
        """Return an attribute of the file as text, empty if it has none."""
        value = self.recording.attributes.get(name, "")
        return ", ".join(map(str, value)) if isinstance(value, np.ndarray) else str(value)

    @property
    def start_ns(self) -> int:
        """Instant that times in the report count from: the first step, else the first sample."""
        if self.steps:
            return self.steps[0].start_ns
        return min(int(data.t_ns[0]) for data in self.recording.sources.values() if len(data.t_ns))

    @property
    def begun_utc(self) -> datetime | None:
        """When the measurement began; None where that is not known: in virtual time, in imports."""
        return self.utc("clock_zero_utc_s", self.start_ns)

    def utc(self, name: str, after_ns: int = 0) -> datetime | None:
        """Return the instant in attribute ``name`` (seconds), plus ``after_ns``; None if it is missing or invalid."""
        with suppress(KeyError, TypeError, OverflowError, OSError, ValueError):
            return datetime.fromtimestamp(float(self.recording.attributes[name]) + after_ns * 1e-9, UTC)
        return None

    @property
    def end_ns(self) -> int:
        """Instant at which the last step ended, else that of the last sample."""
        if self.steps:
            return self.steps[-1].end_ns
        return max(int(data.t_ns[-1]) for data in self.recording.sources.values() if len(data.t_ns))


def read_recorded(path: Path) -> Recorded:
    """Return a recording with its results.

    A run by hand, failed, aborted or ended by a fault may lack a calibration. RecordingError for any other file without
    one, and for a file that cannot be read, is damaged or has no samples.
    """
    import h5py

    recording = read_recording(path)
    if not any(len(data.t_ns) for data in recording.sources.values()):
        raise RecordingError(f"{path} holds no samples, so there is nothing to report")
    with laid_out(path, _LAYOUT), h5py.File(path, "r") as file:
        stored = "calibration" in file or recording.attributes.get("outcome") not in _MAY_LACK_ESTIMATE
    return _recorded(path, recording, read_calibration(path, trusted=True) if stored else None)


def _recorded(path: Path, recording: Recording, calibration: Calibration | None) -> Recorded:
    """Return a recording with a calibration, None for none, and all else that its file holds.

    Sources without live estimates or innovations have no course. RecordingError for results with a wrong layout.
    """
    import h5py

    with laid_out(path, _LAYOUT), h5py.File(path, "r") as file:
        estimates, innovations = file.get("estimate", {}), file.get("innovation", {})
        return Recorded(
            path=path,
            recording=recording,
            calibration=calibration,
            rest=_rest_noise(file["calibration"]) if calibration is not None and "calibration" in file else None,
            courses={name: _course(estimates[name], innovations[name]) for name in estimates if name in innovations},
            source_attributes={
                name: {k: plain(v) for k, v in group.attrs.items()} for name, group in file["imu"].items()
            },
            steps=_steps(file["steps"]) if "steps" in file else (),
            events=_events(file["events"]) if "events" in file else (),
        )


def read_joined(path: Path, others: Sequence[Path]) -> Recorded:
    """Return the recording ``path`` with the joined calibration of its device, from it and others in other mountings.

    ``joined`` has all recordings, this one first; the live estimates and the noise at rest of this one run are left
    out. RecordingError or UsageError for files that cannot be read or joined.
    """
    from station.run.joining import joined_of

    paths = [path, *others]
    recordings = [read_recording(one) for one in paths]
    result = joined_of(recordings)
    first = _recorded(path, recordings[0], result.calibration)
    runs = [first, *(_recorded(one, recording, None) for one, recording in zip(others, recordings[1:], strict=True))]
    joined = [
        JoinedRun(path=run.path, begun_utc=run.begun_utc, axes=_mounted_axes(run.recording), found=mounting)
        for run, mounting in zip(runs, result.mountings, strict=True)
    ]
    return replace(first, rest=None, courses={}, joined=tuple(joined))


def _mounted_axes(recording: Recording) -> Floats:
    """Return the mounting of the one device of a recording."""
    return next(iter(recording.sources.values())).mounting.axes


def labels_of(recording: Recording) -> dict[tuple[str, str], str]:
    """Return the label of each gyro, by its source and name: the name, after its source where two have the same."""
    keys = [(source, name) for source, data in recording.sources.items() for name in data.array.names]
    names = [name for _, name in keys]
    return {(s, name): name if names.count(name) == 1 else f"{s} {name}" for s, name in keys}


@contextmanager
def laid_out(path: Path, message: str) -> Iterator[None]:
    """Context that turns any error of a malformed group into a RecordingError; ``message`` has {} for the error's text.

    Errors of the estimator and UsageError pass through.
    """
    try:
        yield
    except (EstimatorError, UsageError):
        raise
    except Exception as error:  # jinja has errors of its own for missing values
        raise RecordingError(f"{path}: {message.format(first_line(error))}") from None


def _rest_noise(group: "Group") -> RestNoise | None:
    """Return the noise at rest of a calibration, None if it is not stored.

    Intervals that older files lack are None. ValueError if other arrays are missing, or any does not fit the gyros.
    """
    if "allan_tau_s" not in group:
        return None

    def column(key: str, like: tuple[int, ...]) -> Floats | None:
        if key not in group:
            return None
        values = np.asarray(group[key][()], dtype=np.float64)
        if values.shape != like:
            raise ValueError(f"{key} is not of these gyros")
        return values

    tau_s = np.asarray(group["allan_tau_s"][()], dtype=np.float64)
    gyros = len(group["name"])
    deviation = column("allan_deviation_rps", tau_s.shape)
    terms = column("rest_noise", (gyros, 3))
    if len(tau_s) != gyros or deviation is None or terms is None:
        raise ValueError("the Allan deviation is not of these gyros")
    return RestNoise(
        tau_s=tau_s,
        deviation_rps=deviation,
        terms=terms,
        low_rps=column("allan_low_rps", tau_s.shape),
        high_rps=column("allan_high_rps", tau_s.shape),
        terms_low=column("rest_noise_low", (gyros, 3)),
        terms_high=column("rest_noise_high", (gyros, 3)),
    )


def _course(estimate: "Group", innovation: "Group") -> Course:
    """Return the course of a live filter from its groups; KeyError for a missing array.

    ValueError if states, sigmas and instants, or NIS and degrees of freedom, do not fit each other.
    """
    states, sd, nis, dof = (
        np.asarray(group[name][()], dtype=np.float64)
        for group, name in ((estimate, "states"), (estimate, "sd"), (innovation, "nis"), (innovation, "dof"))
    )
    course = Course(t_ns=estimate["t_ns"][()], states=states, sd=sd, nis_t_ns=innovation["t_ns"][()], nis=nis, dof=dof)
    if states.ndim != 3 or states.shape != sd.shape or len(states) != len(course.t_ns) or len(nis) != len(dof):
        raise ValueError("the live estimates are of different lengths")
    return course


def _steps(group: "Group") -> tuple[Step, ...]:
    rows = zip(group["label"][()], group["t_start_ns"][()], group["t_end_ns"][()], strict=False)
    return tuple(Step(str(plain(label)), int(start), int(end)) for label, start, end in rows)


def _events(group: "Group") -> tuple[Event, ...]:
    rows = zip(group["t_ns"][()], group["text"][()], strict=False)
    return tuple(Event(int(t), str(plain(text))) for t, text in rows)
