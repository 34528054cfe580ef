"""What the paper prints (Li, Guo, Ge, Cheng 2020), in its own units and order: b, k, sigma_j, sigma_k.

Where it contradicts itself is worked out from these numbers, so that a note can never say more than they do.
"""

import numpy as np

from drivers.arrays import Floats
from estimator.array import SensorArray

NAMES = ("b", "k", "sigma_j", "sigma_k")
UNITS = ("deg/s", "ppm", "deg", "deg")

TABLE_1 = np.array([0.1, 5000.0, 0.1, -0.1])
"""Set values, the same for each gyro."""
TABLE_2 = np.array(
    [
        [0.0021, 5.0, 0.0012, 0.0009],
        [0.0014, 6.0, 0.0150, 0.0018],
        [0.0023, 9.0, 0.0024, 0.0013],
        [0.0016, 11.0, 0.0170, 0.0020],
    ]
)
"""Errors at the end, one row a gyro."""
TABLE_3 = np.array([0.87, 0.42, 0.64, 0.73])
"""Mean relative errors in percent."""
TABLE_4 = np.array([14.61, 13.57, 10.25, 9.33])
"""The same of a six-position calibration, taken from its reference [11]."""
CLAIMED_GAIN = 11.37
"""By how many percent the paper says that it is better than Table 4, on average."""
CLAIMED_MEAN_MISALIGNMENT_DEG = 0.0025
"""Below this, its text says, are the mean errors of both misalignments."""
RATE_DPS = 20.0
LATITUDE_DEG = 45.0
NOISE_DPH = 1e-3
"""Standard deviation of one of its samples."""
SAMPLE_HZ = 100.0


def from_si(states: Floats) -> Floats:
    """Return states or errors (..., 4), in the order and units of ``estimator.model.STATES``, as the paper prints."""
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


def contradictions(bias_sd_dps: float) -> list[str]:
    """Return where the paper's own numbers disagree; ``bias_sd_dps`` is what its noise leaves of a bias."""
    gains = TABLE_4 - TABLE_3
    from_table_2 = relative_percent(TABLE_2)
    ratios = ", ".join(f"{name} {a:.3g} %" for name, a in zip(NAMES, from_table_2, strict=True))
    printed = ", ".join(f"{name} {a:g} %" for name, a in zip(NAMES, TABLE_3, strict=True))
    means = TABLE_2.mean(axis=0)
    signs = _balanced_signs(TABLE_2[:, 0])
    notes = [
        f"Table 4 less Table 3 is {gains.mean():.3f} % on average, not {CLAIMED_GAIN} %.",
        f"Table 2 over Table 1 gives {ratios}; Table 3 prints {printed}.",
        f"The text has both mean misalignment errors below {CLAIMED_MEAN_MISALIGNMENT_DEG} deg; Table 2 has "
        f"{means[2]:.4f} deg for sigma_j ({TABLE_2[1, 2]:.4f} and {TABLE_2[3, 2]:.4f} among them) and "
        f"{means[3]:.4f} deg for sigma_k.",
        f"Noise of {NOISE_DPH:g} deg/h a sample leaves a bias known to {bias_sd_dps:.1e} deg/s; Table 2 has "
        f"{TABLE_2[:, 0].min():.4f} to {TABLE_2[:, 0].max():.4f} deg/s: something its model lacks was in its data.",
        "Table 4 is from another work (its reference [11]: six gyros on a dodecahedron), so Table 3 against Table 4 "
        "is no comparison on like data; `station study baselines` makes one.",
    ]
    if signs is not None:
        marks = " ".join("+" if s > 0 else "-" for s in signs)
        length = np.sqrt(0.75 * np.sum(TABLE_2[:, 0] ** 2))  # rows of the tetrahedron: P'P = 4/3
        notes.append(
            f"With signs {marks} its four bias errors add up to zero, as the shares of one constant rate on a "
            f"tetrahedron do; that rate would be {3600 * length:.1f} deg/h (the Earth's is 15.04 deg/h). Chance can do "
            "so too."
        )
    return notes


def errata(printed: SensorArray) -> list[str]:
    """Return what is wrong with the axes as printed (eq. 14-16)."""
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
    for code in range(1 << (len(values) - 1)):
        signs = (1, *(1 if code >> i & 1 else -1 for i in range(len(values) - 1)))
        if abs(float(np.dot(signs, values))) < 5e-5:
            return signs
    return None
