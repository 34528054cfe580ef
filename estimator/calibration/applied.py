"""A compensation applied to samples of its gyros, as arrays or as a pandas.DataFrame."""

from typing import Any

import numpy as np

from estimator.calibration.compensation import Compensation, CompensationError
from estimator.calibration.correction import compensate, needs_of
from estimator.types import Floats

_COLUMNS = ("x_rps", "y_rps", "z_rps")


def applied(
    compensation: Compensation,
    outputs_rps: Any,
    *,
    t_s: Floats | None,
    temperature_c: Floats | None,
    accel_mps2: Floats | None,
) -> Any:
    """Return the body rate (N, 3) in rad/s, corrected for states and effects.

    ``outputs_rps`` (N, n) are the outputs of the gyros, as an array or as a frame with columns by their names; a frame
    gives a frame (x_rps, y_rps, z_rps) with its index. Rates may be NaN (``compensate``). ``t_s``, ``temperature_c``
    (N,) and ``accel_mps2`` (N, 3) are None if not known. CompensationError for missing columns, another shape, lengths
    that differ, data that an effect needs and that are not known, or gyros that do not span space.
    """
    names = compensation.array.names
    is_frame = hasattr(outputs_rps, "columns")
    if is_frame:
        missing = [name for name in names if name not in outputs_rps.columns]
        if missing:
            raise CompensationError(f"the frame has no column for {', '.join(missing)}: name its columns {list(names)}")
        rates_rps = np.asarray(outputs_rps[list(names)], dtype=np.float64)
    else:
        rates_rps = np.asarray(outputs_rps, dtype=np.float64)
    if rates_rps.ndim != 2 or rates_rps.shape[1] != len(names):
        shape = " x ".join(map(str, rates_rps.shape))
        wanted = f"N x {len(names)}: {', '.join(names)}, in this order"
        raise CompensationError(f"give the outputs as an array of {wanted}; this one is {shape}")
    if t_s is None and "time" in needs_of(compensation):
        raise CompensationError("correcting the effects of these gyros needs t_s, the times of the samples")
    instants_s = np.zeros(len(rates_rps)) if t_s is None else np.asarray(t_s, dtype=np.float64)
    given = {"t_s": instants_s, "temperature_c": temperature_c, "accel_mps2": accel_mps2}
    for name, values in given.items():
        if values is not None and len(values) != len(rates_rps):
            raise CompensationError(f"{name} has {len(values)} rows, the outputs have {len(rates_rps)}")
    body_rps = compensate(compensation, rates_rps, instants_s, temperature_c, accel_mps2)
    if not is_frame:
        return body_rps
    from pandas import DataFrame

    return DataFrame(body_rps, outputs_rps.index, list(_COLUMNS))
