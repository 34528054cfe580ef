"""Reading of recordings in a separate process: a damaged HDF5 file can hang or kill it, not the screen."""

import json
import math
import os
import shutil
import tomllib
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py

from estimator.calibration.calibration_file import read_calibration
from estimator.errors import EstimatorError, RecordingError, first_line
from estimator.geometry.model import STATES
from estimator.recordings.probe import objects
from estimator.recordings.recording import FORMAT, FORMAT_VERSION
from estimator.recordings.recovery import recover
from estimator.recordings.writing import plain, write_attributes
from estimator.untrusted import read_json
from station.errors import BenchError
from station.screen.archive.entries import INVESTIGATION, Entry, Exceeded, ReadRecording
from station.screen.sessions.answers import InvestigationAnswer
from station.screen.sessions.live_run import Trend

if TYPE_CHECKING:
    from station.views.limits import LimitLine

_MOST_POINTS = 400
_TEXTS = ("station", "script", "outcome", "reason", "operator", "device_serial", "accepted_by", "accepted_utc")


def accept(path: Path, attributes: Mapping[str, str]) -> str:
    """Write attributes to a copy of the recording, which then replaces it; return what went wrong, "" if nothing.

    A failure, such as a full disk, leaves the recording unchanged. Run this in a process of its own: a failed write
    within HDF5 leaves it unusable.
    """
    path = path.resolve()  # a link to a recording stays one
    copy = path.with_name(f".{path.name}.{os.getpid()}.part")
    made = False
    try:
        with path.open("rb") as recording, copy.open("xb") as file:  # a link that stands there is not followed
            made = True
            shutil.copyfileobj(recording, file)
        shutil.copystat(path, copy)
        write_attributes(copy, attributes)
        with copy.open("rb+") as file:
            os.fsync(file.fileno())
        copy.replace(path)
    except (OSError, RecordingError) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error).rpartition("cannot be written: ")[2]
        return f"it cannot be written and is unchanged ({reason})"
    finally:
        if made:
            copy.unlink(missing_ok=True)
    return ""


def read(path: Path, when_utc_s: float, with_samples: bool) -> ReadRecording:
    """Return a recording, or only its entry unless ``with_samples``; if unreadable, ``entry.wrong`` says why. Never
    raises.

    ``when_utc_s`` is the time of its last change, used if the recording has no clock. A run that was cut off is
    recovered first, in the file, if that is possible. Another HDF5 file is ``foreign``; a recording of a later format
    is unreadable.
    """
    unread = Entry(str(path), when_utc_s)
    with suppress(RecordingError):  # of a run in progress, or in a write-protected place: shown unrecovered
        recover(path)
    try:
        # Without HDF5's locks: a session that writes the same file must never find it locked by a reader.
        with h5py.File(path, "r", locking=False) as file:
            list(objects(path, file, None if with_samples else _listed))  # which leads nowhere else, and can be held
            if plain(file.attrs.get("format")) != FORMAT:
                return ReadRecording(replace(unread, wrong="an HDF5 file, but not a recording", foreign=True))
            version = plain(file.attrs.get("format_version", 0))
            if not isinstance(version, int) or version > FORMAT_VERSION:
                wrong = f"format version {version}, this program reads up to {FORMAT_VERSION}: update it"
                return ReadRecording(replace(unread, wrong=wrong))
            entry = _entry(unread, file)
            if not with_samples:
                return ReadRecording(entry)
            whole, bench = _whole(entry, file), str(plain(file.attrs.get("bench", "")))
        return _judged(whole, bench)
    except Exception as error:  # a file made by hand may hold anything; the next one is still read
        wrong = f"it cannot be read: it is damaged or incomplete ({first_line(error)})"
        return ReadRecording(replace(unread, wrong=wrong))


def _listed(file: Any) -> list[str]:
    """Return the names of the groups and datasets that an entry needs."""
    figures = [f"calibration/{key}" for key in ("states", "sd", "name", "source")] if "calibration" in file else []
    return [".", *(f"imu/{source}" for source in file.get("imu", {}).keys()), *figures]  # noqa: SIM118 (no rows of data)


def _entry(unread: Entry, file: Any) -> Entry:
    """Return the entry of an open recording; ``unread`` has its path and the time of its last change.

    That time stays if the recording has no clock. Devices are those of its sources, each once, else that of the file.
    Without a calibration there are no figures, and neither then nor if it is not finite a mean NIS. ValueError for an
    impossible time.
    """
    began_utc_s = plain(file.attrs.get("clock_zero_utc_s"))
    if began_utc_s is not None and not 0 <= float(began_utc_s) < 2.5e11:  # later years have five digits
        raise ValueError(f"it began {began_utc_s} s after 1970")
    devices = [str(plain(source.attrs.get("device", ""))) for source in file.get("imu", {}).values()]
    rows: Iterable[Any] = ()
    nis_mean = None
    if (group := file.get("calibration")) is not None:
        nis_mean = float(plain(group.attrs.get("nis_mean", math.nan)))
        figures = (group[key][()].astype(float).reshape(-1, len(STATES)).tolist() for key in ("states", "sd"))
        rows = zip(
            *([str(plain(name)) for name in group[key][()]] for key in ("name", "source")), *figures, strict=True
        )
    return replace(
        unread,
        when_utc_s=unread.when_utc_s if began_utc_s is None else float(began_utc_s),
        texts={name: str(plain(file.attrs.get(name, ""))) for name in _TEXTS},
        devices=tuple(filter(None, dict.fromkeys(devices))) or (str(plain(file.attrs.get("device", ""))),),
        figures=json.dumps(list(rows)).encode(),
        units=_units(str(plain(file.attrs.get("bench", "")))),
        nis_mean=nis_mean if nis_mean is not None and math.isfinite(nis_mean) else None,
    )


