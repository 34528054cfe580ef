"""Parameter files of autopilots, which hold the bias of a triad and how it follows the temperature, and nothing else.

Sources: PX4 takes CAL_GYROn_XOFF, YOFF, ZOFF (rad/s, axes of the sensor, before its rotation) and a polynomial of the
temperature, TC_Gn_Xm_AXIS about TC_Gn_TREF between TC_Gn_TMIN and TMAX, off the outputs of the sensor that CAL_GYROn_ID
and TC_Gn_ID name; offsets that differ from those in use by less than 0.01 rad/s are passed over
(github.com/PX4/PX4-Autopilot, src/lib/sensor_calibration/Gyroscope.cpp: Correct, set_offset;
src/modules/temperature_compensation/TemperatureCompensation.cpp: calc_thermal_offsets_3D). QGroundControl reads
vehicle, component, name, value and type (9 = float, 6 = integer), separated by tabs
(docs.qgroundcontrol.com, Parameter File Format). ArduPilot takes INS_GYROFFS_X, INS_GYR2OFFS_X, INS_GYR3OFFS_X (rad/s,
axes of the sensor) off the outputs, and finds them anew at each start unless INS_GYR_CAL is 0; of the temperature
P(T - 35 degC) - P(INS_GYRn_CALTEMP - 35 degC), P of INS_TCALn_GYRm_AXIS in 1e-6 rad/s/K^m
(github.com/ArduPilot/ardupilot, libraries/AP_InertialSensor: AP_InertialSensor.cpp, AP_InertialSensor_Backend.cpp,
AP_InertialSensor_tempcal.cpp).
"""

from typing import Any

import numpy as np

from drivers.types import Floats
from estimator.effects.conditions import REFERENCE_C
from estimator.effects.effect import Acts
from estimator.effects.thermal import THERMAL_BIAS, THERMAL_BIAS_QUADRATIC
from estimator.geometry.array import TOLERANCE
from station.errors import UsageError, sentence
from station.exports.exported import Exported
from station.exports.written import Written, as_triad, from_template

_KEPT = (THERMAL_BIAS.name, THERMAL_BIAS_QUADRATIC.name)
_PX4_STEP_RPS = 0.01
_ARDUPILOT_REFERENCE_C = 35.0


def write_px4(exported: Exported) -> Written:
    """Return parameters of one of PX4's gyros, 0 to 3, as QGroundControl loads them."""
    held, values = _bias_only(exported, "PX4", 4)
    passed_over = np.linalg.norm(values["offsets"]) <= _PX4_STEP_RPS
    return from_template("px4", exported, held, passed_over=passed_over, **values)


def write_ardupilot(exported: Exported) -> Written:
    """Return the parameters of ArduPilot's gyro number ``exported.instance`` (0 to 2), in the format of its ground
    stations.

    UsageError for other numbers, or if there are not three gyros.
    """
    held, values = _bias_only(exported, "ArduPilot", 3)
    if values["thermal"]:
        linear, quadratic = values["thermal"]
        above = values["mean_c"] - REFERENCE_C
        values["offsets"] += linear * above + quadratic * above**2  # those at INS_GYRn_CALTEMP
        values["thermal"] = linear + 2 * (_ARDUPILOT_REFERENCE_C - REFERENCE_C) * quadratic, quadratic
    return from_template("ardupilot", exported, held, **values)


def _bias_only(exported: Exported, form: str, most: int) -> tuple[dict[str, str], dict[str, Any]]:
    """Return the effects that are left out, with reasons, and the values that an autopilot can hold.

    Values: bias in rad/s along x, y, z, its linear and quadratic temperature coefficients (empty without any),
    temperatures in degC. UsageError, which names ``form``, if the gyro number is not below ``most`` or there are not
    three gyros.
    """
    if not 0 <= exported.instance < most:
        raise UsageError(f"{form} has gyros number 0 to {most - 1}, not {exported.instance}")
    held, dropped = as_triad(exported, form, _KEPT)
    dropped |= {e.known.called: "it is not corrected" for e in exported.compensation.effects if e.acts is Acts.RATE}
    lowest, mean, highest = exported.seen.temperature_c
    coefficients = (held.held(name) for name in _KEPT)
    along = [_along_axes(exported, np.zeros(3) if some is None else some[:, 0]) for some in coefficients]
    return dropped, {
        "instance": exported.instance,
        "offsets": _along_axes(exported, -held.bias_rps),
        "thermal": along if held.effects else (),
        "k_ppm": ", ".join(f"{state * 1e6:.0f}" for state in exported.compensation.states[:, 0]),
        "reference_c": REFERENCE_C,
        "lowest_c": lowest,
        "mean_c": mean,
        "highest_c": highest,
    }


def _along_axes(exported: Exported, values: Floats) -> Floats:
    """Return values of each gyro (3,) reordered to x, y and z; UsageError unless the gyros lie along these axes."""
    p = exported.compensation.array.p
    nearest = np.round(p)
    if np.abs(p - nearest).max() > TOLERANCE or (np.abs(nearest).sum(axis=0) != 1).any():
        raise UsageError(sentence("export.not_along_axes"))
    return np.asarray(nearest.T @ values)
