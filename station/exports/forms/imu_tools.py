"""Files of tools that calibrate IMUs by themselves, and read what others found: imu_tk, imucal.

Sources: imu_tk corrects ``x = T K (raw - b)`` and reads the numbers of T, K (by rows) and b, one file a sensor
(bitbucket.org/alberto_pretto/imu_tk, include/imu_tk/calibration.h: load, unbiasNormalize); of accelerometers T is upper
triangular, with ones on its diagonal (src/calibration.cpp: MultiPosAccResidual). imucal corrects
``acc = (K_a R_a)^-1 (raw - b_a)`` and ``gyr = (K_g R_g)^-1 (raw - K_ga acc - b_g)``, in m/s^2 and deg/s, and reads JSON
(github.com/mad-lab-fau/imucal, imucal/ferraris_calibration_info.py, imucal/calibration_info.py).
"""

import numpy as np

from drivers.types import Floats
from estimator.effects.site import G_SENSITIVITY
from estimator.geometry.kinematics import GRAVITY_MPS2
from station.errors import UsageError, sentence
from station.exports.accelerations import HeldForces, held_forces
from station.exports.exported import Exported
from station.exports.written import Written, as_triad, delay_line, from_template, head, json_text, lines_of

_IMUCAL_FORMAT = "2.0.0"


def write_imu_tk_acc(exported: Exported) -> Written:
    """Return the file of imu_tk for three accelerometers, with the rotation from the body to its axes in a comment.

    UsageError without three of one source that span space, or if they form a left-handed triad.
    """
    forces = held_forces(exported, "imu_tk", triad=True)
    correction = forces.held
    rotation = _imu_tk_axes(forces)
    upper = rotation @ correction.solution
    return _imu_tk(exported, forces, {}, rotation, np.triu(upper), -correction.bias_mps2)


def write_imu_tk_gyro(exported: Exported) -> Written:
    """Return the file of imu_tk for three gyros, in the axes that the accelerometers set, or of the body without them.

    The rotation from the body to these axes is in a comment. UsageError if the gyros are not three, or not in the order
    of the accelerometers, or these form a left-handed triad; CompensationError if the gyros do not span space.
    """
    constants, dropped = as_triad(exported, "imu_tk")
    forces = held_forces(exported, "imu_tk", triad=True)
    rotation = np.eye(3) if forces.correction is None else _imu_tk_axes(forces)
    matrix = rotation @ constants.solution
    if not np.array_equal(np.abs(matrix).argmax(axis=0), np.arange(3)):
        raise UsageError(sentence("export.other_order"))
    return _imu_tk(exported, HeldForces(), dropped, rotation, matrix, -constants.bias_rps)


def _imu_tk_axes(forces: HeldForces) -> Floats:
    """Return the rotation (3, 3) from the body to the axes that the accelerometers set.

    In these their correction is upper triangular with positive diagonal. UsageError for a left-handed triad.
    """
    q, r = np.linalg.qr(forces.held.solution)
    rotation = (q * np.sign(np.diag(r))).T
    if np.linalg.det(rotation) < 0:
        raise UsageError(sentence("export.left_handed_accelerometers", form="imu_tk"))
    return np.asarray(rotation)


def _imu_tk(
    exported: Exported, forces: HeldForces, dropped: dict[str, str], rotation: Floats, matrix: Floats, offsets: Floats
) -> Written:
    """Return the file for a sensor that is corrected by ``matrix (raw - offsets)``, ``matrix`` (3, 3).

    ``rotation`` (3, 3) turns vectors from the body to the axes of the result. ``dropped`` are effects of gyros that the
    file lacks, with reasons; ``forces`` says what it lacks of accelerometers.
    """
    scales = np.diag(matrix)
    return from_template(
        "imu_tk",
        exported,
        dropped,
        forces,
        misalignment=matrix / scales,
        scale=np.diag(scales),
        offsets=offsets,
        rotation=rotation,
    )


def write_imucal(exported: Exported) -> Written:
    """Return the JSON of a TurntableCalibrationInfo of imucal, for raw samples in m/s^2 and deg/s.

    It holds the constants of both and the sensitivity of the gyros to gravity; a comment names what it lacks.
    UsageError without three gyros and three accelerometers.
    """
    constants, dropped = as_triad(exported, "imucal", (G_SENSITIVITY.name,))
    forces = held_forces(exported, "imucal", triad=True)
    correction = forces.held
    felt = constants.held(G_SENSITIVITY.name)
    per_force_rps = np.zeros((3, 3)) if felt is None else felt / GRAVITY_MPS2
    k_a, r_a = _scale_and_directions(correction.sensitivity)
    k_g, r_g = _scale_and_directions(constants.sensitivity)
    not_held = [*lines_of(dropped), *delay_line(exported), *forces.lines]
    purpose = "Calibration for imucal: samples in m/s^2 and deg/s, along the axes of the body."
    held = {
        "acc_unit": "m/s^2",
        "gyr_unit": "deg/s",
        "from_acc_unit": "m/s^2",
        "from_gyr_unit": "deg/s",
        "comment": "\n".join(line.strip() for line in head(exported, purpose, not_held, "")),
        "K_a": k_a.tolist(),
        "R_a": r_a.tolist(),
        "b_a": (-correction.bias_mps2).tolist(),
        "K_g": k_g.tolist(),
        "R_g": r_g.tolist(),
        "K_ga": np.degrees(per_force_rps).tolist(),
        "b_g": np.degrees(-constants.bias_rps).tolist(),
        "cal_type": "Turntable",
        "_format_version": _IMUCAL_FORMAT,
    }
    return Written(json_text(held), tuple(not_held))


def _scale_and_directions(sensitivity: Floats) -> tuple[Floats, Floats]:
    """Return a diagonal matrix and one with rows of length 1, whose product is ``sensitivity`` (3, 3)."""
    lengths = np.linalg.norm(sensitivity, axis=1)
    return np.diag(lengths), sensitivity / lengths[:, None]
