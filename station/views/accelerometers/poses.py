"""A calibration by poses as people read it, and as one JSON object."""

import math
from dataclasses import dataclass
from typing import Any

from estimator.geometry.kinematics import GRAVITY_MPS2
from estimator.poses.calibration import (
    ACCELEROMETER,
    Board,
    BoardImu,
    GyroTurnCalibration,
    Parameter,
    PoseCalibration,
    PoseRest,
    PoseSession,
    RefusedTurn,
    Triad,
)

_MG = 1000 / GRAVITY_MPS2
NOT_SHOWN = "not shown"
"""In place of the number of a parameter that the rests do not determine."""


@dataclass(kw_only=True, frozen=True, slots=True)
class ParameterRow:
    """One parameter as text: its name, its value with the half width of the 95 % interval, and the unit."""

    name: str
    value: str
    u95: str
    unit: str


def parameter_rows(result: PoseCalibration) -> list[ParameterRow]:
    """Return the nine parameters in everyday units: scales as factors, biases in m/s2, angles in deg from 90.

    Each bias has a second row in mg, so there are twelve rows; of raw counts there are nine, with scales in
    counts/(m/s2) and biases in counts. A parameter that is not shown has ``NOT_SHOWN`` in place of its value.
    """
    counts = result.unit == "counts"
    rows = []
    for own in result.parameters:
        kind = own.name.split()[0]
        if kind == "scale":
            rows.append(_row(own, "counts/(m/s2)" if counts else "", 1.0))
        elif kind == "bias":
            rows.append(_row(own, "counts" if counts else "m/s2", 1.0))
            if not counts:
                rows.append(_row(own, "mg", _MG))
        else:
            rows.append(_row(own, "deg from 90", math.degrees(1)))
    return rows


def gyro_rows(result: GyroTurnCalibration) -> list[ParameterRow]:
    """Return a row for each of the twelve parameters: scales as factors, biases in deg/s, tilts in deg.

    A parameter that is not shown has ``NOT_SHOWN`` in place of its value.
    """
    rows = []
    for own in result.parameters:
        kind = own.name.split()[1]
        if kind == "scale":
            rows.append(_row(own, "", 1.0))
        elif kind == "bias":
            rows.append(_row(own, "deg/s", math.degrees(1)))
        else:
            rows.append(_row(own, "deg", math.degrees(1)))
    return rows


def triad_rows(triad: Triad) -> list[ParameterRow]:
    """Return the twelve states of a triad in everyday units."""
    degrees = math.degrees(1)
    bias = ("m/s2", 1.0) if triad.kind == ACCELEROMETER else ("deg/s", degrees)
    units = {"scale": ("", 1.0), "bias": bias}
    return [_row(own, *units.get(own.name.split()[0], ("deg", degrees))) for own in triad.parameters]


def board_rows(board: Board) -> list[list[str]]:
    """Return five texts for each IMU: its name, its arm, distance and U of it in mm, and its turn against the first.

    Arm and turn, a rotation vector in deg, are one text each, of three parts; those of the first IMU are zeros.
    """
    rows = []
    for imu in board.imus:
        arm = " ".join(f"{1e3 * part:.2f}" for part in imu.arm_m)
        turn = " ".join(f"{math.degrees(part):.2f}" for part in rotation_vector(imu.rotation))
        rows.append([imu.name, arm, f"{1e3 * imu.distance_m:.2f}", f"{1e3 * imu.distance_u95_m:.2f}", turn])
    return rows


def rotation_vector(matrix: Any) -> list[float]:
    """Return the vector in rad of a rotation matrix (3, 3)."""
    from scipy.spatial.transform import Rotation

    vector: list[float] = Rotation.from_matrix(matrix).as_rotvec().tolist()
    return vector


def board_words(board: Board) -> str:
    """Return a sentence on the samples that the arms were computed from, and the rms error that remains."""
    return (
        f"{board.used} samples of fast turns, {board.saturated} saturated ones left out; arms and motion leave "
        f"{board.misfit_mps2:.2f} m/s2 (rms)"
    )


def turns_words(result: GyroTurnCalibration) -> str:
    """Return a sentence on how far turns carry gravity astray, rms in deg, before and after the calibration."""
    before, after = math.degrees(result.before_rad), math.degrees(result.after_rad)
    return (
        f"gravity carried by the gyros over {result.turns} turns, rms error: {before:.3f} deg before, "
        f"{after:.3f} deg after"
    )


def turn_words(turn: RefusedTurn) -> str:
    """Return which turn it is."""
    return f"rest {turn.before} to {turn.after}"


def _row(parameter: Parameter, unit: str, factor: float) -> ParameterRow:
    """Return a parameter in a unit, with digits down to the second that counts of its half width.

    ``factor`` is that from SI to the unit. A parameter that lacks one of the two has ``NOT_SHOWN`` as value and "" as
    half width.
    """
    if parameter.value is None or parameter.u95 is None:
        return ParameterRow(name=parameter.name, value=NOT_SHOWN, u95="", unit=unit)
    digits = _digits(parameter.u95 * factor)
    return ParameterRow(
        name=parameter.name,
        value=f"{parameter.value * factor:.{digits}f}",
        u95=f"{parameter.u95 * factor:.{digits}f}",
        unit=unit,
    )


def _digits(size: float) -> int:
    """Return the decimals that show two significant digits of a size, 0 to 8."""
    if not 0 < size < math.inf:
        return 6
    return min(max(1 - math.floor(math.log10(size)), 0), 8)


def norm_words(result: PoseCalibration) -> str:
    """Return a sentence on the scatter of the length of gravity over the rests used, before and after calibration."""
    before, after = result.before_mps2, result.after_mps2
    return (
        f"length of gravity over {len(result.used)} rests, standard deviation: {before:.4f} m/s2 "
        f"({before * _MG:.2f} mg) before, {after:.4f} m/s2 ({after * _MG:.2f} mg) after"
    )


