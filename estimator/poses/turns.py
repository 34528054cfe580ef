"""Gyros of a device that hands laid in many poses: each turn must carry gravity from one rest to the next.

The multi-pose method (Tedaldi, Pretto, Menegatti 2014). A turn gives two equations, as its part about the vertical
moves nothing. The rate is C (output - bias) in the frame of the accelerometers, with the bias of the rests around it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import permutations, product

import numpy as np

from estimator.errors import RecordingError
from estimator.poses.calibration import GyroTurnCalibration, PoseCalibration, PoseRest, RefusedTurn, gyro_vector
from estimator.poses.intrinsic import Intrinsic
from estimator.types import Flags, Floats

_PLAUSIBLE = 0.05  # size of the errors of a gyro: scale, and angles in rad
_SHOWN = 0.1  # share of the plausible variance that may be left of a parameter that the turns show
_ITERATIONS, _SETTLED = 20, 1e-9
_FALSE = 0.01  # probability of refusing any turn of a good session
_FEWEST = 6  # turns: nine parameters, and something left over
_STEP = 1e-6  # for derivatives
_LOST_STEPS = 3.5  # usual steps; the motion in a longer gap is unknown
_AT_LIMIT = 3  # samples at an extreme of the output, one after the other
_MEAN_S = 0.25  # neighbouring means at rest whose differences give the noise
_EARTH_RPS = 7.292115e-5
_GROSS_RAD, _GROSS_SHARE = 0.1, 0.5  # misfit as stated, and share of it that another order of axes leaves


class FewTurns(RecordingError):
    """Too few turns between rests can be used to calibrate gyros."""


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class GyroSamples:
    """Outputs (n, 3) in rad/s at instants (n,) of the file ``name``."""

    name: str
    t_s: Floats
    rate_rps: Floats


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class _Turn:
    """Samples between two rests, numbered among those used, less the bias; ``variance`` of what they sum up to."""

    before: int
    after: int
    t_s: Floats
    rate_rps: Floats
    variance: float


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class _Directions:
    """Directions up (k, 3) at rests, the variance of each (k,), and their shifts (9, k, 3) by shared errors."""

    up: Floats
    variance: Floats
    shifts: Floats


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class _Noise:
    """Noise of gyros at rest: variance of a mean over 1 s by white noise, variance from rest to rest beyond it, bias.

    ``of_rest`` (k, 3) are biases at the rests, ``duration_s`` (k,) their lengths. ``bias_rps`` (3,) is that of all
    rests, with the variance ``of_bias``.
    """

    white: float
    wander: float
    of_rest: Floats
    duration_s: Floats
    bias_rps: Floats
    of_bias: float


def calibrate_turns(sessions: Sequence[GyroSamples], accelerometer: PoseCalibration) -> GyroTurnCalibration:
    """Return scales, biases and axes of three gyros from the turns between rests that the accelerometers used.

    The sessions must be named as the files of these rests; KeyError if one is missing. Turns that miss gravity by more
    than chance are refused one by one, as long as six are left. RecordingError if gyros and accelerometers contradict
    each other, FewTurns if too few turns can be used or a gyro is dead.
    """
    sessions = [_alive(samples) for samples in sessions]
    rests = accelerometer.used
    directions = _directions(accelerometer)
    noise = _noise(sessions, rests)
    turns, refused = _turns(sessions, rests, noise)
    if len(turns) < _FEWEST:
        why = "; ".join(sorted({turn.reason for turn in refused}))
        raise FewTurns(f"{len(turns)} turns between rests are usable, {_FEWEST} are needed: {why}")
    contradiction = _axes_contradict(directions.up, turns)
    if contradiction:
        raise RecordingError(f"gross error, not a calibration: {contradiction}")
    before_rad = _rms(np.eye(3), directions.up, turns)
    inverse, covariance, shown, freedom, excess = _fit(directions, turns)
    while len(turns) > _FEWEST and (worst := _worst(inverse, directions, turns, excess)) is not None:
        turn, sigmas = turns.pop(worst[0]), worst[1]
        reason = f"it carries gravity {sigmas:.3g} sigma astray: moved by more than the gyros tell"
        refused.append(RefusedTurn(before=rests[turn.before].number, after=rests[turn.after].number, reason=reason))
        inverse, covariance, shown, freedom, excess = _fit(directions, turns)
    return _result(inverse, covariance, shown, freedom, excess, noise, turns, tuple(refused), directions, before_rad)


def _alive(samples: GyroSamples) -> GyroSamples:
    """Return samples without blanks; FewTurns if a gyro gives no number, or always the same one."""
    whole = np.isfinite(samples.rate_rps).all(axis=1)
    for axis, column in zip("xyz", samples.rate_rps.T, strict=True):
        known = column[np.isfinite(column)]
        if len(known) == 0 or np.ptp(known) == 0:
            what = f"puts out {np.degrees(known[0]):.4g} deg/s all the time" if len(known) else "gives no number"
            raise FewTurns(f"gyro {axis} {what}: it is dead, or its column is wrong")
    return replace(samples, t_s=samples.t_s[whole], rate_rps=samples.rate_rps[whole])


def _axes_contradict(up: Floats, turns: Sequence[_Turn]) -> str:
    """Return a sentence if the turns fit the directions up (k, 3) only with other gyro axes or units; else "".

    Tried are all orders and signs of the axes, and rad for deg or the reverse. That is so if the median turn is off by
    more than 0.1 rad as stated, and by at most half of that otherwise.
    """
    found: list[tuple[float, str]] = []
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            matrix = np.zeros((3, 3))
            matrix[range(3), order] = signs
            name = ", ".join(f"{'-' if sign < 0 else ''}{'xyz'[at]}" for at, sign in zip(order, signs, strict=True))
            hand = "" if np.linalg.det(matrix) > 0 else "; one of the two is left-handed"
            found.append((_misfit(matrix, up, turns), f"gyros taken as ({name}){hand}"))
    stated = found[0][0]
    for factor, unit in ((np.degrees(1), "rad/s"), (np.radians(1), "deg/s")):
        found.append((_misfit(factor * np.eye(3), up, turns), f"gyros taken to be in {unit}"))
    least, name = min(found)
    if stated < _GROSS_RAD or least > _GROSS_SHARE * stated:
        return ""
    return (
        f"gyros and accelerometers contradict each other: over a turn gravity is carried {np.degrees(stated):.3g} deg "
        f"astray, but {np.degrees(least):.2g} deg with the {name}. Check axes, order and unit of both"
    )


def _misfit(matrix: Floats, up: Floats, turns: Sequence[_Turn]) -> float:
    """Return the median angle, in rad, by which turns miss the direction up behind them."""
    angles = []
    for turn in turns:
        there = _carried(turn.t_s, turn.rate_rps @ matrix.T).T @ up[turn.before]
        angles.append(np.arccos(np.clip(there @ up[turn.after], -1.0, 1.0)))
    return float(np.median(angles))


def _carried(t_s: Floats, rate_rps: Floats) -> Floats:
    """Return the rotation (3, 3) from the body at the end to the body at the start; rates (n, 3) are linear between."""
    from scipy.spatial.transform import Rotation

    step_s = np.diff(t_s)[:, None]
    turned = 0.5 * (rate_rps[1:] + rate_rps[:-1]) * step_s
    turned = turned + np.cross(rate_rps[:-1], rate_rps[1:]) * step_s**2 / 12
    rotations = Rotation.from_rotvec(turned).as_matrix()
    while len(rotations) > 1:  # products of neighbours
        if len(rotations) % 2:
            rotations = np.concatenate([rotations, np.eye(3)[None]])
        rotations = rotations[::2] @ rotations[1::2]
    return np.asarray(rotations[0])


def _rms(matrix: Floats, up: Floats, turns: Sequence[_Turn]) -> float:
    """Return the rms distance between directions carried by rates through ``matrix`` (3, 3) and those found."""
    missed = [_carried(turn.t_s, turn.rate_rps @ matrix.T).T @ up[turn.before] - up[turn.after] for turn in turns]
    return float(np.sqrt(np.mean(np.sum(np.square(missed), axis=1))))


def _directions(accelerometer: PoseCalibration) -> _Directions:
    """Return the directions up at the rests that were used; the covariance of the parameters shifts all of them."""
    means = np.array([rest.mean for rest in accelerometer.used])
    vector = accelerometer.intrinsic.vector
    root = np.linalg.cholesky(accelerometer.covariance + 1e-30 * np.eye(len(vector)))
    shifts = [0.5 * (_up(vector + column, means) - _up(vector - column, means)) for column in root.T]
    sd = np.array([rest.sd_mps2 or 0.0 for rest in accelerometer.used]) / accelerometer.gravity.value_mps2
    return _Directions(up=_up(vector, means), variance=sd**2, shifts=np.array(shifts))


def _up(vector: Floats, means: Floats) -> Floats:
    force = Intrinsic.of_vector(vector).force_mps2(means)
    return np.asarray(force / np.linalg.norm(force, axis=1, keepdims=True))


def _rows(samples: GyroSamples, rest: PoseRest) -> slice:
    """Return the rows of the samples within a timed rest."""
    assert rest.start_s is not None
    assert rest.duration_s is not None
    half_s = 0.5 * float(np.median(np.diff(samples.t_s)))
    ends = np.array([rest.start_s - half_s, rest.start_s + rest.duration_s - half_s])
    first, stop = np.searchsorted(samples.t_s, ends).tolist()
    return slice(first, stop)


def _noise(sessions: Sequence[GyroSamples], rests: Sequence[PoseRest]) -> _Noise:
    """Return the noise of the gyros at rest, common to all axes, and their biases.

    It is white noise within the rests and a walk from rest to rest. A rest in which the device turns does not count for
    the bias, and gets that of the others. FewTurns for a rest of fewer than two samples.
    """
    from scipy.stats import chi2, norm

    by_name = {samples.name: samples for samples in sessions}
    means, durations, white = [], [], []
    for rest in rests:
        samples = by_name[rest.file]
        own = samples.rate_rps[_rows(samples, rest)]
        if len(own) < 2:
            raise FewTurns(f"{rest.file}: the gyros give no number in rest {rest.number}")
        means.append(own.mean(axis=0))
        durations.append(rest.duration_s or 0.0)
        width = max(round(_MEAN_S / float(np.median(np.diff(samples.t_s)))), 1)
        blocks = own[: len(own) // width * width].reshape(-1, width, 3).mean(axis=1)
        white.append(np.diff(blocks, axis=0) ** 2 / 2 * _MEAN_S)
    of_rest, duration_s = np.array(means), np.array(durations)
    per_second = float(np.mean(np.concatenate(white)))
    scatter = np.median(np.diff(of_rest, axis=0) ** 2 / 2) / float(chi2.median(1))
    wander = max(float(scatter) - per_second / float(np.median(duration_s)), 0.0)
    variance = per_second / duration_s + wander + 1e-30
    off = np.abs(of_rest - np.median(of_rest, axis=0)).max(axis=1) / np.sqrt(variance)
    still = off <= float(norm.isf(_FALSE / off.size / 6))  # a hand that turns slowly meanwhile is no bias
    weight = np.where(still, 1 / variance, 0.0)
    bias = weight @ of_rest / weight.sum()
    return _Noise(
        white=per_second,
        wander=wander,
        of_rest=np.where(still[:, None], of_rest, bias),
        duration_s=duration_s,
        bias_rps=np.asarray(bias),
        # Earth rate adds to the outputs of all rests; what of it averages out is not known.
        of_bias=float(1 / weight.sum()) + _EARTH_RPS**2 / 3,
    )


def _turns(
    sessions: Sequence[GyroSamples], rests: Sequence[PoseRest], noise: _Noise
) -> tuple[list[_Turn], list[RefusedTurn]]:
    """Return the turns between neighbouring rests of a file, and those that cannot be used, with reasons.

    The rate within a turn is given less the mean bias of the two rests. A turn is refused if a rest between was, or as
    ``_unusable`` says.
    """
    by_name = {samples.name: samples for samples in sessions}
    turns: list[_Turn] = []
    refused: list[RefusedTurn] = []
    for before in range(len(rests) - 1):
        first, second = rests[before], rests[before + 1]
        if second.file != first.file:
            continue
        samples = by_name[first.file]
        between = slice(_rows(samples, first).stop - 1, _rows(samples, second).start + 1)
        reason = "a rest between was refused" if second.number != first.number + 1 else _unusable(samples, between)
        if reason:
            refused.append(RefusedTurn(before=first.number, after=second.number, reason=reason))
            continue
        t_s = samples.t_s[between]
        length_s = float(t_s[-1] - t_s[0])
        bias = 0.5 * (noise.of_rest[before] + noise.of_rest[before + 1])
        of_bias = 0.25 * noise.white * (1 / noise.duration_s[before] + 1 / noise.duration_s[before + 1])
        variance = noise.white * length_s + (of_bias + noise.wander / 2 + _EARTH_RPS**2) * length_s**2
        rate = samples.rate_rps[between] - bias
        turns.append(_Turn(before=before, after=before + 1, t_s=t_s, rate_rps=rate, variance=variance))
    return turns, refused


def _unusable(samples: GyroSamples, between: slice) -> str:
    """Return why the samples of a turn, the rows ``between``, cannot be summed up; "" if they can.

    Samples are missing, or a gyro stays at the largest or least value of its file for three samples.
    """
    t_s, rate = samples.t_s[between], samples.rate_rps[between]
    if np.diff(t_s).max() > _LOST_STEPS * float(np.median(np.diff(samples.t_s))):
        return "samples are missing in it"
    for axis, own, column in zip("xyz", rate.T, samples.rate_rps.T, strict=True):
        for extreme in (np.nanmin(column), np.nanmax(column)):
            at = own == extreme
            if np.convolve(at, np.ones(_AT_LIMIT), "valid").max(initial=0.0) >= _AT_LIMIT:
                return f"gyro {axis} is at the limit of its range, {np.degrees(extreme):.4g} deg/s"
    return ""


def _fit(directions: _Directions, turns: Sequence[_Turn]) -> tuple[Floats, Floats, Flags, int, float]:
    """Return C (3, 3), its covariance (9, 9), which are shown (9,), degrees of freedom, and the mean square misfit.

    C times output less bias is the rate; elements are by rows. If the turns do not show all of them, the covariance has
    plausible sizes as prior. The misfit is in sigmas squared, 1 without freedom.
    """
    inverse = np.eye(3)
    root = np.eye(2 * len(turns))
    for _ in range(_ITERATIONS):
        left, slopes, root = _linear(inverse, directions, turns)
        white, own = np.linalg.solve(root, left), np.linalg.solve(root, slopes)
        step = np.linalg.lstsq(own, -white, rcond=None)[0].reshape(3, 3)
        inverse = inverse + step
        if np.abs(step).max() < _SETTLED:
            break
    left, slopes, root = _linear(inverse, directions, turns)
    white, own = np.linalg.solve(root, left), np.linalg.solve(root, slopes)
    information = own.T @ own
    prior = np.eye(9) / _PLAUSIBLE**2
    shown = np.diag(np.linalg.inv(information + prior)) < _SHOWN * _PLAUSIBLE**2
    covariance = np.linalg.inv(information + (0 if shown.all() else prior))
    freedom = max(2 * len(turns) - 9, 0)
    excess = float(white @ white) / freedom if freedom else 1.0
    return np.asarray(inverse), np.asarray(covariance), np.asarray(shown), freedom, excess


def _linear(inverse: Floats, directions: _Directions, turns: Sequence[_Turn]) -> tuple[Floats, Floats, Floats]:
    """Return the misfits (2 n,) of turns in rad, their derivatives (2 n, 9) by C, and the root of their covariance.

    That is the lower Cholesky factor (2 n, 2 n). Neighbouring turns share a direction, and all turns share the errors
    of the accelerometers.
    """
    count = len(turns)
    left, slopes = np.zeros(2 * count), np.zeros((2 * count, 9))
    moved = np.zeros((2 * count, len(directions.up), 3))
    own = np.zeros(2 * count)
    for number, turn in enumerate(turns):
        rows = slice(2 * number, 2 * number + 2)
        carried = _carried(turn.t_s, turn.rate_rps @ inverse.T)
        there = carried.T @ directions.up[turn.before]
        basis = np.linalg.svd(there[None])[2][1:]  # across the direction that is expected
        left[rows] = basis @ (there - directions.up[turn.after])
        moved[rows, turn.before] = basis @ carried.T
        moved[rows, turn.after] = -basis
        own[rows] = turn.variance
        for at in range(9):
            changed = inverse.copy()
            changed.flat[at] += _STEP
            other = _carried(turn.t_s, turn.rate_rps @ changed.T).T @ directions.up[turn.before]
            slopes[rows, at] = basis @ (other - there) / _STEP
    flat = moved.reshape(2 * count, -1)
    shared = flat @ directions.shifts.reshape(len(directions.shifts), -1).T
    doubt = np.diag(own) + (flat * np.repeat(directions.variance, 3)) @ flat.T + shared @ shared.T
    return left, slopes, np.asarray(np.linalg.cholesky(doubt))


def _worst(inverse: Floats, directions: _Directions, turns: Sequence[_Turn], excess: float) -> tuple[int, float] | None:
    """Return the index of the turn that misses most, and by how many sigmas; None if that may be chance.

    ``inverse`` (3, 3) turns outputs into rates. A sigma is that of most turns, at most by the root of ``excess`` below
    the expected one.
    """
    from scipy.stats import chi2

    left, _, root = _linear(inverse, directions, turns)
    variance = np.sum(root**2, axis=1)
    squares = (left**2 / variance).reshape(-1, 2).sum(axis=1)
    usual = max(float(np.median(squares)) / float(chi2.median(2)), min(excess, 1.0))
    at = int(np.argmax(squares))
    if squares[at] <= usual * float(chi2.isf(_FALSE / len(turns), 2)):
        return None
    return at, float(np.sqrt(squares[at] / usual))


def _result(
    inverse: Floats,
    covariance: Floats,
    shown: Flags,
    freedom: int,
    excess: float,
    noise: _Noise,
    turns: Sequence[_Turn],
    refused: tuple[RefusedTurn, ...],
    directions: _Directions,
    before_rad: float,
) -> GyroTurnCalibration:
    """Return the calibration from the inverse C (3, 3) of the matrix G of the gyros; biases are the means over all
    rests.

    ``covariance`` (9, 9) is that of C by rows, ``shown`` (9,) which of its elements the turns show. Those of the
    calibration are of its twelve states instead; its biases always count as shown. ``excess`` is the mean square of the
    residuals in sigmas, with ``freedom`` degrees of freedom; above 1 it widens the covariance. ``before_rad`` is the
    rms error of directions without calibration; ``refused`` are turns that were left out of ``turns``.
    """
    from scipy.stats import norm, t

    matrix: Floats = np.asarray(np.linalg.inv(inverse))
    bias = noise.bias_rps
    slopes = np.zeros((12, 9))
    values = gyro_vector(matrix, bias)
    for at in range(9):
        changed = inverse.copy()
        changed.flat[at] += _STEP
        slopes[:, at] = (gyro_vector(np.asarray(np.linalg.inv(changed)), bias) - values) / _STEP
    whole = slopes @ covariance @ slopes.T * max(excess, 1.0)
    whole[range(3, 6), range(3, 6)] = noise.of_bias
    rows = shown.reshape(3, 3)
    tilts = [bool(rows[i, j]) for i in range(3) for j in range(3) if i != j]
    notes = []
    if not shown.all():
        notes.append("the turns do not show every axis of the gyros: turn the device about all three axes")
    return GyroTurnCalibration(
        matrix=matrix,
        bias_rps=bias,
        covariance=whole,
        shown=np.array([*np.diag(rows).tolist(), True, True, True, *tilts]),
        factor=float(t.ppf(0.975, freedom) if freedom and excess > 1 else norm.ppf(0.975)),
        turns=len(turns),
        before_rad=before_rad,
        after_rad=_rms(inverse, directions.up, turns),
        refused=refused,
        notes=tuple(notes),
    )
