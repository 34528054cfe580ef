"""Gravity at a site."""

import numpy as np

_EQUATOR_MPS2, _SLOPE, _E2 = 9.7803253359, 0.00193185265241, 0.00669437999013  # WGS 84
_FREE_AIR = 3.086e-6  # m/s2 per metre


def normal_gravity_mps2(latitude_rad: float, height_m: float) -> float:
    """Return normal gravity (WGS 84) at a height above the ellipsoid, less its free-air gradient."""
    square = float(np.sin(latitude_rad)) ** 2
    return _EQUATOR_MPS2 * (1 + _SLOPE * square) / float(np.sqrt(1 - _E2 * square)) - _FREE_AIR * height_m
