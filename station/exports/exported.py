"""The exported part of a recording: calibration, compensation of chosen gyros, and their origin."""

import hashlib
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from estimator.calibration.accelerometer import ForceCalibration
from estimator.calibration.calibration_file import read_calibration
from estimator.calibration.compensation import Compensation
from estimator.calibration.error_model import ErrorModel
from estimator.calibration.gyro import GyroCalibration
from estimator.calibration.values import Calibration
from estimator.errors import EstimatorError, RecordingError
from estimator.recordings.reading import read_recording
from estimator.recordings.recording import Recording
from station.bench.bench import read_limits
from station.bench.units import USUAL, Units
from station.errors import BenchError, UsageError, sentence
from station.render.template import rendered
from station.run.joining import joined_of
from station.run.outcome import Outcome, Verdict, judge_recorded
from station.views.accelerometers.result import FORCE_FIGURES
from station.views.figures import state_figures
from station.views.seen import Seen, seen_by

_RAW = ("imu", "table", "reference")
_NUMBERS = "biuf"

RAW_RULE = sentence("export.raw_rule")
"""How the hash of the raw data is formed, in words."""


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class Exported:
    """Gyros of a recording with their calibration. ``identity`` describes them and the origin of the figures.

    ``forces`` are the accelerometers of the same devices, if they were calibrated, too.
    """

    path: Path
    identity: Mapping[str, str]
    calibration: Calibration
    gyros: tuple[GyroCalibration, ...]
    compensation: Compensation
    seen: Seen
    devices: tuple[str, ...]
    instance: int = 0  # which of an autopilot's gyros they are
    units: Units = USUAL
    forces: tuple[ForceCalibration, ...] = ()

    @property
    def name(self) -> str:
        """Common name of the devices."""
        return " and ".join(self.devices) or "imu"

    @property
    def verdict(self) -> Verdict | None:
        """How the run of the recording ended; None for data that no run of the station made."""
        outcome, _, reason = self.identity.get("outcome", "").partition(" ")
        return Verdict(Outcome(outcome), reason) if outcome in list(Outcome) else None

    @property
    def failure(self) -> list[str]:
        """One line that the run was no pass; [] if it was one, or no verdict is known."""
        ended = self.verdict
        if ended is None or ended.outcome in (Outcome.PASS, Outcome.ESTIMATED):
            return []
        return [f"the run did not pass: {ended.outcome} {ended.reason}"]

    @property
    def cautions(self) -> list[str]:
        """Reasons against using the calibration: that the run did not pass, and its notes."""
        return [*self.failure, *self.calibration.notes]

    @property
    def origin(self) -> list[str]:
        """Lines for the head of a file: which device was measured, how, and under which conditions."""
        values = {
            "exported": self,
            "state_figures": state_figures(self.units),
            "force_figures": FORCE_FIGURES,
        }
        return rendered("station.exports", "origin.txt", values).splitlines()


def exported_of(path: Path, devices: Sequence[str] = (), instance: int = 0, joined: Sequence[Path] = ()) -> Exported:
    """Return what is exported from a recording: gyros and accelerometers of ``devices``, or of all devices under test.

    It is in the axes of the device, however this was mounted on the table. With it are the identity, the correction,
    and the conditions of the calibration.
    ``instance`` is the number of the gyro in an autopilot. With ``joined``, recordings of the device in other
    mountings, it is the calibration of all of them, judged anew by the limits of ``path``. RecordingError if there is
    no calibration, ModelError or CompensationError for effects of another version, UsageError for a device that the
    recording does not have, for the file of an error model, or for an error model of a device that was turned on the
    table.
    """
    recording = _read(path)
    calibration = _joined(recording, joined) if joined else read_calibration(path, trusted=True)
    there = tuple(dict.fromkeys(gyro.device for gyro in calibration.gyros))
    for device in devices:
        if device not in there:
            raise UsageError(f"{path} has no calibrated device {device!r}; it has {', '.join(filter(None, there))}")
    gyros = tuple(gyro for gyro in calibration.gyros if not devices or gyro.device in devices)
    arrays = {name: data.own_array for name, data in recording.sources.items()}
    own_axes = {name: data.mounting.axes.T for name, data in recording.sources.items()}
    identity = _identity(path, recording, gyros)
    if joined:
        limits = read_limits(str(recording.attributes.get("bench", "")))
        verdict = judge_recorded(calibration, limits, None)
        identity["outcome"] = f"{verdict.outcome} {verdict.reason}"
        identity["joined with"] = ", ".join(f"{one.name} (sha256 {file_sha256(one)})" for one in joined)
    if calibration.model and any(not np.array_equal(axes, np.eye(3)) for axes in own_axes.values()):
        raise UsageError(sentence("export.mounted", recording=path))
    return Exported(
        path=path,
        identity=identity,
        calibration=calibration,
        gyros=gyros,
        compensation=Compensation.of(gyros, arrays, calibration.model),
        seen=seen_by(recording.sources[name] for name in {gyro.source: None for gyro in gyros}),
        devices=tuple(device for device in there if device and (not devices or device in devices)),
        instance=instance,
        units=_units_of(recording),
        forces=tuple(
            one.turned(own_axes[one.source]) for one in calibration.forces if not devices or one.device in devices
        ),
    )


