"""A process that reads recordings for the screen: a damaged HDF5 file can hang or kill its reader, not the screen.

Requests are lines of JSON on stdin, {"do": "entry" | "whole" | "accept", "path": ...}; each is answered by one line.
"""

import json
import math
import os
import shutil
import sys
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import h5py

from estimator.errors import RecordingError, first_line
from estimator.recordings.recording import FORMAT, FORMAT_VERSION
from estimator.recordings.writing import plain, write_attributes
from station.screen.archive.archive import INVESTIGATION

_MOST_POINTS = 400
_TEXTS = (
    "station",
    "script",
    "outcome",
    "reason",
    "operator",
    "device_serial",
    "device",
    "accepted_by",
    "accepted_utc",
    "ended_early",
    "software_version",
)


def main() -> None:
    """Answer requests until stdin ends."""
    for line in sys.stdin:
        request = json.loads(line)
        try:
            answer = _answer(request)
        except Exception as error:  # whatever a file made by hand holds, the next one is to be read
            answer = {"wrong": f"it cannot be read, it is damaged or not whole ({first_line(error)})"}
        print(json.dumps(answer), flush=True)


def _answer(request: Mapping[str, Any]) -> dict[str, Any]:
    path = Path(request["path"])
    if request["do"] == "accept":
        return _accept(path, request["attributes"])
    # Without HDF5's locks: a session that writes the same file must never find it locked by a reader.
    with h5py.File(path, "r", locking=False) as file:
        version = _version(file)
        if version is None:
            return {"wrong": "an HDF5 file, but no recording", "foreign": True}
        if not isinstance(version, int) or version > FORMAT_VERSION:
            return {"wrong": f"format version {version}, this program reads up to {FORMAT_VERSION}: update it"}
        found = _entry(file)
        if request["do"] == "whole":
            found |= _whole(file) | {"investigation": _investigation(path)}
    found["modified_utc_s"] = path.stat().st_mtime
    return found


def _accept(path: Path, attributes: Mapping[str, str]) -> dict[str, Any]:
    """Write attributes into a copy that then takes the recording's place: a full disk in between costs nothing.

    A write that fails within HDF5 leaves a file that cannot be opened any more.
    """
    path = path.resolve()  # a link to a recording stays one
    copy = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        shutil.copy2(path, copy)
        write_attributes(copy, attributes)
        with copy.open("rb+") as file:
            os.fsync(file.fileno())
        copy.replace(path)
    except (OSError, RecordingError) as error:
        said = error.strerror if isinstance(error, OSError) else str(error).rpartition("cannot be written: ")[2]
        return {"wrong": f"it cannot be written, and is as it was ({said})"}
    finally:
        copy.unlink(missing_ok=True)
    return {"accepted": True}


def _version(file: Any) -> Any:
    """Return the format's version, None if the file is of another format."""
    is_recording = plain(file.attrs.get("format")) == FORMAT
    return plain(file.attrs.get("format_version", 0)) if is_recording else None


def _entry(file: Any) -> dict[str, Any]:
    found: dict[str, Any] = {name: str(plain(file.attrs.get(name, ""))) for name in _TEXTS}
    began = plain(file.attrs.get("clock_zero_utc_s"))
    found["began_utc_s"] = float(began) if began is not None else None
    sources = file.get("imu", {})
    devices = [str(plain(sources[name].attrs.get("device", ""))) for name in sources]
    found["devices"] = [device for device in dict.fromkeys(devices) if device] or [found["device"]]
    found["gyros"] = []
    group = file.get("calibration")
    if group is not None:
        rows = zip(*(group[name][()] for name in ("name", "source", "states", "sd", "noise_rps")), strict=True)
        found["gyros"] = [
            {
                "name": plain(name),
                "source": plain(source),
                "states": list(map(_number, states)),
                "sd": list(map(_number, sd)),
                "noise_rps": _number(noise),
            }
            for name, source, states, sd, noise in rows
        ]
    return found


def _whole(file: Any) -> dict[str, Any]:
    found: dict[str, Any] = {"limits": _limits(str(plain(file.attrs.get("bench", "")))), "events": [], "curves": {}}
    group = file.get("calibration")
    if group is not None:
        found |= {key: plain(group.attrs.get(key)) for key in ("samples", "lost")}
        found["nis_mean"] = _number(group.attrs.get("nis_mean", math.nan))
        for key in ("notes", "excluded"):
            found[key] = [str(plain(text)) for text in group.attrs.get(key, [])]
    events = file.get("events")
    if events is not None and "text" in events:
        rows = zip(events["t_ns"][()], events["text"][()], strict=False)
        found["events"] = [[float(t) * 1e-9, plain(text)] for t, text in rows]
    for source, estimate in file.get("estimate", {}).items():
        names = [str(plain(name)) for name in file[f"imu/{source}"].attrs.get("names", [source])]
        step = max(len(estimate["t_ns"]) // _MOST_POINTS, 1)
        t_s = [float(t) * 1e-9 for t in estimate["t_ns"][::step]]
        states, sd = estimate["states"][::step], estimate["sd"][::step]
        for number, name in enumerate(names):
            found["curves"][name] = {"t_s": t_s, "states": _rows(states[:, number]), "sd": _rows(sd[:, number])}
    return found


def _investigation(recording: Path) -> Any:
    """Return what the newest investigation that is kept beside a recording found, null if there is none."""
    kept = sorted(recording.parent.glob(f"{recording.stem}{INVESTIGATION}*.h5"), key=lambda path: path.stat().st_mtime)
    if not kept:
        return None
    with h5py.File(kept[-1], "r", locking=False) as file:
        return json.loads(plain(file["investigation"].attrs["json"]))


def _limits(bench: str) -> dict[str, float | None]:
    from station.bench.bench import read_limits
    from station.errors import BenchError

    try:
        return {key: _number(value) for key, value in asdict(read_limits(bench)).items()}
    except BenchError:
        return {}


def _rows(values: Any) -> list[list[float | None]]:
    return [list(map(_number, row)) for row in values]


def _number(value: Any) -> float | None:
    found = float(value)
    return found if math.isfinite(found) else None


if __name__ == "__main__":
    main()
