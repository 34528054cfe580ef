"""Settings of devices that correct themselves: registers 84 and 25 of VectorNav, bias trim offsets of the STIM300.

Sources: VN-100 User Manual UM001, 6.2.3 Gyro Compensation: ``C (G - B)``, C by rows, then B in rad/s, single
precision; 6.2.2 Acceleration Compensation: the same in m/s2; 3.8.2, checksum. STIM300 datasheet TS1524: bias trim
offsets are added to the outputs, in deg/s with five decimals.
"""

from functools import reduce
from operator import xor

import numpy as np

from drivers.types import Floats
from station.exports.accelerations import held_forces, left_out
from station.exports.exported import Exported
from station.exports.written import Written, as_triad, from_template


def write_vectornav(exported: Exported) -> Written:
    """Return the commands that set and store register 84; the axes stay those that the gyros nominally have.

    Effects beside the constants, and accelerometers if exported, are noted as lacking. UsageError unless there are
    three gyros, CompensationError if they do not span space.
    """
    constants, dropped = as_triad(exported, "register 84 of VectorNav")
    matrix = exported.compensation.array.p @ constants.solution
    commands = _register_commands(84, matrix, -constants.bias_rps)
    forces = left_out(exported, "register 25, --format vectornav-25")
    return from_template("vectornav-84", exported, dropped, forces, commands=commands)


def write_vectornav_force(exported: Exported) -> Written:
    """Return the commands that set and store register 25; the axes stay those that the accelerometers nominally have.

    What else is known of them is noted as lacking. UsageError without three calibrated accelerometers of one source
    that span space.
    """
    forces = held_forces(exported, "register 25 of VectorNav", triad=True)
    correction = forces.held
    commands = _register_commands(25, correction.p @ correction.solution, -correction.bias_mps2)
    return from_template("vectornav-25", exported, {}, forces, commands=commands)


def _register_commands(register: int, matrix: Floats, offsets: Floats) -> list[str]:
    """Return the commands that write a matrix (3, 3) and offsets (3,) to a register, and store the settings."""
    values = ",".join(f"{value:.9f}" for value in (*matrix.ravel(), *offsets))
    return [f"${text}*{reduce(xor, text.encode()):02X}" for text in (f"VNWRG,{register},{values}", "VNWNV")]


def write_stim300(exported: Exported) -> Written:
    """Return the bias trim offset of each gyro in deg/s; all else is noted as lacking.

    UsageError unless there are three gyros.
    """
    constants, dropped = as_triad(exported, "STIM300")
    offsets = list(zip(constants.array.names, np.degrees(constants.bias_rps), strict=True))
    forces = left_out(exported, "this form has none, --format c corrects them")
    return from_template("stim300-trim", exported, dropped, forces, offsets_dps=offsets)
