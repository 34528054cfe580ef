"""What is told of a calibration against another instrument: an attitude, a rate, an encoder."""

from typing import TypeGuard

import numpy as np

from estimator.arrays import Floats
from estimator.recording import Recording
from estimator.reference import AttitudeReadings, RateReadings, Reference, rates_from_attitude
from estimator.rests import REST_RPS

CLUSTER_S = 5.0
"""Length over which residuals against a foreign reference may hang together without the sigma being wrong."""
FEWEST_CLUSTERS = 8
COLOURED = 2.0  # sigmas that grow by more than this are told
_TURNED = 1e-3  # share of the largest mean square rate from which on a direction counts as turned about
_FAR_OFF = 0.2  # a factor of the output this far from 1 is a wrong sign, unit or count


def at_rest(reference: Reference) -> TypeGuard[RateReadings]:
    """Return whether a reference says of no instant that the body turned (faster than the Earth)."""
    if not isinstance(reference, RateReadings):
        return False
    rate = reference.rate_rps[np.isfinite(reference.rate_rps).all(axis=1)]
    return bool(len(rate) and (np.abs(rate) < REST_RPS).all())


def foreign_motion_notes(recording: Recording) -> list[str]:
    """Return what the motion that a rate or an attitude shows leaves unseen, in words."""
    reference = recording.reference
    if at_rest(reference):
        return [
            "the body rests wherever the reference knows of it: only the bias can be estimated; scale factor error and "
            "misalignments need turns about three axes"
        ]
    if not isinstance(reference, (RateReadings, AttitudeReadings)):
        return []
    rates = rates_from_attitude(reference) if isinstance(reference, AttitudeReadings) else reference
    rate = rates.rate_rps[np.isfinite(rates.rate_rps).all(axis=1)]
    if not len(rate):
        return []
    square, directions = np.linalg.eigh(rate.T @ rate)
    turned = directions[:, square > _TURNED * square[-1]].T
    if len(turned) > 2:
        return []
    what = " and ".join(_axis_words(direction) for direction in turned)
    return [
        f"the body turns about {what} only: of each gyro the bias and its sensitivity to such turns can be estimated "
        "(k of a gyro along that axis), not k, sigma_j and sigma_k each by itself; turn about all three axes"
    ]


def _axis_words(direction: Floats) -> str:
    largest = int(np.argmax(np.abs(direction)))
    if abs(direction[largest]) > 0.99:
        return "xyz"[largest]
    sign = np.sign(direction[largest])
    return "(" + ", ".join(f"{v:.2f}" for v in sign * direction) + ")"


def factor_notes(name: str, k: float, sd: float) -> list[str]:
    """Return, in words, that k is no scale factor error but a wrong sign or unit, if it is."""
    if abs(k) < _FAR_OFF + 3 * sd:
        return []
    if abs(k - 2) < _FAR_OFF:
        return [f"{name}: its output is opposite to the reference, so k is near 2: turn the sign of its axis"]
    return [
        f"{name}: its output is {1 - k:.3g} times what the reference says, which is no scale factor error of a gyro: "
        "check its unit, its count and its axis"
    ]
