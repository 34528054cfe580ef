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

import numpy as np

from drivers.types import Floats
from estimator.calibration.compensation import Compensation
from estimator.effects.conditions import REFERENCE_C
from estimator.effects.effect import Acts
from estimator.effects.thermal import THERMAL_BIAS, THERMAL_BIAS_QUADRATIC
from estimator.geometry.array import TOLERANCE
from station.errors import UsageError
from station.exports.exported import Exported
from station.exports.written import Written, as_triad, delay_line, head, lines_of, number

_KEPT = (THERMAL_BIAS.name, THERMAL_BIAS_QUADRATIC.name)
_PX4_MOST, _ARDUPILOT_MOST = 4, 3
_PX4_STEP_RPS = 0.01
_ARDUPILOT_REFERENCE_C = 35.0
_ARDUPILOT_UNIT = 1e-6
_INTEGER, _FLOAT = 6, 9


def write_px4(exported: Exported) -> Written:
    """Return parameters of one of PX4's gyros, 0 to 3, as QGroundControl loads them."""
    instance = _instance(exported, _PX4_MOST, "PX4")
    held, not_held = _bias_only(exported, "PX4")
    offsets = _along_axes(exported, -held.bias_rps)
    prefix = f"CAL_GYRO{instance}"
    not_held.append(
        f"{prefix}_ID and {prefix}_ROT: they must be those of this sensor already, as after a calibration by PX4; "
        "offsets are in the sensor's own axes"
    )
    if np.linalg.norm(offsets) <= _PX4_STEP_RPS:
        not_held.append(
            "PX4 passes over offsets that differ from those in use (zero at its start) by less than 0.01 rad/s, and "
            "these do: its estimator finds them as its gyro bias instead"
        )
    rows: list[tuple[str, float | int]] = [*_by_axis(prefix + "_{}OFF", offsets)]
    if held.effects:
        low, _, high = exported.seen.temperature_c
        thermal = f"TC_G{instance}"
        rows += [("TC_G_ENABLE", 1), (f"{thermal}_TREF", REFERENCE_C)]
        rows += [(f"{thermal}_TMIN", low), (f"{thermal}_TMAX", high)]
        coefficients = [np.zeros(3), *_thermal(exported, held), np.zeros(3)]
        for order, values in enumerate(coefficients):
            rows += _by_axis(f"{thermal}_X{order}_{{}}", values, "012")
        not_held.append(f"{thermal}_ID: it must be that of this sensor, the number that {prefix}_ID has")
    lines = [
        f"1\t1\t{name}\t{value if isinstance(value, int) else number(value)}\t"
        f"{_INTEGER if isinstance(value, int) else _FLOAT}"
        for name, value in rows
    ]
    what = "Parameters for PX4, to be loaded by QGroundControl: output less offset (rad/s)"
    titles = [*head(exported, what, not_held, "#"), "#", "# Vehicle-Id Component-Id Name Value Type"]
    return Written("\n".join([*titles, *lines]) + "\n", tuple(not_held))


def write_ardupilot(exported: Exported) -> Written:
    """Return parameters of one of ArduPilot's gyros, 0 to 2, as its ground stations load them."""
    instance = _instance(exported, _ARDUPILOT_MOST, "ArduPilot")
    held, not_held = _bias_only(exported, "ArduPilot")
    number_of = instance + 1
    prefix = f"INS_GYR{'O' if instance == 0 else f'{number_of}O'}FFS"
    not_held.append("INS_GYR_CAL: ArduPilot finds offsets anew at each start and loses these unless it is set to 0")
    offsets = _along_axes(exported, -held.bias_rps)
    thermal_rows: list[tuple[str, float]] = []
    if held.effects:
        low, mean, high = exported.seen.temperature_c
        linear, quadratic = _thermal(exported, held)
        above = mean - REFERENCE_C
        offsets = offsets + linear * above + quadratic * above**2  # those at INS_GYRn_CALTEMP
        linear = linear + 2 * (_ARDUPILOT_REFERENCE_C - REFERENCE_C) * quadratic
        thermal = f"INS_TCAL{number_of}"
        thermal_rows = [(f"INS_GYR{number_of}_CALTEMP", mean), (f"{thermal}_ENABLE", 1.0)]
        thermal_rows += [(f"{thermal}_TMIN", low), (f"{thermal}_TMAX", high)]
        for order, values in ((1, linear), (2, quadratic), (3, np.zeros(3))):
            thermal_rows += _by_axis(f"{thermal}_GYR{order}_{{}}", values / _ARDUPILOT_UNIT)
        not_held.append(f"{thermal}_TMIN and TMAX are for the coefficients of the accelerometer, too, if it has any")
    rows = [*_by_axis(prefix + "_{}", offsets), *thermal_rows]
    lines = [f"{name},{number(value)}" for name, value in rows]
    what = "Parameters for ArduPilot: output less offset (rad/s)"
    return Written("\n".join([*head(exported, what, not_held, "#"), *lines]) + "\n", tuple(not_held))


def _by_axis(name: str, values: Floats, axes: str = "XYZ") -> list[tuple[str, float]]:
    """Return a parameter for each axis, which stands in its name."""
    return [(name.format(axis), value) for axis, value in zip(axes, values.tolist(), strict=True)]


def _instance(exported: Exported, most: int, form: str) -> int:
    if not 0 <= exported.instance < most:
        raise UsageError(f"{form} has gyros number 0 to {most - 1}, not {exported.instance}")
    return exported.instance


def _bias_only(exported: Exported, form: str) -> tuple[Compensation, list[str]]:
    """Return what an autopilot can hold, and what it cannot."""
    held, dropped = as_triad(exported, form, _KEPT)
    dropped |= {e.known.called: "it is not corrected" for e in exported.compensation.effects if e.acts is Acts.RATE}
    k = ", ".join(f"{state * 1e6:.0f}" for state in exported.compensation.states[:, 0])
    return held, [
        f"scale factor errors ({k} ppm) and misalignments: {form} has no parameters for them",
        *lines_of(dropped),
        *delay_line(exported, f"{form} has no parameter for it"),
        f"{form} keeps parameters as 32-bit floats, to 7 digits",
    ]


def _along_axes(exported: Exported, values: Floats) -> Floats:
    """Return what belongs to each gyro (3,) along x, y and z; UsageError unless the gyros lie along these."""
    p = exported.compensation.array.p
    nearest = np.round(p)
    if np.abs(p - nearest).max() > TOLERANCE or (np.abs(nearest).sum(axis=0) != 1).any():
        raise UsageError(
            "an autopilot holds offsets along x, y and z, and the gyros do not lie along these axes: `--format c` "
            "gives the function that makes a body rate of them"
        )
    return np.asarray(nearest.T @ values)


def _thermal(exported: Exported, held: Compensation) -> tuple[Floats, Floats]:
    """Return bias over temperature along x, y, z: linear in rad/s/K and quadratic in rad/s/K2, each (3,)."""
    linear, quadratic = (held.held(name) for name in _KEPT)
    return (
        _along_axes(exported, np.zeros(3) if linear is None else linear[:, 0]),
        _along_axes(exported, np.zeros(3) if quadratic is None else quadratic[:, 0]),
    )