def _joined(recording: Recording, others: Sequence[Path]) -> Calibration:
    """Return the joined calibration of recordings, each turned back to how the device was mounted in the first."""
    calibration = joined_of([recording, *map(_read, others)]).calibration
    forces = [one.turned(recording.sources[one.source].mounting.axes) for one in calibration.forces]
    return replace(calibration, forces=tuple(forces))


def _units_of(recording: Recording) -> Units:
    """Return in which units the bench file that a recording carries has states shown; the default ones without.

    These stand for a bench file that cannot be read, too.
    """
    with suppress(BenchError):
        return read_limits(str(recording.attributes.get("bench", ""))).units
    return Units()


def _read(path: Path) -> Recording:
    """Return the recording; UsageError if the file is the error model of a type, RecordingError for any other file."""
    try:
        return read_recording(path)
    except RecordingError:
        with suppress(EstimatorError):
            ErrorModel.read(path)
            raise UsageError(sentence("export.of_a_type", path=path)) from None
        raise


def _identity(path: Path, recording: Recording, gyros: Sequence[GyroCalibration]) -> dict[str, str]:
    """Return the identity of the gyros as texts of one line each, by name; empty ones are left out.

    It names device, model, serial number, operator, station, script, time, outcome, software, and the file ``path``
    with its hash. The device is that of the recording if no gyro names one.
    """
    attributes = recording.attributes
    with h5py.File(path, "r") as file:
        kinds = [_kind(file[f"imu/{gyro.source}"].attrs) for gyro in gyros]
    named = {
        "device": ", ".join(dict.fromkeys(gyro.device for gyro in gyros if gyro.device))
        or attributes.get("device", ""),
        "model": ", ".join(dict.fromkeys(filter(None, kinds))),
        "serial number": attributes.get("device_serial", ""),
        "operator": attributes.get("operator", ""),
        "station": attributes.get("station", ""),
        "script": attributes.get("script", ""),
        "measured (UTC)": _measured_utc(recording),
        "outcome": " ".join(str(attributes[key]) for key in ("outcome", "reason") if key in attributes),
        "software version": attributes.get("software_version", ""),
        "recording": path.name,
        "sha256 of the recording": file_sha256(path),
    }
    # One line each: texts of a file must not end the comment in which they stand.
    return {key: " ".join(str(value).split()) for key, value in named.items() if value}


def _measured_utc(recording: Recording) -> str:
    """Return when the first sample of any source was taken, UTC, ISO 8601, to the second.

    Empty in virtual time, for imports without a date, and for a start that is no valid time.
    """
    first_ns = min((int(data.t_ns[0]) for data in recording.sources.values() if len(data.t_ns)), default=0)
    with suppress(KeyError, TypeError, OverflowError, OSError, ValueError):
        utc_s = float(recording.attributes["clock_zero_utc_s"]) + first_ns * 1e-9
        return datetime.fromtimestamp(utc_s, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
    return ""


def _kind(attributes: Mapping[str, Any]) -> str:
    words = {"model": "{}", "serial": "serial {}", "firmware": "firmware {}"}
    return " ".join(word.format(attributes[key]) for key, word in words.items() if key in attributes)


def file_sha256(path: Path) -> str:
    """Return the hash of a whole file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def raw_sha256(path: Path) -> str:
    """Return the hash of the measured data, by ``RAW_RULE``: names and numbers of their datasets in order of name.

    Estimates and attributes do not change it.
    """
    found = hashlib.sha256()
    with h5py.File(path, "r") as file:
        names: list[str] = []

        def note(name: str, item: Any) -> None:
            if isinstance(item, h5py.Dataset) and name.partition("/")[0] in _RAW and item.dtype.kind in _NUMBERS:
                names.append(name)

        file.visititems(note)
        for name in sorted(names):
            values = file[name][()]
            found.update(f"/{name}\n".encode())
            found.update(np.ascontiguousarray(values.astype(values.dtype.newbyteorder("<"), copy=False)).data)
    return found.hexdigest()