def gravity_words(result: PoseCalibration) -> str:
    """Return gravity with its uncertainty and source."""
    gravity = result.gravity
    return f"gravity: {gravity.value_mps2:.5f} m/s2, sigma {gravity.sd * 1e6:.3g} ppm, {gravity.source}"


def rest_words(rest: PoseRest) -> str:
    """Return which rest it is: its number, and when it was."""
    if rest.start_s is None or rest.duration_s is None:
        return f"rest {rest.number}"
    return f"rest {rest.number} ({rest.start_s:.1f} to {rest.start_s + rest.duration_s:.1f} s)"


def session_object(session: PoseSession, path: str) -> dict[str, Any]:
    """Return all of a session for --json, in SI: notes and refused files, too; null for parameters that are not shown.

    ``path`` is the file of the calibration. ``matrix`` is A in output = A f + bias, for a body whose x is the sense
    axis x, and y in the plane of x and y. That of the gyro is G in output = G w + bias for the same body. ``gyro`` and
    ``board`` are null if there is none.
    """
    gyro = session.gyro
    notes = [*session.notes, *session.accelerometer.notes, *(gyro.notes if gyro else ())]
    return {
        "calibration": path,
        "device": session.device,
        "files": list(session.files),
        "refused_files": list(session.refused_files),
        "notes": notes,
        "accelerometer": _accelerometer_object(session.accelerometer),
        "gyro": None if gyro is None else _gyro_object(gyro),
        "board": None if session.board is None else _board_object(session.board),
        "triads": {triad.kind: _triad_object(triad) for triad in session.triads},
    }


def _accelerometer_object(result: PoseCalibration) -> dict[str, Any]:
    """Return a calibrated triad for JSON: parameters with covariance, matrix, gravity with its source, and all rests.

    With them are unit, degrees of freedom, and the scatter of the norm before and after, and between rests. Covariance
    and matrix are None if the rests did not show all parameters.
    """
    complete = bool(result.shown.all())
    return {
        "unit": result.unit,
        "parameters": [_parameter_object(own) for own in result.parameters],
        "covariance": result.covariance.tolist() if complete else None,
        "matrix": result.intrinsic.matrix.tolist() if complete else None,
        "gravity_mps2": result.gravity.value_mps2,
        "gravity_sd": result.gravity.sd,
        "gravity_source": result.gravity.source,
        "freedom": result.freedom,
        "norm_before_mps2": result.before_mps2,
        "norm_after_mps2": result.after_mps2,
        "between_rests_mps2": result.between_mps2,
        "rests": [_rest_object(rest) for rest in result.rests],
    }


def _gyro_object(result: GyroTurnCalibration) -> dict[str, Any]:
    """Return calibrated gyros for JSON, with the number of turns used, and those that were refused with the reason.

    With them are the rms angles by which a turn misses gravity, before and after the calibration, in rad.
    Covariance and matrix are None if the turns did not show all parameters.
    """
    complete = bool(result.shown.all())
    return {
        "parameters": [_parameter_object(own) for own in result.parameters],
        "covariance": result.covariance.tolist() if complete else None,
        "matrix": result.matrix.tolist() if complete else None,
        "turns": result.turns,
        "gravity_before_rad": result.before_rad,
        "gravity_after_rad": result.after_rad,
        "refused": [{"from": turn.before, "to": turn.after, "reason": turn.reason} for turn in result.refused],
    }


def _board_object(board: Board) -> dict[str, Any]:
    return {
        "used": board.used,
        "saturated": board.saturated,
        "misfit_mps2": board.misfit_mps2,
        "imus": [_imu_object(imu) for imu in board.imus],
    }


def _imu_object(imu: BoardImu) -> dict[str, Any]:
    """Return an IMU of a board for JSON, in SI: place and rotation (3, 3) against the first one, both calibrations.

    The place has its covariance and its distance with U, the rotation its standard deviation.
    """
    return {
        "name": imu.name,
        "arm_m": imu.arm_m.tolist(),
        "covariance_m2": imu.covariance_m2.tolist(),
        "distance_m": imu.distance_m,
        "distance_u95_m": imu.distance_u95_m,
        "rotation": imu.rotation.tolist(),
        "rotation_sd_rad": imu.rotation_sd_rad,
        "accelerometer": _accelerometer_object(imu.accelerometer),
        "gyro": _gyro_object(imu.gyro),
    }


def _triad_object(triad: Triad) -> dict[str, Any]:
    complete = bool(triad.shown.all())
    return {
        "parameters": [_parameter_object(own) for own in triad.parameters],
        "covariance": triad.covariance.tolist() if complete else None,
        "matrix": triad.matrix.tolist() if complete else None,
    }


def _parameter_object(parameter: Parameter) -> dict[str, Any]:
    return {"name": parameter.name, "value": parameter.value, "sd": parameter.sd, "u95": parameter.u95}


def _rest_object(rest: PoseRest) -> dict[str, Any]:
    """Return a rest: number, file, time, mean output, length of the force before and after the calibration, and sigma.

    ``refused`` is why it was not used, "" if it was. The time is None if only means were given, ``sd_mps2`` if the rest
    was not used.
    """
    return {
        "number": rest.number,
        "file": rest.file,
        "start_s": rest.start_s,
        "duration_s": rest.duration_s,
        "mean": rest.mean.tolist(),
        "before_mps2": rest.before_mps2,
        "after_mps2": rest.after_mps2,
        "sd_mps2": rest.sd_mps2,
        "refused": rest.refused,
    }
