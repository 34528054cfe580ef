"""Spectra of white noise, flicker noise and random walk of evenly sampled data, in the order N, B, K.

N is the random walk of the integral (angle or velocity random walk, unit/rtHz), B the bias instability (unit), K the
random walk of the output itself (unit/rts). Two-sided density: ``N^2 + B^2 / (2 pi f) + K^2 / (2 pi f)^2`` (IEEE Std
952, Annex C).
"""

import numpy as np
from numpy.typing import NDArray

from estimator.types import Floats

TERMS = ("N", "B", "K")
"""Names of the terms, in the order of every array of them."""
_SINGLE = 12  # each of the lowest frequencies has a band of its own, up to this number
_BANDS_A_DECADE = 8
_IMAGES = 3  # to each side, of frequencies that means of continuous noise fold back


def sampled_densities(theta: Floats, period_s: float) -> Floats:
    """Return the spectra (f, 3) of samples with unit N, B and K at angular frequencies (f,) in rad per sample.

    White noise of one sample has the variance ``1 / period_s``. The random walk is a cumulative sum of such steps,
    flicker noise its half integral.
    """
    step = 2 * np.sin(theta / 2)
    return np.column_stack([np.full_like(theta, 1 / period_s), 1 / step, period_s / step**2])


def allan_variances(tau_s: Floats) -> Floats:
    """Return the Allan variances (t, 3) of unit N, B and K at averaging times (t,)."""
    return np.column_stack([1 / tau_s, np.full_like(tau_s, 2 * np.log(2) / np.pi), tau_s / 3])


def cosine_variances(numbers: NDArray[np.intp], count: int, period_s: float, width: int = 1) -> Floats:
    """Return the variances (k, 3), for unit N, B and K, of coefficients of the orthonormal cosine transform.

    ``numbers`` (k,) are the indices of the coefficients, from 1, of ``count`` means over ``width`` samples each,
    ``period_s`` apart. White noise and walk are independent between coefficients; flicker noise has correlations of at
    most 0.12, and the variance ``2/pi Si(pi k) - 4 / (pi^2 k) for odd k`` relative to its density there. Means are
    those of continuous flicker noise.
    """
    from scipy.special import sici

    theta = np.pi * numbers / count
    step = 2 * np.sin(theta / 2)
    odd = numbers % 2 == 1
    ends = 2 / np.pi * sici(np.pi * numbers)[0] - np.where(odd, 4 / (np.pi**2 * numbers), 0.0)
    flicker = 1 / step
    if width > 1:
        images = np.abs(theta[:, None] + 2 * np.pi * np.arange(-_IMAGES, _IMAGES + 1))
        flicker = step**2 * np.sum(images**-3.0, axis=1)
    steps = (2 * width**2 + 1 + (width**2 - 1) * np.cos(theta)) / (3 * width**2)  # differences of means of a walk
    white = np.full(len(numbers), 1 / period_s)
    return np.column_stack([white, ends * flicker, period_s * steps / step**2])


def band_of(numbers: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return the band (k,) that each coefficient falls into: one for each of the lowest, eight a decade above."""
    above = _SINGLE + np.floor(_BANDS_A_DECADE * np.log10(np.maximum(numbers, _SINGLE) / _SINGLE)).astype(np.intp)
    _, band = np.unique(np.where(numbers < _SINGLE, numbers, above), return_inverse=True)
    return np.asarray(band, dtype=np.intp)
