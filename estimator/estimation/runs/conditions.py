"""The conditions of the gyros in a run, on a grid of instants: temperature, gimbals, specific force."""

import numpy as np

from estimator.effects.conditions import Conditions
from estimator.geometry.kinematics import AXES, GRAVITY_MPS2, specific_force
from estimator.observations.turned import Turned
from estimator.recordings.motion.body_rates import BodyRates
from estimator.recordings.recording import ImuData, Recording
from estimator.types import Floats

GRID_S = 0.02  # spacing of the instants for conditions, within blocks
_JUMP, _JUMP_C = 8.0, 0.5  # sigmas, degC
_SMOOTH_S = 0.2  # accelerometers also feel vibration


def conditions_of(recording: Recording, data: ImuData, grid_s: Floats, w_rps: Floats, steps: int) -> Conditions:
    """Return the conditions of a run at the instants ``grid_s``, ``steps`` of them to a block.

    With a table they come from its readings. Otherwise, and where the table is only known by how far it turned, they
    come from the block means ``w_rps`` (b, 3), see ``conditions_by_turns``.
    """
    temperature = temperature_at(data, grid_s)
    reference = recording.reference
    if reference.by_turns:
        return conditions_by_turns(recording, data, grid_s, w_rps, steps, temperature)
    table = recording.table
    assert table is not None, "a run is compared with a table or with another instrument"
    rates, grid_ns = BodyRates.of(table, recording.site), np.round(grid_s * 1e9).astype(np.int64)
    motion = *rates.gimbals_at(grid_ns), rates.accelerations_at(grid_ns)
    return Conditions.on_table(grid_s, *motion, table.gimbals, temperature_c=temperature, site=recording.site)


def conditions_by_turns(
    recording: Recording, data: ImuData, grid_s: Floats, w_rps: Floats, steps: int, temperature_c: Floats | None
) -> Conditions:
    """Return conditions whose rate and acceleration are those of whole blocks, ``steps`` instants to a block.

    ``w_rps`` (b, 3) are the mean rates. Table readings give the gimbals too, and the angle of the first of them;
    without these there are no gimbals. The specific force is that of ``force_at``, but with table readings and no
    accelerometer that at this angle. Accelerations are 0 where the motion is not known.
    """
    reference = recording.reference
    body = Turned.of_reference(reference, recording.site)
    period_s = grid_s[1] - grid_s[0]
    length_s = steps * period_s
    first_s = grid_s[::steps] - 0.5 * period_s
    change = body.rates(first_s + length_s) - body.rates(first_s)
    wdot = np.repeat(np.where(np.isfinite(change), change, 0.0) / length_s, steps, axis=0)
    w = np.repeat(w_rps, steps, axis=0)
    table = reference.table
    if table is not None:
        column = AXES.index(table.gimbals[0])
        angle = np.interp(grid_s, table.t_ns * 1e-9, np.unwrap(table.angle_rad[:, 0]))[:, None]
        rate, slope, gimbals = w[:, [column]], wdot[:, [column]], table.gimbals
        force = specific_force(angle, gimbals) if data.accel_mps2 is None else force_at(recording, data, grid_s)
    else:
        angle = rate = slope = np.empty((len(grid_s), 0))
        gimbals, force = (), force_at(recording, data, grid_s)
    return Conditions(
        t_s=grid_s,
        w_rps=w,
        wdot_rps2=wdot,
        angle_rad=angle,
        rate_rps=rate,
        acceleration_rps2=slope,
        gimbals=gimbals,
        specific_force_mps2=force,
        temperature_c=temperature_c,
        site=recording.site,
    )


def temperature_at(data: ImuData, grid_s: Floats) -> Floats | None:
    if data.temperature_c is None or not np.isfinite(data.temperature_c).any():
        return None
    known = np.isfinite(data.temperature_c)
    t_s = np.asarray(data.t_ns[known] * 1e-9, dtype=np.float64)
    return _smooth_temperature(t_s, data.temperature_c[known], grid_s)


def _smooth_temperature(t_s: Floats, temperature_c: Floats, grid_s: Floats) -> Floats:
    """Return the temperature at the instants ``grid_s``, smoothed over ten seconds because readings come in steps.

    With fewer than four such means the readings are only interpolated, and constant outside. Jumps are not smoothed.
    Outside the means the temperature goes on in a straight line.
    """
    width = 10.0
    edges = np.arange(t_s[0], t_s[-1] + width, width)
    number = np.clip(np.searchsorted(edges, t_s, side="right") - 1, 0, None)
    counts = np.bincount(number)
    held = counts > 0
    mean_t = np.bincount(number, t_s)[held] / counts[held]
    mean_c = np.bincount(number, temperature_c)[held] / counts[held]
    if len(mean_t) < 4:
        return np.asarray(np.interp(grid_s, t_s, temperature_c))
    from scipy.interpolate import PchipInterpolator

    inside = np.clip(grid_s, mean_t[0], mean_t[-1])
    smooth = np.asarray(PchipInterpolator(mean_t, mean_c)(inside))
    # A temperature that jumps is not smoothed: where the two differ by more than noise, the readings count.
    noise = float(np.median(np.abs(np.diff(temperature_c)))) / 0.954
    raw = np.interp(inside, t_s, temperature_c)
    smooth = np.where(np.abs(raw - smooth) > np.maximum(_JUMP * noise, _JUMP_C), raw, smooth)
    # Beyond the first and last mean the temperature continues in a straight line.
    first = (mean_c[1] - mean_c[0]) / (mean_t[1] - mean_t[0])
    last = (mean_c[-1] - mean_c[-2]) / (mean_t[-1] - mean_t[-2])
    return np.asarray(
        smooth + first * np.minimum(grid_s - mean_t[0], 0.0) + last * np.maximum(grid_s - mean_t[-1], 0.0)
    )


def force_at(recording: Recording, data: ImuData, grid_s: Floats) -> Floats:
    """Return the specific force (N, 3) in body axes, in m/s^2, at instants ``grid_s`` (N,) in s.

    It is that of gravity by the attitude, if the reference has one, else the smoothed output of the accelerometer.
    Outside the readings the first or last one holds. All NaN if there is neither, if no attitude is finite, or fewer
    than two samples of the accelerometer are.
    """
    unknown = np.full((len(grid_s), 3), np.nan)
    attitude = recording.reference.attitude
    if attitude is not None:
        good = np.isfinite(attitude.attitude_wxyz).all(axis=1)
        if not good.any():
            return unknown
        at = attitude.t_ns[good] * 1e-9
        w, x, y, z = attitude.attitude_wxyz[good].T
        up = np.column_stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]) * GRAVITY_MPS2
        return np.column_stack([np.interp(grid_s, at, column) for column in up.T])
    force_mps2 = data.specific_force_mps2
    if force_mps2 is None:
        return unknown
    good = np.isfinite(force_mps2).all(axis=1)
    t_s, accel = data.t_ns[good] * 1e-9, force_mps2[good]
    if len(t_s) < 2:
        return unknown
    width = max(round(_SMOOTH_S / max(float(np.median(np.diff(t_s))), 1e-6)), 1)
    kernel = np.ones(width) / width
    smooth = [np.convolve(np.pad(c, width, mode="edge"), kernel, "same")[width:-width] for c in accel.T]
    return np.column_stack([np.interp(grid_s, t_s, column) for column in smooth])
