"""Several IMUs on one rigid board: how they are turned against the first, and where their accelerometers are.

In fast turns accelerometer i shows s + a x r_i + w x (w x r_i). The gyros give w. Angular acceleration a and the force
s at the first IMU are estimated for each sample from the accelerometers themselves: a derivative of the gyros would be
too slow for a hand that shakes. Arms and motion take turns until both fit (block coordinate descent, Carlsson et al.,
IEEE Sensors Journal 2021).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from estimator.errors import RecordingError
from estimator.poses.calibration import Board, BoardImu, GyroTurnCalibration, PoseCalibration
from estimator.types import Flags, Floats, runs_of

_FEWEST_IMUS = 3  # of fewer the accelerometers do not give the angular acceleration
_FEWEST_POSES = 2  # common ones: gravity in a single pose does not show how an IMU is turned about it
_LEAST_SPREAD = 0.1  # rad, of the directions of gravity
_FAST = 0.1  # of the fastest turn: slower samples say nothing of the arms
_FEWEST_ROWS = 200
_BLOCKS = 20  # of the jackknife
_ITERATIONS, _SETTLED_M = 200, 1e-7
_CLIPPED = 3  # samples one after the other at the extreme of a column: the range ends there


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class ImuSamples:
    """One IMU: outputs (n, 3) of accelerometers and gyros in SI at the instants of the board, and its calibrations."""

    name: str
    force: Floats
    rate_rps: Floats
    accelerometer: PoseCalibration
    gyro: GyroTurnCalibration


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class _Motion:
    """Forces (m, n, 3) of the IMUs, and w x (w x .) as matrices (n, 3, 3), in the frame of the first."""

    force: Floats
    centripetal: Floats

    def only(self, flags: Flags) -> "_Motion":
        return _Motion(force=self.force[:, flags], centripetal=self.centripetal[flags])


def locate(imus: Sequence[ImuSamples]) -> Board:
    """Return rotations and arms of IMUs against the first, from samples of fast turns.

    With them come their uncertainties, the misfit, and how many samples are used and are at a limit. Fast are samples
    above a tenth of the fastest rate. Samples with blanks, and at or beside the limit of any sensor, are left out.
    RecordingError for fewer than three IMUs or 200 samples, and for an IMU that shares too few rests with the first.
    """
    if len(imus) < _FEWEST_IMUS:
        raise RecordingError(f"arms between {len(imus)} IMUs are not estimated: {_FEWEST_IMUS} and more are needed")
    rotations, sds = _rotations(imus)
    force = np.array([_force(imu) @ r.T for imu, r in zip(imus, rotations, strict=True)])
    rate = np.mean([_rate(imu) @ r.T for imu, r in zip(imus, rotations, strict=True)], axis=0)
    clipped = np.any([at_limit(imu.force) | at_limit(imu.rate_rps) for imu in imus], axis=0)
    near = np.convolve(clipped, np.ones(3), "same") > 0
    speed = np.linalg.norm(rate, axis=1)
    known = np.isfinite(speed) & np.isfinite(force).all(axis=(0, 2)) & ~near
    fast = known & (speed > _FAST * np.max(speed[known], initial=0.0))
    if fast.sum() < _FEWEST_ROWS:
        raise RecordingError(f"arms are not estimated: {fast.sum()} samples of fast turns, {_FEWEST_ROWS} are needed")
    cross = _crossing(rate[fast])
    motion = _Motion(force=force[:, fast], centripetal=cross @ cross)
    arms, misfit = _arms(motion, np.zeros((len(imus), 3)))
    parts = []
    block = np.arange(int(fast.sum())) * _BLOCKS // int(fast.sum())
    for left_out in range(_BLOCKS):
        parts.append(_arms(motion.only(block != left_out), arms)[0])
    scale_sd = float(np.mean([np.sqrt(np.diag(imu.gyro.covariance)[:3]) for imu in imus]))
    return Board(
        imus=_placed(imus, rotations, sds, arms, np.array(parts), scale_sd),
        used=int(fast.sum()),
        saturated=int(clipped.sum()),
        misfit_mps2=misfit,
    )


def at_limit(outputs: Floats) -> Flags:
    """Return in which samples (n,) a column of outputs (n, c) is at the end of its range.

    An extreme is the end of a range if it is held for three samples anywhere; then every sample with it is there. A
    constant column has no such end, nor has a blank one. Blanks are at no end.
    """
    found = np.zeros(len(outputs), dtype=bool)
    for column in outputs.T:
        low, high = np.nanmin(column), np.nanmax(column)
        for extreme in (low, high) if low < high else ():
            at = np.asarray(column == extreme)
            if any(stop - start >= _CLIPPED for start, stop in runs_of(at)):
                found |= at
    return found


def _force(imu: ImuSamples) -> Floats:
    return imu.accelerometer.intrinsic.force_mps2(imu.force)


def _rate(imu: ImuSamples) -> Floats:
    return np.asarray(np.linalg.solve(imu.gyro.matrix, (imu.rate_rps - imu.gyro.bias_rps).T).T)


def _rotations(imus: Sequence[ImuSamples]) -> tuple[list[Floats], list[float]]:
    """Return the rotation (3, 3) of each IMU into the first, and its uncertainty in rad, by gravity at common rests.

    Rests are common if the middle of one is within the other's. The first IMU has the identity and 0. RecordingError
    for an IMU whose common rests are in fewer than two poses.
    """
    from scipy.spatial.transform import Rotation

    first = {_middle(rest.start_s, rest.duration_s): rest.mean for rest in imus[0].accelerometer.used}
    times = np.array(list(first))
    means = np.array(list(first.values()))
    rotations: list[Floats] = [np.eye(3)]
    sds = [0.0]
    for imu in imus[1:]:
        own, other = [], []
        for rest in imu.accelerometer.used:
            middle_s = _middle(rest.start_s, rest.duration_s)
            at = int(np.argmin(np.abs(times - middle_s)))
            if abs(times[at] - middle_s) < 0.5 * (rest.duration_s or 0.0):
                own.append(rest.mean)
                other.append(means[at])
        here = _unit(imu.accelerometer.intrinsic.force_mps2(np.reshape(own, (-1, 3))))
        there = _unit(imus[0].accelerometer.intrinsic.force_mps2(np.reshape(other, (-1, 3))))
        if np.linalg.matrix_rank(here, tol=_LEAST_SPREAD) < _FEWEST_POSES:
            raise RecordingError(
                f"{imu.name} cannot be placed on the board: {len(here)} of its rests are also rests of {imus[0].name}, "
                f"and {_FEWEST_POSES} in different poses are needed. Lay the board down in several poses while all "
                "IMUs record, and compare the two accelerometers in time"
            )
        rotation = Rotation.align_vectors(there, here)[0].as_matrix()
        left = there - here @ rotation.T
        rotations.append(rotation)
        sds.append(float(np.sqrt(np.sum(left**2) / max(2 * len(left) - 3, 1) / len(left) * 1.5)))
    return rotations, sds


def _middle(start_s: float | None, duration_s: float | None) -> float:
    return (start_s or 0.0) + 0.5 * (duration_s or 0.0)


def _unit(vectors: Floats) -> Floats:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def _crossing(vectors: Floats) -> Floats:
    """Return the matrices (n, 3, 3) of the cross products of vectors (n, 3) with another."""
    found = np.zeros((len(vectors), 3, 3))
    for (i, j), at, sign in (((2, 1), 0, 1), ((0, 2), 1, 1), ((1, 0), 2, 1)):
        found[:, i, j] = sign * vectors[:, at]
        found[:, j, i] = -sign * vectors[:, at]
    return found


def _arms(motion: _Motion, start: Floats) -> tuple[Floats, float]:
    """Return the arms (m, 3) in m of all m IMUs from the first, whose own is 0, and the rms misfit in m/s2.

    They are iterated from ``start`` (m, 3).

    In turn the common acceleration is fitted for given arms, and the arms for given acceleration, until no arm changes
    by 0.1 um, at most 200 times.
    """
    arms = start
    misfit = 0.0
    for _ in range(_ITERATIONS):
        shown = motion.force - np.einsum("nij,mj->mni", motion.centripetal, arms)
        count = shown.shape[1]
        rows = np.hstack([np.tile(np.eye(3), (len(arms), 1)), -_crossing(arms).reshape(-1, 3)])
        columns = shown.transpose(1, 0, 2).reshape(count, -1)
        both = columns @ np.linalg.pinv(rows).T
        misfit = float(np.sqrt(np.mean((columns - both @ rows.T) ** 2)))
        regressors = (_crossing(both[:, 3:]) + motion.centripetal).reshape(-1, 3)
        rest = (motion.force - both[None, :, :3]).reshape(len(arms), -1)
        found = np.linalg.solve(regressors.T @ regressors, regressors.T @ rest.T).T
        found = found - found[0]
        settled = float(np.abs(found - arms).max()) < _SETTLED_M
        arms = np.asarray(found)
        if settled:
            break
    return arms, misfit


def _placed(
    imus: Sequence[ImuSamples],
    rotations: Sequence[Floats],
    sds: Sequence[float],
    arms: Floats,
    parts: Floats,
    scale_sd: float,
) -> tuple[BoardImu, ...]:
    """Return the IMUs with intervals from the arms ``parts`` (blocks, m, 3), each without one block of time.

    An error of the gyros' scales, of ``scale_sd``, changes an arm by twice as much, as the force goes with the square.
    """
    from scipy.stats import t

    factor = float(t.ppf(0.975, _BLOCKS - 1))
    found = []
    for at, imu in enumerate(imus):
        off = parts[:, at] - parts[:, at].mean(axis=0)
        arm = arms[at]
        covariance = (_BLOCKS - 1) / _BLOCKS * off.T @ off + (2 * scale_sd) ** 2 * np.outer(arm, arm)
        distance = float(np.linalg.norm(arm))
        along = arm / distance if distance > 0 else np.zeros(3)
        found.append(
            BoardImu(
                name=imu.name,
                accelerometer=imu.accelerometer,
                gyro=imu.gyro,
                rotation=rotations[at],
                rotation_sd_rad=sds[at],
                arm_m=arm,
                covariance_m2=np.asarray(covariance),
                distance_m=distance,
                distance_u95_m=factor * float(np.sqrt(along @ covariance @ along)),
            )
        )
    return tuple(found)
