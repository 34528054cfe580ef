"""Settings of devices that correct themselves: register 84 of VectorNav, bias trim offsets of the STIM300.

Sources: VN-100 User Manual UM001, 6.2.3 Gyro Compensation: ``C (G - B)``, C by rows, then B in rad/s, single precision;
3.8.2, checksum. STIM300 datasheet TS1524: bias trim offsets are added to the outputs, in deg/s with five decimals.
"""

from functools import reduce
from operator import xor

import numpy as np

from station.exports.exported import Exported
from station.exports.written import Written, as_triad, from_template


def write_vectornav(exported: Exported) -> Written:
    """Return the commands that set and store register 84; the axes stay those that the gyros nominally have."""
    constants, dropped = as_triad(exported, "register 84 of VectorNav")
    matrix = exported.compensation.array.p @ constants.solution
    values = ",".join(f"{value:.9f}" for value in (*matrix.ravel(), *-constants.bias_rps))
    commands = [f"${text}*{reduce(xor, text.encode()):02X}" for text in (f"VNWRG,84,{values}", "VNWNV")]
    return from_template("vectornav-84", exported, dropped, commands=commands)


def write_stim300(exported: Exported) -> Written:
    """Return the bias trim offset of each gyro in deg/s."""
    constants, dropped = as_triad(exported, "STIM300")
    offsets = list(zip(constants.array.names, np.degrees(constants.bias_rps), strict=True))
    return from_template("stim300-trim", exported, dropped, offsets_dps=offsets)
