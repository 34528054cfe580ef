"""What the paper prints (Li, Guo, Ge, Cheng 2020), in its own units and order: b, k, sigma_j, sigma_k.

Its inconsistencies are computed from these numbers.
"""

from itertools import product

import numpy as np

from drivers.packaged import packaged_toml
from drivers.types import Floats
from estimator.geometry.array import SensorArray, sensor_array

NAMES = ("b", "k", "sigma_j", "sigma_k")
UNITS = ("deg/s", "ppm", "deg", "deg")

_PRINTED = packaged_toml("station.studies", "published.toml")
TABLE_1: Floats = np.array(_PRINTED["table_1"])
"""Set values (4,)."""
TABLE_2: Floats = np.array(_PRINTED["table_2"])
"""Errors at the end of its run (gyros, 4)."""
TABLE_3: Floats = np.array(_PRINTED["table_3"])
"""Mean relative errors (4,) in percent."""
TABLE_4: Floats = np.array(_PRINTED["table_4"])
"""The same of its reference [11]."""
RATE_DPS = float(_PRINTED["rate_dps"])
LATITUDE_DEG = float(_PRINTED["latitude_deg"])
NOISE_DPH = float(_PRINTED["noise_dph"])
SAMPLE_HZ = float(_PRINTED["sample_hz"])


def tetrahedron_as_printed() -> SensorArray:
    """Return eq. 14-16 digit for digit, misprinted J and K included."""
    p: list[list[float]] = [[0, 0, -1], [0.9428, 0, 0.3333], [-0.4714, 0.8165, 0.3333], [-0.4714, -0.8165, 0.3333]]
    j: list[list[float]] = [[1, 0, 0], [-0.3333, 0, 0.9428], [-0.1667, 0.2887, 0.9428], [-0.1667, -0.2887, 0.9428]]
    k: list[list[float]] = [[0, 1, 0], [0, 1, 0], [0.8660, 0.5, 0], [-0.8660, 0.5, 0]]
    return sensor_array(p, j, k, as_printed=True)


def from_si(states: Floats) -> Floats:
    """Return states or errors (..., 4), in the order and units of ``STATES``, as the paper prints them."""
    k, b, sigma_j, sigma_k = np.moveaxis(states, -1, 0)
    return np.stack([np.degrees(b), 1e6 * k, np.degrees(sigma_j), np.degrees(sigma_k)], axis=-1)


def to_si(states: Floats) -> Floats:
    """Return what ``from_si`` was given (..., 4)."""
    b, k, sigma_j, sigma_k = np.moveaxis(states, -1, 0)
    return np.stack([1e-6 * k, np.radians(b), np.radians(sigma_j), np.radians(sigma_k)], axis=-1)


def relative_percent(errors: Floats) -> Floats:
    """Return the mean relative error (4,) in percent of errors (..., 4) in the paper's units."""
    shares = np.abs(errors / TABLE_1).reshape(-1, 4)
    return np.asarray(100 * shares.mean(axis=0))


def inconsistencies(bias_sd_dps: float) -> list[str]:
    """Return sentences on where the paper's own numbers disagree.

    ``bias_sd_dps`` is the standard deviation in deg/s that its noise leaves of a bias. A last sentence is there only if
    the printed bias errors add up to zero with suitable signs.
    """
    gain = (TABLE_4 - TABLE_3).mean()
    claimed = _PRINTED["claimed"]
    from_table_2 = _by_state(relative_percent(TABLE_2), ".3g")
    means = TABLE_2.mean(axis=0)
    biases = np.abs(TABLE_2[:, 0])
    notes = [
        f"Table 4 less Table 3 is {gain:.3f} % on average, not {claimed['gain']} %.",
        f"Table 2 over Table 1 gives {from_table_2}; Table 3 prints {_by_state(TABLE_3, 'g')}.",
        f"The text has both mean misalignment errors below {claimed['misalignment_deg']} deg. "
        f"Table 2 has {means[2]:.4f} deg for sigma_j ({TABLE_2[1, 2]:.4f} and {TABLE_2[3, 2]:.4f} among them) "
        f"and {means[3]:.4f} deg for sigma_k.",
        f"Noise of {NOISE_DPH:g} deg/h a sample leaves a bias known to {bias_sd_dps:.1e} deg/s. "
        f"Table 2 has {biases.min():.4f} to {biases.max():.4f} deg/s: its data held something that its model lacks.",
        "Table 4 is from another work (its reference [11]: six gyros on a dodecahedron), so Table 3 and Table 4 do not "
        "compare methods on the same data. `station study baselines` does.",
    ]
    signs = _balanced_signs(TABLE_2[:, 0])
    if signs is not None:
        common_dph = 3600 * np.sqrt(0.75 * np.sum(TABLE_2[:, 0] ** 2))  # rows of the tetrahedron: P'P = 4/3
        shown = " ".join("+" if sign > 0 else "-" for sign in signs)
        notes.append(
            f"With signs {shown} its four bias errors add up to zero, as the shares of one constant rate on a "
            f"tetrahedron do. That rate would be {common_dph:.1f} deg/h (the Earth's is 15.04 deg/h). It may be chance."
        )
    return notes


def _by_state(values: Floats, form: str) -> str:
    """Return percentages (4,) with the names of their states."""
    return ", ".join(f"{name} {value:{form}} %" for name, value in zip(NAMES, values, strict=True))


def errata(printed: SensorArray) -> list[str]:
    """Return what is wrong with the axes as printed (eq. 14-16): right angles and handedness, one sentence each."""
    cosines = np.einsum("ij,ij->i", printed.p, printed.j)
    handed = np.linalg.det(np.stack([printed.p, printed.j, printed.k], axis=1))
    skew = [f"p.j = {c:.3f} for {name}" for name, c in zip(printed.names, cosines, strict=True) if abs(c) > 1e-3]
    left = [name for name, h in zip(printed.names, handed, strict=True) if h < 0]
    right = [name for name in printed.names if name not in left]
    return [
        f"The printed J is not at right angles to P: {', '.join(skew)} (signs of x and y flipped).",
        f"The printed triads (p, j, k) are left-handed for {', '.join(left)} and right-handed for {', '.join(right)}, "
        "so a positive sigma does not mean the same turn on each gyro.",
    ]


def _balanced_signs(values: Floats) -> tuple[int, ...] | None:
    """Return signs, the first plus, under which the values add up to zero to their last digit, if there are any."""
    every = ((1, *signs) for signs in product((-1, 1), repeat=len(values) - 1))
    return next((signs for signs in every if abs(float(np.dot(signs, values))) < 5e-5), None)
