"""Calibration from stated poses and turns: six static positions and three rotations (Ferraris), or any others.

All twelve states of the accelerometers show, as the pose is known: output = A f + bias in the stated frame. The outputs
of the gyros summed up over a turn by a known angle give G in output = G w + bias, the rests give their biases.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from estimator.errors import RecordingError
from estimator.geometry.kinematics import Gravity
from estimator.poses.calibration import ACCELEROMETER, GYRO, TRIAD_NAMES, Triad, gyro_vector
from estimator.poses.intrinsic import PAIRS
from estimator.types import Flags, Floats

_PLAUSIBLE = 0.05  # size of errors: of scales, of tilts in rad, of biases in g
_SHOWN = 0.5  # share of the plausible variance that may be left of a parameter that is shown
_UP_WITHIN = float(np.cos(np.radians(30.0)))
_WRONG_BY = 0.5  # of a stated angle
_STEP = 1e-6
_EARTH_RPS = 7.292115e-5


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class KnownRest:
    """A rest in a section: the unit vector up (3,), mean outputs (3,), and the variance of each.

    ``rate_rps`` (3,) is the mean of the gyros, None without gyros; ``rate_variance`` is that of it.
    """

    name: str
    up: Floats
    mean: Floats
    variance: float
    rate_rps: Floats | None = None
    rate_variance: float = 0.0


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class KnownTurn:
    """A turn in a section by ``turn_rad`` (3,) in the stated frame, and the outputs summed up (3,), bias included."""

    name: str
    turn_rad: Floats
    summed_rad: Floats
    length_s: float


@dataclass(kw_only=True, frozen=True, slots=True)
class Accuracy:
    """Standard uncertainties of a stated pose, and of a stated angle, in rad; that of an angle without its share."""

    pose_rad: float
    angle_rad: float


def check_poses(name: str, rests: Sequence[KnownRest]) -> None:
    """Raise RecordingError if the mean outputs of any rest are more than 30 deg off the direction up that is stated.

    The message, about the files ``name``, lists all such rests.
    """
    wrong = []
    for rest in rests:
        found = rest.mean / np.linalg.norm(rest.mean)
        if float(found @ rest.up) < _UP_WITHIN:
            wrong.append(f"{rest.name}: {_words(rest.up)} is stated to point up, but {_words(found)} does")
    if wrong:
        raise RecordingError(
            f"{name}: gross error, not a calibration: {'; '.join(wrong)}. Check up, and order, axes and signs of the "
            "columns (specific force points up at rest)"
        )


def known_accelerometers(rests: Sequence[KnownRest], gravity: Gravity, accuracy: Accuracy) -> Triad:
    """Return the twelve states of accelerometers from rests in stated poses, by generalised least squares.

    A pose that is off by an angle moves the output across gravity at first order, and along it at second order.
    """
    g = gravity.value_mps2
    rows, outputs = [], []
    for rest in rests:
        along = np.outer(rest.up, rest.up)
        across = np.eye(3) - along
        tilt = accuracy.pose_rad
        doubt = rest.variance * np.eye(3) + (g * tilt) ** 2 * across + (g * tilt**2) ** 2 * along
        inverse_root = np.linalg.inv(np.linalg.cholesky(doubt))
        regressors = np.kron(np.eye(3), np.append(g * rest.up, 1.0))  # (3, 12): each row of A, and its bias
        rows.append(inverse_root @ regressors)
        outputs.append(inverse_root @ rest.mean)
    sizes = np.tile([_PLAUSIBLE] * 3 + [_PLAUSIBLE * g], 3)
    start = np.hstack([np.eye(3), np.zeros((3, 1))]).ravel()
    x, covariance, shown, freedom, excess = _solved(np.vstack(rows), np.concatenate(outputs), start, sizes)
    matrix, bias = x.reshape(3, 4)[:, :3], x.reshape(3, 4)[:, 3]
    order = [*(4 * i + j for i in range(3) for j in range(3)), 3, 7, 11]
    return _triad(
        kind=ACCELEROMETER,
        matrix=matrix,
        bias=bias,
        covariance=covariance[np.ix_(order, order)],
        shown=shown[order],
        freedom=freedom,
        excess=excess,
        scale_sd=gravity.sd,
    )


def known_gyros(rests: Sequence[KnownRest], turns: Sequence[KnownTurn], accuracy: Accuracy) -> Triad:
    """Return the twelve states of gyros from stated turns, and their biases from the rests.

    RecordingError if no rest has gyros, or a turn about its stated axis is off the stated angle by more than half.
    """
    known = [(rest.rate_rps, rest.rate_variance) for rest in rests if rest.rate_rps is not None]
    if not known:
        raise RecordingError("no section is a rest: the biases of the gyros are not known")
    means = np.array([mean for mean, _ in known])
    wander = float(np.var(means, axis=0, ddof=1).max()) if len(means) > 1 else 0.0
    white = float(np.mean([variance for _, variance in known]))
    bias = means.mean(axis=0)
    of_bias = max(wander, white) / len(means) + _EARTH_RPS**2 / 3
    rows, outputs = [], []
    for turn in turns:
        summed = turn.summed_rad - bias * turn.length_s
        angle = float(np.linalg.norm(turn.turn_rad))
        axis = turn.turn_rad / angle
        along = float(summed @ axis)
        if abs(along / angle - 1) > _WRONG_BY:
            raise RecordingError(
                f"gross error, not a calibration: section {turn.name} is stated to turn by {np.degrees(angle):.0f} "
                f"deg, but the gyros show {np.degrees(along):.0f} deg about that axis. Check axis, sign and unit"
            )
        outer = np.outer(axis, axis)
        noise = (of_bias + max(wander, white)) * turn.length_s**2
        tilt = (angle * accuracy.pose_rad) ** 2 * (np.eye(3) - outer)
        doubt = noise * np.eye(3) + tilt + accuracy.angle_rad**2 * outer
        inverse_root = np.linalg.inv(np.linalg.cholesky(doubt))
        rows.append(inverse_root @ np.kron(np.eye(3), turn.turn_rad))
        outputs.append(inverse_root @ summed)
    x, covariance, shown, freedom, excess = _solved(
        np.vstack(rows), np.concatenate(outputs), np.eye(3).ravel(), np.full(9, _PLAUSIBLE)
    )
    whole = np.zeros((12, 12))
    whole[:9, :9] = covariance
    whole[range(9, 12), range(9, 12)] = of_bias
    return _triad(
        kind=GYRO,
        matrix=x.reshape(3, 3),
        bias=bias,
        covariance=whole,
        shown=np.append(shown, [True] * 3),
        freedom=freedom,
        excess=excess,
        scale_sd=0.0,
    )


def _solved(rows: Floats, outputs: Floats, start: Floats, sizes: Floats) -> tuple[Floats, Floats, Flags, int, float]:
    """Return the solution (p,) of whitened rows (n, p), covariance (p, p), which are shown, freedom, and mean square.

    ``outputs`` (n,) are whitened, too; the mean square is that of the residuals in sigmas, 1 without freedom. Where the
    rows do not show all, plausible ``sizes`` (p,) about ``start`` (p,) stand in for the rest.
    """
    information = rows.T @ rows
    prior = np.diag(1 / sizes**2)
    shown = np.diag(np.linalg.inv(information + prior)) < _SHOWN * sizes**2
    used = np.zeros_like(prior) if shown.all() else prior
    covariance = np.linalg.inv(information + used)
    x = start + covariance @ (rows.T @ (outputs - rows @ start))
    freedom = max(len(outputs) - len(start), 0) if shown.all() else 0
    excess = float(np.sum((outputs - rows @ x) ** 2)) / freedom if freedom else 1.0
    return np.asarray(x), np.asarray(covariance), np.asarray(shown), freedom, excess


def _triad(
    *,
    kind: str,
    matrix: Floats,
    bias: Floats,
    covariance: Floats,
    shown: Flags,
    freedom: int,
    excess: float,
    scale_sd: float,
) -> Triad:
    """Return a triad for a matrix (3, 3), biases (3,), and the covariance (12, 12) of matrix, by rows, and biases.

    ``kind`` names the sensors. ``shown`` (12,) is which of these the poses show. Covariance and flags of the triad are
    those of its states instead, in the order of ``TRIAD_NAMES``. ``excess`` is the mean square of the residuals in
    sigmas, with ``freedom`` degrees of freedom; above 1 it widens the covariance. ``scale_sd`` is the relative standard
    deviation that all scale factors have in common.
    """
    from scipy.stats import norm, t

    values = gyro_vector(matrix, bias)
    slopes = np.zeros((12, 12))
    for at in range(9):
        changed = matrix.copy()
        changed.flat[at] += _STEP
        slopes[:, at] = (gyro_vector(changed, bias) - values) / _STEP
    slopes[3:6, 9:] = np.eye(3)
    of_values = slopes @ covariance @ slopes.T * max(excess, 1.0)
    scales = np.concatenate([values[:3], np.zeros(9)])
    cells = shown[:9].reshape(3, 3)
    tilts = [bool(cells[i, j]) for i in range(3) for j in range(3) if i != j]
    return Triad(
        kind=kind,
        matrix=matrix,
        bias=bias,
        covariance=of_values + scale_sd**2 * np.outer(scales, scales),
        shown=np.array([*np.diag(cells).tolist(), *shown[9:].tolist(), *tilts]),
        factor=float(t.ppf(0.975, freedom) if freedom and excess > 1 else norm.ppf(0.975)),
    )


def intrinsic_covariance(triad: Triad) -> Floats:
    """Return the covariance (9, 9) of the intrinsic parameters, in the order of ``intrinsic.NAMES``, of a triad.

    To first order the angle of two sense axes less 90 deg is the sum of their tilts towards each other, less its sign.
    """
    names = list(TRIAD_NAMES)
    slopes = np.zeros((9, 12))
    slopes[:6, :6] = np.eye(6)
    for row, (i, j) in enumerate(PAIRS):
        for a, b in ((i, j), (j, i)):
            slopes[6 + row, names.index(f"{'xyz'[a]} towards {'xyz'[b]}")] = -1.0
    return np.asarray(slopes @ triad.covariance @ slopes.T)


def _words(direction: Floats) -> str:
    """Return a direction as an axis with its sign if it is near one, else as three numbers."""
    at = int(np.argmax(np.abs(direction)))
    if abs(direction[at]) > _UP_WITHIN:
        return f"{'-' if direction[at] < 0 else ''}{'xyz'[at]}"
    return "(" + ", ".join(f"{part:.2f}" for part in direction) + ")"