def _units(bench: str) -> dict[str, str]:
    """Return the section [units] of a bench file's text; empty if there is none or it is invalid."""
    if "[units]" not in bench:
        return {}
    with suppress(tomllib.TOMLDecodeError):
        found = tomllib.loads(bench).get("units")
        return {str(key): str(unit) for key, unit in found.items()} if isinstance(found, dict) else {}
    return {}


def _whole(entry: Entry, file: Any) -> ReadRecording:
    """Return everything the result screen shows of an open recording, except the limits.

    Figures are left out without a calibration, the noise unless the calibration estimated it: its mean over the gyros.
    An investigation stored beside it is included.
    """
    found: dict[str, Any] = {}
    if (group := file.get("calibration")) is not None:
        found = {key: plain(group.attrs[key]) for key in ("samples", "lost", "nis_mean") if key in group.attrs}
        found |= {key: [str(plain(text)) for text in group.attrs.get(key, [])] for key in ("notes", "excluded")}
        if "noise" in group and "noise_below" in group:
            found["noise"] = float(group["noise"][:, 0].mean()), float(group["noise_below"][:, 0].mean())
    events = file.get("events")
    if events is not None and "text" in events:
        rows = zip(events["t_ns"][()], events["text"][()], strict=False)
        found["events"] = [(float(t) * 1e-9, plain(text)) for t, text in rows]
    return ReadRecording(
        entry,
        **found,
        attributes={name: plain(value) for name, value in file.attrs.items()},
        curves=_curves(file),
        investigation=_investigation(entry.path),
    )


def _judged(recording: ReadRecording, bench: str) -> ReadRecording:
    """Return the recording with the limits of its bench, and the broken ones if its recorded reason names the same.

    ``bench`` is the text of the bench file. The broken ones are in the order of ``worst_first``, those of no gyro
    first; what else the reason says becomes ``because``. What cannot be had is left as it is: limits if the bench file
    cannot be read, broken ones if the calibration cannot.
    """
    from station.bench.bench import read_limits  # with all drivers, which a list of recordings does without
    from station.views.limits import limit_lines, worst_first

    with suppress(EstimatorError, BenchError):
        limits = read_limits(bench)
        recording = replace(recording, sizes=limits.sizes, written=limits.written_sizes)
        found = limit_lines(read_calibration(recording.entry.path, trusted=True), limits)
        lines = [line for line in found if not line.within]
        before, named, after = recording.entry.texts["reason"].partition(
            "; ".join(line.broken for line in lines) or "\0"
        )
        if named:  # losses and noise first: they may explain the others
            broken = [_exceeded(line) for line in worst_first(lines)]
            because = [text.removeprefix("but ") for text in f"{before}{after}".split("; ") if text]
            recording = replace(recording, broken=broken, because=because)
    return recording


def _exceeded(line: "LimitLine") -> Exceeded:
    """Return a limit that was exceeded in words, with its place among gyros and states."""
    subject, found, bound, missed_by = line.cells
    return Exceeded(
        subject=subject,
        found=found,
        bound=bound,
        missed_by=missed_by,
        remedy=line.remedy,
        gyro=line.row,
        state=line.state,
        of_sigma=line.of_u,
    )


def _curves(file: Any) -> dict[str, Trend]:
    """Return the live estimates by full name of the gyro, thinned to less than 800 points; empty without any."""
    found = {}
    for source, estimate in file.get("estimate", {}).items():
        step = max(len(estimate["t_ns"]) // _MOST_POINTS, 1)
        t_ns, states, sds = (estimate[key][::step].tolist() for key in ("t_ns", "states", "sd"))
        t_s = [t * 1e-9 for t in t_ns]
        for number, name in enumerate(file[f"imu/{source}"].attrs.get("names", [source])):
            values, sigmas = ([tuple(row[number]) for row in rows] for rows in (states, sds))
            found[" ".join(dict.fromkeys((source, str(plain(name)))))] = Trend(t_s, values, sigmas)
    return found


def _investigation(recording: Path) -> InvestigationAnswer | None:
    """Return the newest investigation stored beside a recording; None if there is none, or it is damaged."""
    kept = recording.parent.glob(f"{recording.stem}{INVESTIGATION}*.h5")
    newest = max(kept, key=lambda path: path.stat().st_mtime, default=None)
    if newest is None:
        return None
    with suppress(OSError, RecordingError, KeyError, TypeError, ValueError), h5py.File(newest, locking=False) as file:
        list(objects(newest, file))
        return InvestigationAnswer.read(read_json(plain(file["investigation"].attrs["json"])))
    return None
