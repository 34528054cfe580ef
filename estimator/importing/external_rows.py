"""Rows of an external reference: attitudes, rates or angles in SI and body axes, and the reference from them."""

import numpy as np
from numpy.typing import NDArray

from estimator.errors import RecordingError
from estimator.importing.mapping.reference import Measured
from estimator.importing.table import Table
from estimator.recordings.reading import slopes_of
from estimator.recordings.reference import AttitudeReadings, RateReadings, Reference, TableReadings
from estimator.types import Floats, Stamps

_NORM_OFF = 0.05  # an attitude whose length is this far from 1 is a lost one
_MATRIX = 9  # columns of a rotation matrix
_LOST_STEPS = 3  # longer blanks, in usual steps: the motion in them is unknown
_LOST_NS = 150_000_000


ExternalRows = tuple[Floats, Floats]
"""Rows of the reference of one file: instants (rows,) from its first sample, and values (rows, c)."""


def reference_rows(reference: Measured, table: Table) -> Floats:
    """Return the rows of a reference in a file: attitudes (rows, 4) as w x y z, rates (rows, 3) or angles (rows, 1).

    Rates are in rad/s, angles in rad; values that are not known are NaN.
    Attitudes are body to reference, also where the columns are rotation matrices. They are scaled to length 1; those
    off by more than 5 % are NaN. RecordingError if no row is usable, or the columns have another width or length.
    """
    rows = table.values(reference.columns, f"[reference] column{'s' * (reference.kind != 'angle')}")
    if reference.columns.width == _MATRIX:
        rows = _quaternions(rows)
    if reference.kind == "attitude":
        length = np.linalg.norm(rows, axis=1, keepdims=True)
        rows = np.where(np.abs(length - 1) < _NORM_OFF, rows / np.where(length > 0, length, 1.0), np.nan)
    if not np.isfinite(rows).all(axis=1).any():
        raise RecordingError(f"{table.name} has no usable row of the reference. Check [reference] columns")
    return rows


def _quaternions(rows: Floats) -> Floats:
    """Return quaternions w x y z (n, 4) of rotation matrices (n, 9) in row order, NaN for invalid ones."""
    from scipy.spatial.transform import Rotation

    matrices = rows.reshape(-1, 3, 3)
    products = matrices @ matrices.transpose(0, 2, 1)
    off = np.abs(products - np.eye(3)).max(axis=(1, 2))
    right = (off < _NORM_OFF) & (np.linalg.det(np.nan_to_num(matrices)) > 0)
    found = np.full((len(rows), 4), np.nan)
    if right.any():
        found[right] = np.roll(Rotation.from_matrix(matrices[right]).as_quat(), 1, axis=1)
    return found


def external_reference(reference: Measured, t_ns: Stamps, rows: Floats) -> Reference:
    """Return the reference made of rows (k, c) at ``t_ns`` (k,), NaN where unknown, by the kind of ``reference``.

    Unknown rows of an angle are dropped, and of a rate those in short gaps; attitudes are kept as they are.
    """
    if reference.kind == "attitude":
        return AttitudeReadings(t_ns, rows)
    if reference.kind == "angle":
        return _encoder(reference.gimbal, t_ns, rows[:, 0])
    whole = np.asarray(np.isfinite(rows).all(axis=1))
    keep = whole | _in_long_gaps(t_ns, whole)
    return RateReadings(t_ns[keep], rows[keep])


def _encoder(gimbal: str, t_ns: Stamps, angle_rad: Floats) -> TableReadings:
    """Return an encoder's angle (k,) as a table of one axis: its slope is the rate, its turns are counted.

    Rows that are not finite are dropped.
    """
    known = np.isfinite(angle_rad)
    t_ns, angle = t_ns[known], np.unwrap(angle_rad[known])[:, None]
    return TableReadings(
        t_ns=t_ns, angle_rad=angle, rate_rps=slopes_of(t_ns, angle), gimbals=(gimbal,), own_rates=False
    )


def _in_long_gaps(t_ns: Stamps, complete: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return as flags (k,) which rows are in gaps between complete ones that are too long to be filled.

    ``complete`` (k,) marks complete rows. Gaps count above three usual steps and 150 ms; none with fewer than two
    complete rows.
    """
    known = t_ns[complete]
    if len(known) < 2:
        return np.zeros(len(t_ns), dtype=bool)
    after = np.clip(np.searchsorted(known, t_ns), 1, len(known) - 1)
    gap = known[after] - known[after - 1]
    return np.asarray(~complete & (gap > max(_LOST_STEPS * float(np.median(np.diff(known))), _LOST_NS)))
