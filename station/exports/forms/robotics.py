"""Files of robotics tools: the ROS package imu_calib, Kalibr, OpenVINS.

Sources: imu_calib reads the keys ``SM`` (nine numbers, by rows) and ``bias`` (three) of the accelerometer and puts out
``SM a - bias``; of the gyros it only takes off the mean of the first samples (github.com/dpkoch/imu_calib,
src/accel_calib/accel_calib.cpp, src/apply_calib.cpp). Kalibr predicts the output of the model "scale-misalignment" as
``M C_gyro_i w + A C_gyro_i a + bias``, with M lower triangular and the bias a function of time that no file holds; its
reader asks for the noise of both sensors (github.com/ethz-asl/kalibr, kalibr_imu_camera_calibration/IccSensors.py,
kalibr_common/ConfigReader.py). OpenVINS takes ``R_IMUtoGYRO^T Dw (output - bias - Tg a)`` for the rate, Dw the lower
triangle of the inverse of Tw (github.com/rpng/open_vins, ov_msckf/src/core/VioManagerOptions.h, state/Propagator.cpp);
its parser is cv::FileStorage, which wants the first line %YAML:1.0.
"""

import numpy as np

from drivers.types import Floats
from estimator.effects.site import G_SENSITIVITY
from estimator.geometry.kinematics import GRAVITY_MPS2
from station.errors import UsageError, sentence
from station.exports.exported import Exported
from station.exports.written import Written, as_triad, from_template


def write_ros(exported: Exported) -> Written:
    """Return a file that imu_calib loads, with the gyros in keys of the same form: gyro_SM y - gyro_bias."""
    constants, dropped = as_triad(exported, "imu_calib")
    h = constants.solution
    return from_template("ros", exported, dropped, solution=h, bias_rps=-h @ constants.bias_rps)


def write_kalibr(exported: Exported) -> Written:
    """Return an imu.yaml for Kalibr with the intrinsics of its model "scale-misalignment".

    Raises UsageError for gyros that are not three, or form a left-handed triad.
    """
    return _chain(exported, "kalibr", "Kalibr")


def write_openvins(exported: Exported) -> Written:
    """Return a kalibr_imu_chain.yaml for OpenVINS and its model "kalibr"; UsageError as ``write_kalibr``."""
    return _chain(exported, "openvins", "OpenVINS")


def _chain(exported: Exported, form: str, called: str) -> Written:
    """Return the file of a model that multiplies a lower triangular matrix and a rotation; UsageError without three
    gyros.

    ``form`` is the template, ``called`` the name of the format in messages. Held are sensitivity, bias, sensitivity to
    gravity and noise; the result lists what is not.
    """
    constants, dropped = as_triad(exported, called, (G_SENSITIVITY.name,))
    m, c = _lower_and_rotation(constants.sensitivity, called)
    felt = constants.held(G_SENSITIVITY.name)
    values: dict[str, object] = {"m": m, "c": c, "felt": np.zeros((3, 3)) if felt is None else felt / GRAVITY_MPS2}
    density, walk = _noise(exported)
    values |= {"density": density, "walk": walk, "rate_hz": exported.seen.rate_hz}
    return from_template(form, exported, dropped, at_rest=-constants.bias_rps, **values)


def _lower_and_rotation(sensitivity: Floats, form: str) -> tuple[Floats, Floats]:
    """Return a lower triangular matrix with positive diagonal and a rotation, whose product is ``sensitivity`` (3, 3).

    UsageError, which names ``form``, if it is left-handed.
    """
    q, r = np.linalg.qr(sensitivity.T)
    signs = np.sign(np.diag(r))
    rotation = (q * signs).T
    if np.linalg.det(rotation) < 0:
        raise UsageError(sentence("export.left_handed", form=form))
    return r.T * signs + 0.0, rotation  # no minus zeros


def _noise(exported: Exported) -> tuple[float, float]:
    """Return angle random walk in rad/s/rtHz and rate random walk in rad/s2/rtHz, rms over the gyros."""
    found = [gyro.noise.mean for gyro in exported.gyros if gyro.noise is not None]
    if len(found) == len(exported.gyros):
        return float(np.sqrt(np.mean([n.arw**2 for n in found]))), float(np.sqrt(np.mean([n.walk**2 for n in found])))
    samples = np.sqrt(np.mean([gyro.noise_rps**2 for gyro in exported.gyros]))
    return float(samples / np.sqrt(exported.seen.rate_hz)), 0.0
