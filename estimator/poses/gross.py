"""Gross errors of accelerometers: they are named with what to check, and never fitted away."""

from collections.abc import Sequence

import numpy as np

from estimator.errors import RecordingError
from estimator.poses.intrinsic import PAIRS, Intrinsic
from estimator.poses.resting import StillSpan
from estimator.types import Flags, Floats

AXES = "xyz"
_OFF = 0.2  # of gravity or of the scale, and in rad between axes: no accelerometer in order is off by so much
_UNITS = {"g": 1 / 9.80665, "mg": 1000 / 9.80665, "m/s2 given as g": 9.80665, "m/s2 given as mg": 9.80665e-3}
_RESPONDS = 0.1  # share of gravity by which an axis changes if the body is turned over


def check_alive(name: str, outputs: Floats) -> None:
    """Raise RecordingError if an axis of outputs (n, 3) gives no number, always the same one, or those of another.

    ``name`` is for the message. A single row only has to have numbers.
    """
    for axis, column in zip(AXES, outputs.T, strict=True):
        known = column[np.isfinite(column)]
        if len(known) == 0:
            raise RecordingError(f"{name}: accelerometer {axis} gives no number: it is not connected, or broken")
        if np.ptp(known) == 0 and len(known) > 1:
            raise RecordingError(
                f"{name}: accelerometer {axis} puts out {known[0]:.4g} all the time: it is dead, or its column is wrong"
            )
    for i, j in PAIRS:
        if len(outputs) > 1 and np.array_equal(outputs[:, i], outputs[:, j]):
            raise RecordingError(f"{name}: accelerometers {AXES[i]} and {AXES[j]} are the same column. Check columns")


def faults_at_rest(outputs: Floats, spans: Sequence[StillSpan]) -> list[str]:
    """Return for each rest what is wrong with an axis in it: at a limit of its range, or stuck; "" if nothing is.

    ``outputs`` (n, 3) are of the whole file. An axis is at fault if one value holds half of the samples of a rest, and
    twice the share that is usual in the other rests: where steps are coarser than the noise it does so everywhere. A
    limit is the least or the largest output of the file. Only the first axis at fault is named.
    """
    found = [""] * len(spans)
    for axis, column in zip(AXES, outputs.T, strict=True):
        modes = [_mode(column[span.first : span.stop]) for span in spans]
        usual = float(np.median([share for _, share in modes]))
        low, high = np.nanmin(column), np.nanmax(column)
        for number, (value, share) in enumerate(modes):
            if share < 0.5 or share < 2 * usual or found[number]:
                continue
            if value in (low, high):
                found[number] = f"{axis} is at the limit of its range, {value:.4g}, in {share:.0%} of the samples"
            else:
                found[number] = f"{axis} is stuck at {value:.4g} in {share:.0%} of the samples"
    return found


def _mode(values: Floats) -> tuple[float, float]:
    """Return the commonest value and its share."""
    distinct, counts = np.unique(values, return_counts=True)
    at = int(np.argmax(counts))
    return float(distinct[at]), float(counts[at] / len(values))


def check_unit(name: str, means: Floats, gravity_mps2: float) -> None:
    """Raise RecordingError if the median length of means (n, 3), in m/s2 as stated, is off gravity by more than 40 %.

    The message, about the file ``name``, says which unit they look like, if any.
    """
    ratio = float(np.median(np.linalg.norm(means, axis=1))) / gravity_mps2
    if abs(ratio - 1) <= 2 * _OFF:
        return
    for unit, factor in _UNITS.items():
        if abs(ratio / factor - 1) <= _OFF:
            what = f"its values look like {unit}"
            break
    else:
        what = "that is no usual unit"
    raise RecordingError(
        f"{name}: at rest the accelerometers show {ratio * gravity_mps2:.4g} m/s2 in place of {gravity_mps2:.4g}: "
        f"{what}. Check unit and count in [accelerometer]"
    )


def check_responding(name: str, means: Floats, size: Floats) -> None:
    """Raise RecordingError if an axis of means (n, 3) of the file ``name`` does not respond to gravity.

    That is, it stays where it is while the two others show that it is turned: if it were alive, they would keep the
    length of what they share. ``size`` (3,) is gravity in units of each output.
    """
    scaled = means / size
    for number, axis in enumerate(AXES):
        others = np.delete(scaled, number, axis=1)
        moved = np.ptp(scaled[:, number])
        centre = 0.5 * (others.min(axis=0) + others.max(axis=0))
        shared = np.ptp(np.linalg.norm(others - centre, axis=1))
        turned = np.ptp(others, axis=0).min()
        if moved < _RESPONDS and turned > 1 and shared > 3 * _RESPONDS:
            raise RecordingError(
                f"{name}: accelerometer {axis} does not respond to gravity: it changes by {moved:.2g} g over "
                f"{len(means)} rests that turn the other two. It is dead, or its column is wrong"
            )


def gross_errors(parameters: Intrinsic, shown: Flags, gravity_mps2: float, *, scale_known: bool) -> list[str]:
    """Return sentences on parameters that no accelerometer in order has; only of those that are shown (9,).

    Of raw counts without a stated size the scales are compared with each other, and biases are not judged.
    """
    usual = 1.0 if scale_known else float(np.median(parameters.scale))
    found = []
    for number, axis in enumerate(AXES):
        scale, offset = float(parameters.scale[number]), float(parameters.offset[number])
        bias_g = offset / (scale * gravity_mps2)
        wrong = []
        if shown[number] and abs(scale / usual - 1) > _OFF:
            wrong.append(f"scale factor {scale / usual:.3g}")
        if scale_known and shown[3 + number] and abs(bias_g) > _OFF:
            wrong.append(f"bias {offset:.3g} m/s2")
        if wrong:
            up, down = offset + scale * gravity_mps2, offset - scale * gravity_mps2
            found.append(
                f"{axis} reads {up:.3g} where it points up and {down:.3g} where it points down ({', '.join(wrong)}): "
                "check its range, unit, wiring and column"
            )
    for number, (i, j) in enumerate(PAIRS):
        angle = float(parameters.angle_rad[number])
        if shown[6 + number] and abs(angle) > _OFF:
            found.append(
                f"{AXES[i]} and {AXES[j]} are {90 + np.degrees(angle):.3g} deg apart in place of 90: check that both "
                "columns are of different axes"
            )
    return found
