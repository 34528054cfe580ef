"""What the angles of a table say against its own rates: an encoder that jumped, a rate of the wrong sign or scale."""

import numpy as np

from estimator.recordings.reference import TableReadings
from estimator.types import Floats

_JUMP_RAD = float(np.radians(0.3))
_TURNING_RPS = float(np.radians(1.0))
_GAP = 3.0  # times the usual step between readings
_FEWEST = 20
_WELL_S = 1e-3  # to which an instant needs to be known
_SHARE, _SIGMAS = 0.003, 5.0  # by which, and by how many of its sigmas, a scale must be off


def reading_doubts(readings: TableReadings) -> tuple[str, ...]:
    """Return what is wrong with the readings of each axis, in words; nothing where angles and rates agree."""
    step_s = np.diff(readings.t_ns) * 1e-9
    near = step_s <= _GAP * np.median(step_s)
    width_s = np.zeros(len(step_s) + 1) if readings.half_width_ns is None else readings.half_width_ns * 1e-9
    doubts = []
    for axis, angle, rate in zip(readings.gimbals, readings.angle_rad.T, readings.centred_rps.T, strict=True):
        turned, most = np.diff(angle), np.maximum(np.abs(rate[1:]), np.abs(rate[:-1]))
        summed = (rate[1:] + rate[:-1]) / 2 * step_s
        turned = turned - 2 * np.pi * np.round((turned - summed) / (2 * np.pi))  # angles within one turn
        beyond = np.abs(turned) - most * (1.5 * step_s + width_s[1:] + width_s[:-1]) - _JUMP_RAD
        beyond[~near] = 0.0
        if beyond.max(initial=0.0) > 0.0:
            at = int(beyond.argmax())
            off_deg, at_s = np.degrees(turned[at] - summed[at]), (readings.t_ns[at + 1] - readings.t_ns[0]) * 1e-9
            doubts.append(f"the encoder of axis {axis} jumped by {off_deg:+.2f} deg at {at_s:.1f} s")
        # Readings of which the instant is known much worse than of most tell nothing of a scale.
        well = width_s <= 2 * np.median(width_s) + _WELL_S
        steady = (
            near & well[1:] & well[:-1] & (beyond <= 0.0) & (np.abs(np.diff(rate)) < 0.1 * most) & (most > _TURNING_RPS)
        )
        doubts += _scale_doubts(axis, turned[steady], summed[steady])
    return tuple(doubts)


def _scale_doubts(axis: str, turned: Floats, summed: Floats) -> list[str]:
    """Compare the ways (n,) that angles and rates say; the angles are the truth."""
    if len(turned) < _FEWEST:
        return []
    share = float(turned @ summed / (turned @ turned))
    sd = float(np.sqrt(np.mean((summed - share * turned) ** 2) / (turned @ turned)))
    if share < 0.0:
        return [f"the rates of axis {axis} have the other sign than its angles"]
    if abs(share - 1) > max(_SHARE, _SIGMAS * sd):
        return [f"the rates of axis {axis} are {share - 1:+.2%} off what its angles say".replace("%", " %")]
    return []
