"""Files of robotics tools: the ROS package imu_calib, Kalibr, OpenVINS.

Sources: imu_calib reads the keys ``SM`` (nine numbers, by rows) and ``bias`` (three) of the accelerometer and puts
out ``SM a - bias``; of the gyros it only takes off the mean of the first samples (github.com/dpkoch/imu_calib,
src/accel_calib/accel_calib.cpp, src/apply_calib.cpp). Kalibr predicts the output of the model "scale-misalignment" as
``M C_gyro_i w + A C_gyro_i a + bias``, with M lower triangular and the bias a function of time that no file holds;
its reader asks for the noise of both sensors. The output of accelerometers is ``M a + bias``, M lower triangular,
which sets the axes of the IMU; in the model "scale-misalignment-size-effect" each one sits at its own place, rx_i,
ry_i, rz_i in these axes, the first at zero (github.com/ethz-asl/kalibr, kalibr_imu_camera_calibration/IccSensors.py,
kalibr_common/ConfigReader.py). OpenVINS takes ``R_IMUtoGYRO^T Dw (output - bias - Tg a)`` for the rate, Dw the lower
triangle of the inverse of Tw, and likewise ``R_IMUtoACC^T Da (output - bias)`` for the specific force a
(github.com/rpng/open_vins, ov_msckf/src/core/VioManagerOptions.h, state/Propagator.cpp); its parser is
cv::FileStorage, which wants the first line %YAML:1.0.
"""

import numpy as np

from estimator.effects.site import G_SENSITIVITY
from estimator.geometry.kinematics import GRAVITY_MPS2
from station.errors import UsageError, sentence
from station.exports.accelerations import ForceCorrection, HeldForces, held_forces, lower_and_rotation
from station.exports.exported import Exported
from station.exports.written import Written, as_triad, from_template


def write_ros(exported: Exported) -> Written:
    """Return a file that imu_calib loads, with the gyros in keys of the same form: gyro_SM y - gyro_bias.

    SM and bias are those of the accelerometers, or leave accelerations as they are if none can be held. UsageError if
    there are not three gyros, CompensationError if they do not span space.
    """
    constants, dropped = as_triad(exported, "imu_calib")
    h = constants.solution
    forces = held_forces(exported, "imu_calib", triad=True)
    force_bias = np.zeros(3)
    if forces.correction is not None:
        force_bias = -forces.correction.solution @ forces.correction.bias_mps2
    return from_template(
        "ros", exported, dropped, forces, solution=h, bias_rps=-h @ constants.bias_rps, force_bias_mps2=force_bias
    )


def write_kalibr(exported: Exported) -> Written:
    """Return an imu.yaml for Kalibr with the intrinsics of its model "scale-misalignment", noise and sample rate.

    If accelerometers are exported and can be held (see ``_forces``), they are in it, too, and the model is
    "scale-misalignment-size-effect". UsageError for gyros that are not three, or form a left-handed triad.
    """
    return _chain(exported, "kalibr", "Kalibr")


def write_openvins(exported: Exported) -> Written:
    """Return a kalibr_imu_chain.yaml for OpenVINS and its model "kalibr", with noise and sample rate.

    Accelerometers that are exported and can be held are in it, too. UsageError as ``write_kalibr``.
    """
    return _chain(exported, "openvins", "OpenVINS")


def _chain(exported: Exported, form: str, called: str) -> Written:
    """Return the file of a model that multiplies a lower triangular matrix and a rotation.

    ``form`` is the template, ``called`` the name of the format in messages. Held are sensitivity, bias, sensitivity to
    gravity and noise, and what ``_forces`` has; the result lists what is not. UsageError unless there are three gyros
    that form a right-handed triad.
    """
    constants, dropped = as_triad(exported, called, (G_SENSITIVITY.name,))
    of_gyros = lower_and_rotation(constants.sensitivity)
    if of_gyros is None:
        raise UsageError(sentence("export.left_handed", form=called))
    m, c = of_gyros
    felt = constants.held(G_SENSITIVITY.name)
    values: dict[str, object] = {"m": m, "c": c, "felt": np.zeros((3, 3)) if felt is None else felt / GRAVITY_MPS2}
    density, walk = _noise(exported)
    values |= {"density": density, "walk": walk, "rate_hz": exported.seen.rate_hz}
    forces, of_forces = _forces(exported, called)
    return from_template(form, exported, dropped, forces, at_rest=-constants.bias_rps, **values, **of_forces)


def _forces(exported: Exported, called: str) -> tuple[HeldForces, dict[str, object]]:
    """Return what a model of a lower triangular matrix and a rotation holds of the accelerometers, and its values.

    The values are empty without accelerometers to export, or if they are left-handed, which a line then says. Places
    count from the first accelerometer, and are zero if unknown. ``called`` names the format.
    """
    forces = held_forces(exported, called, triad=True)
    if forces.correction is None:
        return forces, {}
    found = lower_and_rotation(forces.correction.sensitivity)
    if found is None:
        return HeldForces(lines=(sentence("export.left_handed_accelerometers", form=called),)), {}
    m, rotation = found
    places = np.zeros((len(m), 3))
    if forces.correction.calibration.placed:
        places = np.array([one.place_m for one in forces.correction.accelerometers])
    density, walk = _force_noise(exported, forces.correction)
    return forces, {
        "force_m": m,
        "force_rotation": rotation,
        "force_places": (places - places[0]) @ rotation.T,
        "force_density": density,
        "force_walk": walk,
    }


def _noise(exported: Exported) -> tuple[float, float]:
    """Return angle random walk in rad/s/rtHz and rate random walk in rad/s2/rtHz, rms over the gyros.

    If the noise of any is unknown, the former is derived from the noise of a sample, NaN without a known sample rate,
    and the latter is 0.
    """
    found = [gyro.noise.mean for gyro in exported.gyros if gyro.noise is not None]
    if len(found) == len(exported.gyros):
        return float(np.sqrt(np.mean([n.arw**2 for n in found]))), float(np.sqrt(np.mean([n.walk**2 for n in found])))
    samples = np.sqrt(np.mean([gyro.noise_rps**2 for gyro in exported.gyros]))
    return float(samples / np.sqrt(exported.seen.rate_hz)), 0.0


def _force_noise(exported: Exported, correction: ForceCorrection) -> tuple[float, float]:
    """Return velocity random walk in m/s2/rtHz and acceleration random walk in m/s3/rtHz, rms over the accelerometers.

    If the noise of any is unknown, the former is derived from the noise of a sample, NaN without a known sample rate,
    and the latter is 0.
    """
    found = [one.noise.mean for one in correction.accelerometers if one.noise is not None]
    if len(found) == len(correction.accelerometers):
        return float(np.sqrt(np.mean([n.arw**2 for n in found]))), float(np.sqrt(np.mean([n.walk**2 for n in found])))
    samples = np.sqrt(np.mean([one.noise_mps2**2 for one in correction.accelerometers]))
    return float(samples / np.sqrt(exported.seen.rate_hz)), 0.0
