"""What the paper prints (Li, Guo, Ge, Cheng 2020), in its own units and order: b, k, sigma_j, sigma_k.

Where it contradicts itself is worked out from these numbers, so that a note can never say more than they do.
"""

from collections.abc import Mapping
from itertools import product
from typing import Any

import numpy as np

from drivers.packaged import packaged_toml
from drivers.types import Floats
from estimator.geometry.array import SensorArray, sensor_array
from station.render.template import rendered

NAMES = ("b", "k", "sigma_j", "sigma_k")
UNITS = ("deg/s", "ppm", "deg", "deg")

_PRINTED = packaged_toml("paper_study", "paper.toml")
TABLE_1, TABLE_2, TABLE_3, TABLE_4 = (np.array(_PRINTED[f"table_{number}"]) for number in (1, 2, 3, 4))
"""Set values (4,), errors at the end (gyros, 4), mean relative errors (4,) of the paper and of its reference [11]."""
RATE_DPS, LATITUDE_DEG, NOISE_DPH, SAMPLE_HZ = (
    float(_PRINTED[key]) for key in ("rate_dps", "latitude_deg", "noise_dph", "sample_hz")
)


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


def contradictions(bias_sd_dps: float) -> list[str]:
    """Return where the paper's own numbers disagree; ``bias_sd_dps`` is what its noise leaves of a bias."""
    # Rows of the tetrahedron: P'P = 4/3.
    common_dph = 3600 * np.sqrt(0.75 * np.sum(TABLE_2[:, 0] ** 2))
    values = {
        "names": NAMES,
        "table_2": TABLE_2,
        "table_3": TABLE_3,
        "from_table_2": relative_percent(TABLE_2),
        "means": TABLE_2.mean(axis=0),
        "gain": (TABLE_4 - TABLE_3).mean(),
        "claimed_gain": _PRINTED["claimed"]["gain"],
        "claimed_misalignment_deg": _PRINTED["claimed"]["misalignment_deg"],
        "noise_dph": NOISE_DPH,
        "bias_sd_dps": bias_sd_dps,
        "signs": _balanced_signs(TABLE_2[:, 0]),
        "common_dph": common_dph,
    }
    return sentences("contradictions.txt", values)


def sentences(name: str, values: Mapping[str, Any]) -> list[str]:
    """Return the lines of a template of the studies."""
    return rendered("paper_study", name, {"format": format, **values}).splitlines()


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
    every = ((1, *signs) for signs in product((-1, 1), repeat=len(values) - 1))
    return next((signs for signs in every if abs(float(np.dot(signs, values))) < 5e-5), None)
