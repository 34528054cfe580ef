"""A recording read from its HDF5 file."""

import math
from collections.abc import Callable, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeVar, cast

import h5py
import numpy as np
from numpy.typing import NDArray

from estimator.errors import MISSHAPEN, GeometryError, RecordingError, first_line
from estimator.geometry.array import TOLERANCE, SensorArray, sensor_array
from estimator.geometry.kinematics import Site, check_gimbals
from estimator.geometry.model import ForcePrior, Prior
from estimator.geometry.noise import NoiseModel
from estimator.packaged import sentence
from estimator.recordings.memory import READING, check_memory
from estimator.recordings.recording import (
    DEVICES,
    FORMAT,
    FORMAT_VERSION,
    LAYOUT,
    ForceSheet,
    ImuData,
    KeptInnovations,
    Mounting,
    Recording,
    Series,
    possible,
)
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
from estimator.types import Floats, Stamps

T = TypeVar("T")
_SLOPE_S = 0.05  # to each side, over which an angle gives its rate
_REFERENCES: dict[str, Any] = {"turn_rad": Turns, "up": Poses, "rate_rps": RateReadings}
"""References by the column that only they have, in the order of looking; else they are attitudes."""


def read_recording(path: Path | str, *, trusted: bool = False) -> Recording:
    """Return a recording, completed from its journal if its run died.

    ``trusted``: this process has just closed it, so it is neither completed nor first tried in another process.
    RecordingError, with what is missing or wrong, for a file that is not of the format or too large for the memory.
    """
    path = Path(path)
    if path.is_dir():
        raise RecordingError(f"{path} is not a file but a folder. Give a recording in it")
    if not trusted:
        recover(path)
        probe(path)
    return _read_opened(path, _recording_in)


def read_attributes(path: Path | str) -> dict[str, Any]:
    """Return the attributes of a recording, also of one that is too incomplete to be read.

    It is first completed from its journal, and read as a whole in another process (``probe``). RecordingError for a
    file that is not of the format.
    """
    path = Path(path)
    recover(path)
    probe(path)
    return _read_opened(path, _attributes)


def file_format(path: Path | str) -> str:
    """Return the attribute "format" of an HDF5 file: ``FORMAT`` for a recording, "" if it has none.

    The whole file is first read in another process (``probe``). RecordingError for one that cannot be read.
    """
    path = Path(path)
    probe(path)
    return _read_opened(path, lambda _, file: str(plain(file.attrs.get("format", ""))))


def _read_opened(path: Path, read: Callable[[Path, Any], T]) -> T:
    """Return ``read(path, file)`` for the opened file; RecordingError if it cannot be read, or is laid out
    differently.
    """
    try:
        with h5py.File(path, "r") as file:
            return read(path, file)
    except OSError as error:
        raise RecordingError(f"{path} cannot be read: {first_line(error)}") from None
    except MISSHAPEN as error:  # a file made by hand can hold anything
        raise RecordingError(f"{path} is not laid out as a recording: {first_line(error)}") from None


def _attributes(path: Path, file: Any) -> dict[str, Any]:
    """Return the attributes of an open recording as plain values; ``path`` is for messages.

    RecordingError for another format, no version or a newer one.
    """
    attributes = {key: plain(value) for key, value in file.attrs.items()}
    if attributes.get("format") != FORMAT:
        raise RecordingError(sentence("recordings.no_recording", path=path, format=FORMAT))
    version = attributes.get("format_version")
    if not isinstance(version, (int, np.integer)) or version > FORMAT_VERSION:
        raise RecordingError(sentence("recordings.newer", path=path, version=version, ours=FORMAT_VERSION))
    return attributes


def _recording_in(path: Path, file: Any) -> Recording:
    """Return the recording in an open file, whose ``path`` is for messages.

    RecordingError if it is of another format, has no source or no reference, holds invalid columns or needs too much
    memory. A source may have no rows.
    """
    attributes = _attributes(path, file)
    groups = (*file.get("imu", {}).values(), file.get("table", {}))
    columns = [group[key] for group in groups for key in group if "dimensions" in LAYOUT.get(key, {})]
    check_memory(path, sum(8 * int(column.size or 0) for column in columns), READING)
    site = None
    if "site_latitude_rad" in attributes:
        stated = attributes.get("site_gravity_mps2")
        site = Site(
            latitude_rad=float(attributes["site_latitude_rad"]),
            heading_rad=float(attributes.get("site_heading_rad", 0.0)),
            height_m=float(attributes.get("site_height_m", 0.0)),
            gravity_mps2=None if stated is None else float(stated),
        )
    sources = {name: _read_source(path, name, group) for name, group in file.get("imu", {}).items()}
    if not sources:
        raise RecordingError(f"{path} holds no IMU samples (group /imu is missing or empty)")
    kept = _read_innovations(file, str(attributes.get("model_sha256", "")))
    reference, series = _read_reference(path, file), _read_series(path, file)
    return Recording(sources, reference, site, attributes, path, kept_innovations=kept, series=series)


