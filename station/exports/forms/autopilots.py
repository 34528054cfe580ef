"""Parameter files of autopilots: of a triad of gyros the bias and how it follows the temperature, of a triad of
accelerometers bias and scale, and nothing else.

Sources: PX4 takes CAL_GYROn_XOFF, YOFF, ZOFF (rad/s, axes of the sensor, before its rotation) and a polynomial of the
temperature, TC_Gn_Xm_AXIS about TC_Gn_TREF between TC_Gn_TMIN and TMAX, off the outputs of the sensor that
CAL_GYROn_ID and TC_Gn_ID name; offsets that differ from those in use by less than 0.01 rad/s are passed over
(github.com/PX4/PX4-Autopilot, src/lib/sensor_calibration/Gyroscope.cpp: Correct, set_offset;
src/modules/temperature_compensation/TemperatureCompensation.cpp: calc_thermal_offsets_3D). QGroundControl reads
vehicle, component, name, value and type (9 = float, 6 = integer), separated by tabs (docs.qgroundcontrol.com,
Parameter File Format). Of accelerometers PX4 takes off CAL_ACCn_XOFF (m/s2) and multiplies by CAL_ACCn_XSCALE; what
differs from the values in use by less than 0.01 (m/s2, 1) is passed over
(src/lib/sensor_calibration/Accelerometer.cpp: set_offset, set_scale). ArduPilot takes INS_GYROFFS_X, INS_GYR2OFFS_X,
INS_GYR3OFFS_X (rad/s, axes of the sensor) off the outputs, and finds them anew at each start unless INS_GYR_CAL is 0;
of the temperature P(T - 35 degC) - P(INS_GYRn_CALTEMP - 35 degC), P of INS_TCALn_GYRm_AXIS in 1e-6 rad/s/K^m.
Accelerometers: INS_ACCOFFS_X (m/s2) is taken off, then multiplied by INS_ACCSCAL_X; INS_ACCn_CALTEMP is the
temperature of these constants (github.com/ArduPilot/ardupilot, libraries/AP_InertialSensor: AP_InertialSensor.cpp,
AP_InertialSensor_Backend.cpp, AP_InertialSensor_tempcal.cpp).
"""

from typing import Any

import numpy as np

from drivers.types import Floats
from estimator.effects.conditions import REFERENCE_C
from estimator.effects.effect import Acts
from estimator.effects.thermal import THERMAL_BIAS, THERMAL_BIAS_QUADRATIC
from estimator.geometry.array import TOLERANCE
from station.errors import UsageError, sentence
from station.exports.accelerations import HeldForces, held_forces
from station.exports.exported import Exported
from station.exports.written import Written, as_triad, from_template

_KEPT = (THERMAL_BIAS.name, THERMAL_BIAS_QUADRATIC.name)
_PX4_STEP_RPS = 0.01
_PX4_STEP = 0.01
"""Changes of the offsets (m/s2) and scales (1) of accelerometers that PX4 passes over."""
_ARDUPILOT_REFERENCE_C = 35.0


def write_px4(exported: Exported) -> Written:
    """Return the parameters of PX4's gyro number ``exported.instance`` (0 to 3), as QGroundControl loads them.

    These are offsets and temperature coefficients of the gyros, and, if they were exported, offsets and scales of the
    accelerometers. The file says so if it cannot hold the latter (see ``_bias_and_scale``), and where the constants are
    so small that PX4 passes them over. UsageError for other numbers, or unless there are three gyros along x, y and z.
    """
    held, values = _bias_only(exported, "PX4", 4)
    passed_over = np.linalg.norm(values["offsets"]) <= _PX4_STEP_RPS
    forces, of_forces = _bias_and_scale(exported, "PX4")
    if forces.correction is not None:
        small_offsets = np.linalg.norm(of_forces["force_offsets"]) <= _PX4_STEP
        small_scales = np.linalg.norm(of_forces["force_scales"] - 1) <= _PX4_STEP
        of_forces |= {"small_offsets": small_offsets, "small_scales": small_scales}
    return from_template("px4", exported, held, forces, passed_over=passed_over, **values, **of_forces)


