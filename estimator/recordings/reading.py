"""A recording read from its HDF5 file."""

from dataclasses import fields
from pathlib import Path
from typing import Any, cast

import h5py
import numpy as np
from numpy.typing import NDArray

from estimator.errors import MISSHAPEN, GeometryError, RecordingError, first_line
from estimator.geometry.array import SensorArray, sensor_array
from estimator.geometry.kinematics import Site, check_gimbals
from estimator.geometry.model import Prior
from estimator.geometry.noise import NoiseModel
from estimator.packaged import sentence
from estimator.recordings.memory import READING, check_memory
from estimator.recordings.recording import FORMAT, FORMAT_VERSION, LAYOUT, ImuData, Recording, possible
from estimator.recordings.recovery import recover
from estimator.recordings.reference import (
    AttitudeReadings,
    Poses,
    RateReadings,
    Reference,
    TableReadings,
    TableUncertainty,
    Turns,
)
from estimator.recordings.safe_open import probe
from estimator.recordings.writing import plain
from estimator.types import Floats

_REFERENCES: dict[str, Any] = {"turn_rad": Turns, "up": Poses, "rate_rps": RateReadings}
"""References by the column that only they have, in the order of looking; else they are attitudes."""


def read_recording(path: Path | str, *, trusted: bool = False) -> Recording:
    """Read a recording, made whole from its journal if its run died; ``trusted``: this process has just closed it.

    Raises RecordingError, with what is missing or wrong, for a file that is not of the format.
    """
    path = Path(path)
    if not trusted:
        recover(path)
        probe(path)
    try:
        with h5py.File(path, "r") as file:
            return _read(path, file)
    except OSError as error:
        raise RecordingError(f"{path} cannot be read: {first_line(error)}") from None
    except MISSHAPEN as error:  # a file made by hand can hold anything
        raise RecordingError(f"{path} is not laid out as a recording: {first_line(error)}") from None


def _read(path: Path, file: Any) -> Recording:
    attributes = {key: plain(value) for key, value in file.attrs.items()}
    if attributes.get("format") != FORMAT:
        raise RecordingError(sentence("recordings.no_recording", path=path, format=FORMAT))
    version = attributes.get("format_version")
    if not isinstance(version, (int, np.integer)) or version > FORMAT_VERSION:
        raise RecordingError(sentence("recordings.newer", path=path, version=version, ours=FORMAT_VERSION))
    groups = (*file.get("imu", {}).values(), file.get("table", {}))
    columns = [group[key] for group in groups for key in group if "dimensions" in LAYOUT.get(key, {})]
    check_memory(path, sum(8 * int(column.size or 0) for column in columns), READING)
    site = None
    if "site_latitude_rad" in attributes:
        site = Site(float(attributes["site_latitude_rad"]), float(attributes.get("site_heading_rad", 0.0)))
    sources = {name: _read_source(path, name, group) for name, group in file.get("imu", {}).items()}
    if not sources:
        raise RecordingError(f"{path} holds no IMU samples (group /imu is missing or empty)")
    return Recording(sources, _read_reference(path, file), site, attributes, path)


def _read_source(path: Path, name: str, group: Any) -> ImuData:
    where = f"{path}: /imu/{name}"
    present = ["t_ns", "rate_rps", *(key for key in ("temperature_c", "accel_mps2", "counter") if key in group)]
    columns = {key: _column(where, group, key) for key in present}
    n = min(map(len, columns.values()))  # a run cut between two datasets of one flush
    columns = {key: values[:n] for key, values in columns.items()}
    m = columns["rate_rps"].shape[1]
    array = read_array(where, name, group)
    if len(array) != m:
        raise RecordingError(f"{where} has {m} channels but {len(array)} sense axes")
    prior = Prior(*(float(v) for v in group.attrs["prior"])) if "prior" in group.attrs else Prior()
    noise = NoiseModel(*(float(v) for v in group.attrs["noise"])) if "noise" in group.attrs else None
    device, lost = str(plain(group.attrs.get("device", ""))), int(group.attrs.get("lost", 0))
    columns["rate_rps"], impossible = possible(columns["rate_rps"])
    return ImuData(array, lost=lost + impossible, prior=prior, noise=noise, device=device, **cast(Any, columns))


