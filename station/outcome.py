"""How a run ended, and whether its calibration is within limits."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from estimator.calibration import Calibration
from station.bench import Limits

_DEG = 180 / np.pi


class Outcome(StrEnum):
    """How a run ended."""

    PASS = "PASS"
    FAIL = "FAIL"
    ABORTED = "ABORTED"
    FAULT = "FAULT"

    @property
    def exit_code(self) -> int:
        """Exit code of the command that ended so."""
        return {"PASS": 0, "FAIL": 1, "ABORTED": 3, "FAULT": 4}[self.value]


@dataclass(frozen=True, slots=True)
class Verdict:
    """Outcome and reason of a run or of a calibration."""

    outcome: Outcome
    reason: str


def judge(calibration: Calibration, limits: Limits) -> Verdict:
    """Compare a calibration with the limits of its bench; the reason names every limit that is broken."""
    broken = [f"{gyro.name} is not estimated: {gyro.reason}" for gyro in calibration.excluded]
    sizes = (limits.k, limits.b_rps, limits.sigma_rad, limits.sigma_rad)
    doubts = (limits.sd_k, limits.sd_b_rps, limits.sd_sigma_rad, limits.sd_sigma_rad)
    units = ((1e6, "ppm"), (_DEG, "deg/s"), (_DEG, "deg"), (_DEG, "deg"))
    doubt_units = ((1e6, "ppm"), (_DEG * 3600, "deg/h"), (1e6, "urad"), (1e6, "urad"))
    names = ("k", "b", "sigma_j", "sigma_k")
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
    if not limits.nis_low <= calibration.nis_mean <= limits.nis_high and np.isfinite(calibration.nis_mean):
        broken.append(
            f"mean NIS {calibration.nis_mean:.3f} outside {limits.nis_low:g} to {limits.nis_high:g}: "
            "the noise or the model is not what was assumed"
        )
    share = calibration.lost / max(calibration.samples + calibration.lost, 1)
    if share > limits.lost:
        broken.append(f"{share:.2%} of the samples lost > {limits.lost:.2%}")
    if broken:
        return Verdict(Outcome.FAIL, "; ".join(broken))
    return Verdict(Outcome.PASS, "every state, its sigma, the innovations and the losses are within limits")
