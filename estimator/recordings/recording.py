"""A recording in memory."""

import math
from collections.abc import Mapping
from dataclasses import astuple, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.geometry.array import SensorArray
from estimator.geometry.kinematics import Site
from estimator.geometry.model import ForcePrior, Prior
from estimator.geometry.noise import NoiseModel
from estimator.packaged import packaged_toml
from estimator.recordings.reference import Reference, TableReadings, Turns
from estimator.types import Floats, Stamps

FORMAT = "turntable-recording"
FORMAT_VERSION = 2
"""The newest version that this program reads. A file says 2 if it has ``accel_axes``, else 1, which older ones read."""
IDENTITY = "recording_id"
"""Attribute of a run's recording and of its journal: a number of the run, so that neither is taken for another's."""
DEVICES = "device"
"""The group of devices that are neither the table nor under test, and of what any device appends as a series."""
LAYOUT = packaged_toml("estimator.recordings", "layout.toml")
"""What each column of a recording is, in memory as in its file."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ForceSheet:
    """The data sheet of the accelerometers of a source: what is expected of their states and places, and their noise.

    The noise is in m/s2/rtHz, m/s2 and m/s2/rts.
    """

    prior: ForcePrior
    noise: NoiseModel

    @property
    def attributes(self) -> dict[str, tuple[float, ...]]:
        """Its values, as the attributes of a source in a file."""
        return {"accel_prior": astuple(self.prior), "accel_noise": astuple(self.noise)}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Mounting:
    """How a device is mounted: its own axes x, y, z as the rows of ``axes`` (3, 3), in the body that the table turns.

    ``sd_rad`` is the standard deviation of a further small rotation about each axis, NaN if it is not stated.
    """

    axes: Floats = field(default_factory=lambda: np.eye(3))
    sd_rad: float = math.nan

    @property
    def attributes(self) -> dict[str, Any]:
        """The attributes of a source in a file that state it: ``mounting`` (3, 3) and ``mounting_sd_rad``.

        The first is left out if the axes are the table's, the second if it is not finite.
        """
        found: dict[str, Any] = {}
        if not np.array_equal(self.axes, np.eye(3)):
            found["mounting"] = self.axes
        if math.isfinite(self.sd_rad):
            found["mounting_sd_rad"] = self.sd_rad
        return found


_IMPOSSIBLE_RPS = 1e8  # nor is it the count of a converter of 32 bits that was taken for deg/s


def possible(rate_rps: Floats) -> tuple[Floats, int]:
    """Return rates (n, m) with NaN for impossible ones, and the number of samples (rows) that have such."""
    if max(np.fmax.reduce(rate_rps, None, initial=0.0), -np.fmin.reduce(rate_rps, None, initial=0.0)) < _IMPOSSIBLE_RPS:
        return rate_rps, 0
    none = np.asarray(np.abs(rate_rps) >= _IMPOSSIBLE_RPS)
    return np.where(none, np.nan, rate_rps), int(none.any(axis=1).sum())


@dataclass(frozen=True, slots=True, eq=False, weakref_slot=True)
class ImuData:
    """Samples of one source: instants (n,), rates (n, m), and its other columns; ``lost`` counts lost and impossible
    ones.

    ``prior`` and ``noise`` are those of the data sheet; ``device`` is the device it belongs to. ``rate_hz`` is the
    nominal rate, None if not stated. ``accel_mps2`` (n, c) are the outputs of its accelerometers, ``accel_axes`` (c, 3)
    their axes in the body, None for the body axes. ``accel_sheet`` is their data sheet; None: they are
    not calibrated. ``mounting`` says how the device is mounted on the table.
    """

    array: SensorArray
    t_ns: Stamps
    rate_rps: Floats
    temperature_c: Floats | None = None
    accel_mps2: Floats | None = None
    counter: Stamps | None = None
    lost: int = 0
    prior: Prior = field(default_factory=Prior)
    noise: NoiseModel | None = None
    device: str = ""
    rate_hz: float | None = None
    accel_axes: Floats | None = None
    accel_sheet: ForceSheet | None = None
    mounting: Mounting = field(default_factory=Mounting)

    @property
    def own_array(self) -> SensorArray:
        """The gyros in the axes of the device, however it is mounted."""
        return self.array.turned(self.mounting.axes.T)

    @property
    def specific_force_mps2(self) -> Floats | None:
        """Specific force (n, 3) along the body axes, None without accelerometers.

        NaN in every sample in which one accelerometer gave no number, unless their axes are the body's.
        """
        if self.accel_mps2 is None or self.accel_axes is None:
            return self.accel_mps2
        return np.asarray(self.accel_mps2 @ np.linalg.pinv(self.accel_axes).T)

    def to_frame(self) -> Any:
        """Return a pandas.DataFrame of the samples over ``t_s``: rates in rad/s, each named as its gyro, and more.

        That is ``temperature_c``, and ``accel_x_mps2`` to ``accel_z_mps2`` along the body axes, where the source has
        them. ImportError without pandas.
        """
        from pandas import DataFrame, Index

        frame = DataFrame(self.rate_rps, Index(self.t_ns * 1e-9, name="t_s"), self.array.names)
        if self.temperature_c is not None:
            frame["temperature_c"] = self.temperature_c
        force_mps2 = self.specific_force_mps2
        if force_mps2 is not None:
            frame[["accel_x_mps2", "accel_y_mps2", "accel_z_mps2"]] = force_mps2
        return frame


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """A device's own measurements: columns (n,) by name at instants (n,), and the unit of each column."""

    t_ns: Stamps
    columns: Mapping[str, Floats]
    units: Mapping[str, str]

    def to_frame(self) -> Any:
        """Return a pandas.DataFrame over time in s, a column each. Needs pandas."""
        from pandas import DataFrame, Index

        return DataFrame(dict(self.columns), Index(self.t_ns * 1e-9, name="t_s"))


@dataclass(frozen=True, slots=True)
class KeptInnovations:
    """The innovations of a run's live filter: their normalised squares, summed, and the degrees of freedom.

    ``model_sha256`` is that of the text of the error model that the run began with, empty for none.
    """

    nis_sum: float
    dof: int
    model_sha256: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """One run, or one imported measurement. ``kept_innovations`` exist only for runs of the station.

    ``series`` are by the name of the device that appended them.
    """

    sources: Mapping[str, ImuData]
    reference: Reference
    site: Site | None = None
    attributes: Mapping[str, Any] = field(default_factory=dict)
    path: Path | None = None
    kept_innovations: KeptInnovations | None = None
    series: Mapping[str, Series] = field(default_factory=dict)

    @property
    def table(self) -> TableReadings | None:
        """The readings of the table; None if another reference says how the body moved."""
        return self.reference.table

    @property
    def turns(self) -> Turns | None:
        """The turns by stated angles, if these are the reference."""
        return self.reference.turns

    @property
    def several_files(self) -> bool:
        """Whether it was imported from several files: power may have been off between them."""
        return np.size(self.attributes.get("files_begin_s", ())) > 1

    def file_of(self, at_s: Floats) -> NDArray[np.intp]:
        """Return the number (n,) of the imported file that each instant is of; 0 where there is one."""
        begin_s = np.atleast_1d(np.asarray(self.attributes.get("files_begin_s", 0.0), dtype=np.float64))
        return np.maximum(np.searchsorted(begin_s, at_s, side="right") - 1, 0)

    @property
    def name(self) -> str:
        """File name, or "recording in memory"."""
        return self.path.name if self.path else "recording in memory"