def read_array(where: str, name: str, group: Any) -> SensorArray:
    """Return the array of a source from its group; without names its gyros are called by the source, and numbered.

    RecordingError, which says ``where``, if there are no axes or impossible ones.
    """
    axes = {key: _axes(group, key) for key in "pjk"}
    if axes["p"] is None:
        raise RecordingError(f"{where} has no sense axes p")
    n = len(axes["p"])
    counted = [name] if n == 1 else [f"{name}{i + 1}" for i in range(n)]
    labels = [str(plain(x)) for x in group.attrs.get("names", counted)]
    try:
        return sensor_array(axes["p"], axes["j"], axes["k"], names=labels, part_of_array=True)
    except GeometryError as error:
        raise RecordingError(f"{where}: {error}") from None


def _axes(group: Any, key: str) -> Floats | None:
    value = group.attrs[key] if key in group.attrs else group[key][()] if key in group else None
    return None if value is None else np.atleast_2d(np.asarray(value, dtype=np.float64))


def _read_reference(path: Path, file: Any) -> Reference:
    if "table" in file:
        where, group = f"{path}: /table", file["table"]
        axes = [str(plain(a)) for a in group.attrs.get("axes", [])]
        gimbals = check_gimbals([str(plain(a)) for a in group.attrs.get("gimbals", axes)])
        if sorted(axes) != sorted(gimbals):
            raise RecordingError(f"{where}: attribute axes {axes} does not name the gimbals {list(gimbals)}")
        if "t_ns" not in group:
            raise RecordingError(f"{where} holds no readings: the run ended before its script began")
        order = [axes.index(g) for g in gimbals]
        t_ns, angle, rate = (_column(where, group, key) for key in ("t_ns", "angle_rad", "rate_rps"))
        n = min(len(t_ns), len(angle), len(rate))
        if n < 2 or angle.shape[1] != len(axes) or rate.shape[1] != len(axes):
            raise RecordingError(f"{where} needs two rows or more and one column an axis")
        finite = np.isfinite(angle[:n]).all(axis=1) & np.isfinite(rate[:n]).all(axis=1)
        keys = [f.name for f in fields(TableUncertainty) if f"u_{f.name}" in group.attrs]
        stated = TableUncertainty(**{key: float(group.attrs[f"u_{key}"]) for key in keys}) if keys else None
        width = None
        if "half_width_ns" in group:
            width = _column(where, group, "half_width_ns")
            width = np.pad(width[:n], (0, max(n - len(width), 0)), mode="edge")[finite]
        rows = t_ns[:n][finite], angle[:n, order][finite], rate[:n, order][finite]
        return TableReadings(*rows, gimbals, stated, width, int(group.attrs.get("rate_window_ns", 0)))
    if "reference" not in file:
        raise RecordingError(f"{path} has neither /table nor /reference: nothing says how the body turned")
    where, group = f"{path}: /reference", file["reference"]
    kind: Any = next((kind for mark, kind in _REFERENCES.items() if mark in group), AttitudeReadings)
    missing = {"sd_rad"} - set(group) if kind is Turns else set()
    values = {f.name: _column(where, group, f.name) for f in fields(kind) if f.name not in missing}
    reference: Reference = kind(**values, **{name: np.zeros(len(values["turn_rad"])) for name in missing})
    return reference


def _column(where: str, group: Any, key: str) -> NDArray[Any]:
    dimensions = LAYOUT[key]["dimensions"]
    if key not in group:
        raise RecordingError(f"{where} has no {key}")
    try:
        values = np.asarray(group[key][()]).astype(LAYOUT[key]["type"])
    except (TypeError, ValueError):
        raise RecordingError(f"{where}/{key} is not numeric") from None
    if dimensions == 2 and values.ndim == 1:
        values = values[:, None]
    if dimensions and values.ndim != dimensions:
        raise RecordingError(f"{where}/{key} must have {dimensions} dimensions, it has {values.ndim}")
    return values