def _read_innovations(file: Any, model_sha256: str) -> KeptInnovations | None:
    """Return the live filter's innovations, summed over all blocks and sources; None if none are stored.

    ``model_sha256``, that of the error model of the run, is kept with them.
    """
    groups = [group for group in file.get("innovation", {}).values() if "nis" in group and "dof" in group]
    if not groups:
        return None
    total, dof = 0.0, 0
    for group in groups:
        n = min(len(group["nis"]), len(group["dof"]))  # a run cut between two datasets of one flush
        total += float(np.sum(group["nis"][:n], dtype=np.float64))
        dof += int(np.sum(group["dof"][:n]))
    return KeptInnovations(total, dof, model_sha256)


def _read_series(path: Path, file: Any) -> dict[str, Series]:
    """Return the series of devices by name; columns are cut to the shortest. Devices without a series are left out.

    RecordingError if declared columns or units are missing, or a column has several numbers a row.
    """
    found = {}
    for name, group in file.get(DEVICES, {}).items():
        where = f"{path}: /{DEVICES}/{name}"
        names = [str(plain(column)) for column in group.attrs.get("columns", ())]
        units = [str(plain(unit)) for unit in group.attrs.get("units", ())]
        if not names or "t_ns" not in group:  # it has none, or the run ended before its first row
            continue
        if len(units) != len(names) or not set(names) <= set(group):
            raise RecordingError(f"{where} does not hold the columns that it names, each with its unit")
        t_ns = _column(where, group, "t_ns")
        columns = {column: np.asarray(group[column][()], dtype=np.float64) for column in names}
        if any(values.ndim != 1 for values in columns.values()):
            raise RecordingError(f"{where}: a column of a series has one number a row")
        n = min(len(t_ns), *map(len, columns.values()))  # a run cut between two data sets of one flush
        cut = {column: values[:n] for column, values in columns.items()}
        found[name] = Series(t_ns[:n], cut, dict(zip(names, units, strict=True)))
    return found


def _read_source(path: Path, name: str, group: Any) -> ImuData:
    """Return the samples of one source in its group; columns are cut to the shortest.

    Impossible rates become NaN and count as lost. A nominal rate that is not above 0 counts as not stated (None); a
    missing prior is ``Prior()``, missing noise None. RecordingError if columns are missing or do not fit the axes, or
    mounting or data sheet is invalid.
    """
    where = f"{path}: /imu/{name}"
    present = ["t_ns", "rate_rps", *(key for key in ("temperature_c", "accel_mps2", "counter") if key in group)]
    columns = {key: _column(where, group, key) for key in present}
    n = min(map(len, columns.values()))  # a run cut between two datasets of one flush
    columns = {key: values[:n] for key, values in columns.items()}
    m = columns["rate_rps"].shape[1]
    array = read_array(where, name, group)
    if len(array) != m:
        raise RecordingError(f"{where} has {m} channels but {len(array)} sense axes")
    accel_axes = _axes(group, "accel_axes")
    if accel_axes is not None and "accel_mps2" in columns:
        _check_accelerometers(where, columns["accel_mps2"], accel_axes)
    prior = Prior(*(float(v) for v in group.attrs["prior"])) if "prior" in group.attrs else Prior()
    noise = NoiseModel(*(float(v) for v in group.attrs["noise"])) if "noise" in group.attrs else None
    device, lost = str(plain(group.attrs.get("device", ""))), int(group.attrs.get("lost", 0))
    columns["rate_rps"], impossible = possible(columns["rate_rps"])
    rate_hz = float(group.attrs.get("rate_hz", 0.0))
    return ImuData(
        array,
        lost=lost + impossible,
        prior=prior,
        noise=noise,
        device=device,
        rate_hz=rate_hz if 0 < rate_hz < math.inf else None,
        accel_axes=accel_axes,
        accel_sheet=_read_sheet(where, group),
        mounting=_read_mounting(where, group),
        **cast(Any, columns),
    )


