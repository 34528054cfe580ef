"""How a run ended, and whether its calibration is within limits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from estimator.calibration.budget import UNSEEN
from estimator.calibration.values import Calibration, GyroCalibration
from station.bench.bench import Limits

_DEG = 180 / np.pi
_MOSTLY = 0.5


class Outcome(StrEnum):
    """How a run ended."""

    PASS = "PASS"
    ESTIMATED = "ESTIMATED"
    FAIL = "FAIL"
    ABORTED = "ABORTED"
    FAULT = "FAULT"

    @property
    def exit_code(self) -> int:
        """Exit code of the command that ended so."""
        return {"PASS": 0, "ESTIMATED": 0, "FAIL": 1, "ABORTED": 3, "FAULT": 4}[self.value]


@dataclass(frozen=True, slots=True)
class Verdict:
    """Outcome and reason of a run or of a calibration."""

    outcome: Outcome
    reason: str


def judge(calibration: Calibration, limits: Limits | None, causes: Sequence[str] = ()) -> Verdict:
    """Compare a calibration with the limits of its bench; the reason names every limit that is broken.

    Without limits it is neither good nor bad. What speaks against its sigmas is told in any case, ``causes``, what the
    run itself may have done wrong, where a limit is broken.
    """
    if limits is None or not limits.stated:
        reasons = ("estimated; there are no limits to judge by", *calibration.doubts)
        return Verdict(Outcome.ESTIMATED, "; ".join(reasons))
    broken = [f"{gyro.name} is not estimated: {gyro.reason}" for gyro in calibration.excluded]
    sizes = (limits.k, limits.b_rps, limits.sigma_rad, limits.sigma_rad)
    doubts = (limits.sd_k, limits.sd_b_rps, limits.sd_sigma_rad, limits.sd_sigma_rad)
    units = ((1e6, "ppm"), (_DEG, "deg/s"), (_DEG, "deg"), (_DEG, "deg"))
    doubt_units = ((1e6, "ppm"), (_DEG * 3600, "deg/h"), (1e6, "urad"), (1e6, "urad"))
    names = ("k", "b", "sigma_j", "sigma_k")
    unseen = False
    for gyro in calibration.gyros:
        for i, name in enumerate(names):
            value, doubt = abs(gyro.states[i]), gyro.sd[i]
            if not value <= sizes[i]:
                factor, unit = units[i]
                broken.append(f"{gyro.name} {name} {value * factor:.4g} {unit} > {sizes[i] * factor:.4g} {unit}")
            if not doubt <= doubts[i]:
                factor, unit = doubt_units[i]
                broken.append(
                    f"{gyro.name} sigma of {name} {doubt * factor:.4g} {unit} > {doubts[i] * factor:.4g} {unit}"
                )
                unseen |= _mostly_unseen(gyro, i)
    if not limits.nis_low <= calibration.nis_mean <= limits.nis_high and np.isfinite(calibration.nis_mean):
        broken.append(
            f"mean NIS {calibration.nis_mean:.3f} outside {limits.nis_low:g} to {limits.nis_high:g}: "
            "the noise or the model is not what was assumed"
        )
    share = calibration.lost / max(calibration.samples + calibration.lost, 1)
    if share > limits.lost:
        broken.append(f"{share:.2%} of the samples lost > {limits.lost:.2%}")
    if unseen:
        broken.append(
            "these sigmas are mostly effects that this script cannot show: the section undeclared of the bench file "
            "says which are ruled out"
        )
    if broken:
        return Verdict(Outcome.FAIL, "; ".join([*broken, *causes, *calibration.doubts]))
    good = "every state, its sigma, the innovations and the losses are within limits"
    return Verdict(Outcome.PASS, "; but ".join([good, *calibration.doubts]))


def _mostly_unseen(gyro: GyroCalibration, state: int) -> bool:
    """Return whether a sigma comes of undeclared effects for the most part."""
    unseen = sum(float(line.u[state] ** 2) for line in gyro.budget if line.name == UNSEEN)
    return unseen > _MOSTLY * float(gyro.sd[state] ** 2)
