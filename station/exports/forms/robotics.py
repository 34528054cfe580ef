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
from station.errors import UsageError
from station.exports.exported import Exported
from station.exports.written import Written, as_triad, delay_line, head, lines_of, number, yaml_text

_LACKING = ("#accelerometer_noise_density: m/s^2/sqrt(Hz)", "#accelerometer_random_walk: m/s^3/sqrt(Hz)")


def write_ros(exported: Exported) -> Written:
    """Return a file that imu_calib loads, with the gyros in keys of the same form: gyro_SM y - gyro_bias."""
    constants, dropped = as_triad(exported, "imu_calib")
    solution = constants.solution
    not_held = [
        "accelerometer: not calibrated here; SM and bias leave it as it is",
        "imu_calib itself does not read gyro_SM and gyro_bias: its node takes off the mean of the first 100 samples at "
        "rest, scale and misalignment of gyros not at all; apply them where you read this file",
        *lines_of(dropped),
        *delay_line(exported),
    ]
    content = {
        "SM": np.eye(3).ravel().tolist(),
        "bias": [0.0, 0.0, 0.0],
        "gyro_SM": solution.ravel().tolist(),
        "gyro_bias": (-solution @ constants.bias_rps).tolist(),
    }
    what = "imu_calib: corrected = SM raw - bias, SM by rows; gyros likewise: gyro_SM raw - gyro_bias (rad/s)"
    return Written("\n".join([*head(exported, what, not_held, "#"), yaml_text(content)]), tuple(not_held))


def write_kalibr(exported: Exported) -> Written:
    """Return an imu.yaml for Kalibr with the intrinsics of its model "scale-misalignment".

    Raises UsageError for gyros that are not three, or form a left-handed triad.
    """
    what = "Kalibr, model scale-misalignment: output = M C_gyro_i w + A C_gyro_i a + bias (rad/s, m/s2)"
    common, m, c, felt, not_held = _chain(
        exported, "Kalibr", "time_offset is zero: Kalibr counts it from its first IMU"
    )
    eye = np.eye(3).tolist()
    gyros = {"M": m.tolist(), "C_gyro_i": c.tolist(), "A": (felt @ c.T).tolist()}
    content = common | {"model": "scale-misalignment", "accelerometers": {"M": eye}, "gyroscopes": gyros}
    return Written("\n".join([*head(exported, what, not_held, "#"), *_LACKING, yaml_text(content)]), tuple(not_held))


def write_openvins(exported: Exported) -> Written:
    """Return a kalibr_imu_chain.yaml for OpenVINS and its model "kalibr"; UsageError as ``write_kalibr``."""
    what = "OpenVINS, model kalibr: output = Tw R_IMUtoGYRO w + Tg a + bias (rad/s, m/s2)"
    common, m, c, felt, not_held = _chain(exported, "OpenVINS", "it is part of timeshift_cam_imu of the cameras")
    eye = np.eye(3).tolist()
    gyros = {"Tw": m.tolist(), "R_IMUtoGYRO": c.tolist(), "Tg": felt.tolist()}
    content = {"imu0": common | {"model": "kalibr", "Ta": eye, "R_IMUtoACC": eye} | gyros}
    lines = ["%YAML:1.0", *head(exported, what, not_held, "#"), *_LACKING, yaml_text(content)]
    return Written("\n".join(lines), tuple(not_held))


def _chain(exported: Exported, form: str, delay: str) -> tuple[dict[str, object], Floats, Floats, Floats, list[str]]:
    """Return what both files have, M and C (3, 3) of output = M C w + G a + bias, G per m/s2, and what they lack."""
    constants, dropped = as_triad(exported, form, (G_SENSITIVITY.name,))
    m, c = _lower_and_rotation(constants.sensitivity, form)
    felt = constants.held(G_SENSITIVITY.name)
    bias = ", ".join(number(-b) for b in constants.bias_rps)
    not_held = [
        f"bias: {form} finds its own; here the outputs at rest are [{bias}] rad/s, in its sign",
        "accelerometer: not calibrated here; put in accelerometer_noise_density and accelerometer_random_walk (data "
        "sheet), and rostopic",
        *lines_of(dropped),
        *delay_line(exported, delay),
    ]
    density, walk = _noise(exported)
    common: dict[str, object] = {
        "rostopic": "/imu0",
        "update_rate": exported.seen.rate_hz,
        "gyroscope_noise_density": density,
        "gyroscope_random_walk": walk,
        "T_i_b": np.eye(4).tolist(),
        "time_offset": 0.0,
    }
    return common, m, c, np.zeros((3, 3)) if felt is None else felt / GRAVITY_MPS2, not_held


def _lower_and_rotation(sensitivity: Floats, form: str) -> tuple[Floats, Floats]:
    """Return a lower triangular matrix with positive diagonal and a rotation whose product is ``sensitivity``."""
    q, r = np.linalg.qr(sensitivity.T)
    signs = np.sign(np.diag(r))
    rotation = (q * signs).T
    if np.linalg.det(rotation) < 0:
        raise UsageError(
            f"{form} holds right-handed triads, and these gyros in their order form a left-handed one: put them in "
            "another order in the bench file, or use `--format c`"
        )
    return r.T * signs + 0.0, rotation  # no minus zeros


def _noise(exported: Exported) -> tuple[float, float]:
    """Return angle random walk in rad/s/rtHz and rate random walk in rad/s2/rtHz, rms over the gyros."""
    found = [gyro.noise.mean for gyro in exported.gyros if gyro.noise is not None]
    if len(found) == len(exported.gyros):
        return float(np.sqrt(np.mean([n.arw**2 for n in found]))), float(np.sqrt(np.mean([n.walk**2 for n in found])))
    samples = np.sqrt(np.mean([gyro.noise_rps**2 for gyro in exported.gyros]))
    return float(samples / np.sqrt(exported.seen.rate_hz)), 0.0