def _read_mounting(where: str, group: Any) -> Mounting:
    """Return how the device of a source is mounted, along the table's axes if it is not stated; RecordingError if
    invalid.
    """
    axes = _axes(group, "mounting")
    sd_rad = float(group.attrs.get("mounting_sd_rad", math.nan))
    if axes is None:
        return Mounting(sd_rad=sd_rad)
    if axes.shape != (3, 3) or np.abs(axes @ axes.T - np.eye(3)).max() > TOLERANCE or np.linalg.det(axes) < 0:
        raise RecordingError(f"{where}: mounting must have three axes at right angles, right-handed; it is {axes}")
    return Mounting(axes=axes, sd_rad=sd_rad)


def _read_sheet(where: str, group: Any) -> ForceSheet | None:
    """Return the data sheet of the accelerometers of a source; RecordingError if invalid.

    None unless the source states both their prior and their noise.
    """
    if "accel_prior" not in group.attrs or "accel_noise" not in group.attrs:
        return None
    names = [field.name for field in fields(ForcePrior)]
    values = _sheet_values(where, group, "accel_prior", names)
    if min(values) <= 0:
        raise RecordingError(f"{where}: accel_prior has {', '.join(names)}, each above 0; it is {values}")
    noise = _sheet_values(where, group, "accel_noise", [field.name for field in fields(NoiseModel)])
    if min(noise) < 0:
        raise RecordingError(f"{where}: accel_noise holds no negative values; it is {noise}")
    return ForceSheet(prior=ForcePrior(**dict(zip(names, values, strict=True))), noise=NoiseModel(*noise))


def _sheet_values(where: str, group: Any, key: str, names: Sequence[str]) -> list[float]:
    """Return the numbers of the attribute ``key`` of a group, one for each of ``names``.

    RecordingError, which begins with ``where``, if it is missing, has more or fewer, or they are not finite.
    """
    try:
        values = np.asarray(group.attrs[key], dtype=np.float64).ravel()
    except (TypeError, ValueError):
        values = np.empty(0)
    if len(values) != len(names) or not np.isfinite(values).all():
        raise RecordingError(f"{where}: {key} must have {len(names)} numbers: {', '.join(names)}")
    return [float(value) for value in values]