def write_ardupilot(exported: Exported) -> Written:
    """Return the parameters of ArduPilot's IMU number ``exported.instance`` (0 to 2), for its ground stations.

    These are offsets and temperature coefficients of the gyros, and, if they were exported, offsets and scales of the
    accelerometers. The file says so if it cannot hold the latter (see ``_bias_and_scale``). The gyros' offsets are
    those at the mean temperature of the calibration, if they depend on it. UsageError for other numbers, or unless
    there are three gyros along x, y and z.
    """
    held, values = _bias_only(exported, "ArduPilot", 3)
    if values["thermal"]:
        linear, quadratic = values["thermal"]
        above = values["mean_c"] - REFERENCE_C
        values["offsets"] += linear * above + quadratic * above**2  # those at INS_GYRn_CALTEMP
        values["thermal"] = linear + 2 * (_ARDUPILOT_REFERENCE_C - REFERENCE_C) * quadratic, quadratic
    forces, of_forces = _bias_and_scale(exported, "ArduPilot")
    return from_template("ardupilot", exported, held, forces, **values, **of_forces)


def _bias_only(exported: Exported, form: str, most: int) -> tuple[dict[str, str], dict[str, Any]]:
    """Return the effects that are left out, with reasons, and the values that an autopilot can hold.

    Values: gyro number, bias to be subtracted in rad/s along x, y, z, its linear and quadratic temperature coefficients
    (empty without any), scale factor errors in ppm as text for a comment, reference and lowest, mean and highest
    temperature in degC.
    UsageError if the gyro number is not below ``most``, or there are not three gyros along x, y and z; ``form`` names
    the format in it.
    """
    if not 0 <= exported.instance < most:
        raise UsageError(f"{form} has gyros number 0 to {most - 1}, not {exported.instance}")
    held, dropped = as_triad(exported, form, _KEPT)
    dropped |= {e.known.called: "it is not corrected" for e in exported.compensation.effects if e.acts is Acts.RATE}
    lowest, mean, highest = exported.seen.temperature_c
    axes = _signed_axes(exported.compensation.array.p)
    if axes is None:
        raise UsageError(sentence("export.not_along_axes"))
    coefficients = (held.held(name) for name in _KEPT)
    along = [axes.T @ (np.zeros(3) if some is None else some[:, 0]) for some in coefficients]
    return dropped, {
        "instance": exported.instance,
        "offsets": axes.T @ -held.bias_rps,
        "thermal": along if held.effects else (),
        "k_ppm": ", ".join(f"{state * 1e6:.0f}" for state in exported.compensation.states[:, 0]),
        "reference_c": REFERENCE_C,
        "lowest_c": lowest,
        "mean_c": mean,
        "highest_c": highest,
    }


def _bias_and_scale(exported: Exported, form: str) -> tuple[HeldForces, dict[str, Any]]:
    """Return what an autopilot holds of the accelerometers, and the values for its template.

    Values: offsets in m/s2 and scales along x, y, z, for (output - offset) scale, and misalignments in urad as text for
    a comment. There are none without accelerometers, and none for those that are of several sources or not three along
    x, y and z, which a line then says.
    """
    forces = held_forces(exported, form, triad=True)
    if forces.correction is None:
        return forces, {}
    axes = _signed_axes(forces.correction.p)
    if axes is None:
        return HeldForces(lines=(sentence("export.accelerometers_not_along_axes"),)), {}
    states = np.array([one.states for one in forces.correction.accelerometers])
    return forces, {
        "force_offsets": axes.T @ -states[:, 1],
        "force_scales": np.abs(axes).T @ (1 / (1 - states[:, 0])),
        "misalignments_urad": ", ".join(f"{angle * 1e6:.0f}" for angle in states[:, 2:].ravel()),
    }


def _signed_axes(p: Floats) -> Floats | None:
    """Return sense axes (3, 3) rounded to 0, 1 and -1; None unless they lie along x, y and z."""
    nearest = np.round(p)
    if np.abs(p - nearest).max() > TOLERANCE or (np.abs(nearest).sum(axis=0) != 1).any():
        return None
    return np.asarray(nearest)
