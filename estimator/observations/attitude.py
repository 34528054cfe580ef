"""Body rates from a reference that measures attitudes."""

import numpy as np

from estimator.recordings.reference import AttitudeReadings, RateReadings


def rates_from_attitude(readings: AttitudeReadings) -> RateReadings:
    """Return mean body rates (k - 1, 3) between successive attitudes, stamped in the middle.

    NaN beside a lost attitude, and over gaps of more than three usual steps.
    """
    q = readings.attitude_wxyz
    w0, v0, w1, v1 = q[:-1, :1], q[:-1, 1:], q[1:, :1], q[1:, 1:]
    scalar = w0 * w1 + np.sum(v0 * v1, axis=1, keepdims=True)
    vector = w0 * v1 - w1 * v0 - np.cross(v0, v1)
    sign = np.where(scalar < 0, -1.0, 1.0)  # q and -q are one attitude: take the short way
    length = np.linalg.norm(vector, axis=1, keepdims=True)
    angle = 2 * np.arctan2(length, sign * scalar)
    turn = sign * vector * np.where(length > 1e-12, angle / np.where(length > 1e-12, length, 1.0), 2.0)
    step_s = np.diff(readings.t_ns)[:, None] * 1e-9
    step_s = np.where(step_s > 3 * np.median(step_s), np.nan, step_s)
    return RateReadings((readings.t_ns[:-1] + np.diff(readings.t_ns) // 2), turn / step_s)