def read_array(where: str, name: str, group: Any) -> SensorArray:
    """Return the array of a source from its group; gyros without names are named after the source and numbered.

    RecordingError, which begins with ``where``, if axes are missing or impossible.
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


def _check_accelerometers(where: str, accel_mps2: Floats, axes: Floats) -> None:
    """Raise RecordingError unless outputs (n, c) and axes (c, 3) determine the specific force along every body axis."""
    channels = accel_mps2.shape[1] if accel_mps2.ndim == 2 else 1
    if axes.shape != (channels, 3):
        raise RecordingError(f"{where} has {channels} accelerometers, but accel_axes of the shape {axes.shape}")
    if not np.isfinite(axes).all() or np.linalg.matrix_rank(axes) < 3:
        raise RecordingError(f"{where}: accel_axes do not span all directions")


def _axes(group: Any, key: str) -> Floats | None:
    value = group.attrs[key] if key in group.attrs else group[key][()] if key in group else None
    return None if value is None else np.atleast_2d(np.asarray(value, dtype=np.float64))


def _read_reference(path: Path, file: Any) -> Reference:
    """Return the reference in an open file: readings of a table, else another instrument's rates, attitudes, turns or
    poses.

    Of a table, columns are cut to the shortest and put in the order of the gimbals, readings that are not finite
    dropped, missing rates derived from angles. Turns without uncertainties get 0. RecordingError if there is no
    reference, or it is invalid.
    """
    if "table" in file:
        where, group = f"{path}: /table", file["table"]
        axes = [str(plain(a)) for a in group.attrs.get("axes", [])]
        gimbals = check_gimbals([str(plain(a)) for a in group.attrs.get("gimbals", axes)])
        if sorted(axes) != sorted(gimbals):
            raise RecordingError(f"{where}: attribute axes {axes} does not name the gimbals {list(gimbals)}")
        if "t_ns" not in group:
            raise RecordingError(f"{where} holds no readings, since the run ended before its script began")
        order = [axes.index(g) for g in gimbals]
        t_ns, angle = (_column(where, group, key) for key in ("t_ns", "angle_rad"))
        has_rates = "rate_rps" in group
        n = min(len(t_ns), len(angle), len(group["rate_rps"]) if has_rates else len(t_ns))
        if n < 2 or angle.shape[1] != len(axes):
            raise RecordingError(f"{where} needs two or more rows and one column per axis")
        window_ns = int(group.attrs.get("rate_window_ns", 0))
        width = _half_widths(where, group, n)
        if has_rates:
            rate = _column(where, group, "rate_rps")
        else:
            known = np.isfinite(angle[:n]).all(axis=1)
            t_ns, angle = t_ns[:n][known], angle[:n][known]
            width = None if width is None else width[known]
            n = len(t_ns)
            if n < 2:
                raise RecordingError(f"{where} holds fewer than two valid angles")
            rate, window_ns = _means_of(t_ns, angle)
        if rate.shape[1] != len(axes):
            raise RecordingError(f"{where} needs two or more rows and one column per axis")
        finite = np.isfinite(angle[:n]).all(axis=1) & np.isfinite(rate[:n]).all(axis=1)
        keys = [f.name for f in fields(TableUncertainty) if f"u_{f.name}" in group.attrs]
        stated = TableUncertainty(**{key: float(group.attrs[f"u_{key}"]) for key in keys}) if keys else None
        # An import makes its rates of an encoder's angles.
        own_rates = has_rates and "imported_from" not in file.attrs
        return TableReadings(
            t_ns=t_ns[:n][finite],
            angle_rad=angle[:n, order][finite],
            rate_rps=rate[:n, order][finite],
            gimbals=gimbals,
            uncertainty=stated,
            half_width_ns=None if width is None else width[finite],
            rate_window_ns=window_ns,
            own_rates=own_rates,
        )
    if "reference" not in file:
        raise RecordingError(f"{path} has neither /table nor /reference, so the motion of the body is unknown")
    where, group = f"{path}: /reference", file["reference"]
    kind: Any = next((kind for mark, kind in _REFERENCES.items() if mark in group), AttitudeReadings)
    missing = {"sd_rad"} - set(group) if kind is Turns else set()
    values = {f.name: _column(where, group, f.name) for f in fields(kind) if f.name not in missing}
    reference: Reference = kind(**values, **{name: np.zeros(len(values["turn_rad"])) for name in missing})
    return reference


def _half_widths(where: str, group: Any, n: int) -> Stamps | None:
    """Return the half widths (n,) in ns of readings, the last repeated if there are fewer; None if not stated."""
    if "half_width_ns" not in group:
        return None
    width = _column(where, group, "half_width_ns")[:n]
    return np.pad(width, (0, n - len(width)), mode="edge")


def _means_of(t_ns: Stamps, angle_rad: Floats) -> tuple[Floats, int]:
    """Return mean rates (k, axes) derived from the angles (k, axes), and the length in ns of the means, about 50 ms.

    Each is the mean before its instant, over less at the beginning; k is at least 2. A single axis gets slopes at
    instants instead, and length 0: it is compared by its angles, and its rates only show the motion.
    """
    if angle_rad.shape[1] == 1:
        return slopes_of(t_ns, np.unwrap(angle_rad, axis=0)), 0
    step_ns = max(float(np.median(np.diff(t_ns))), 1.0)
    rows = max(round(_SLOPE_S * 1e9 / step_ns), 1)
    angle = np.unwrap(angle_rad, axis=0)
    before = np.maximum(np.arange(len(t_ns)) - rows, 0)
    seconds = np.maximum(t_ns - t_ns[before], 1) * 1e-9
    rate = (angle - angle[before]) / seconds[:, None]
    rate[0] = rate[1]
    return rate, round(rows * step_ns)


def slopes_of(t_ns: Stamps, angle_rad: Floats) -> Floats:
    """Return rates (k, axes) as slopes of angles (k, axes) over 50 ms to each side, or 1.5 readings if that is longer.

    At the ends the side that is missing is left out. Angles must not jump by turns.
    """
    t_s = np.asarray((t_ns - t_ns[0]) * 1e-9, dtype=np.float64)
    half_s = max(_SLOPE_S, 1.5 * float(np.median(np.diff(t_s))) if len(t_s) > 1 else 0.0)
    before = np.maximum(t_s - half_s, t_s[0])
    after = np.minimum(t_s + half_s, t_s[-1])
    turned = [np.interp(after, t_s, angle) - np.interp(before, t_s, angle) for angle in angle_rad.T]
    return np.asarray(np.column_stack(turned) / np.maximum(after - before, 1e-9)[:, None])


def _column(where: str, group: Any, key: str) -> NDArray[Any]:
    """Return the column ``key`` of a group with the type and dimensions of ``LAYOUT``.

    RecordingError, which begins with ``where``, if it is missing, not numeric or of other dimensions. One
    dimension (n,) where two are due becomes (n, 1).
    """
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
