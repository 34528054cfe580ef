"""Gyros of a body that is laid in many poses by hand: between two rests they must carry gravity from one to the other.

The multi-pose method (Tedaldi, Pretto, Menegatti 2014): the attitude that the outputs sum up to over a turn by hand
brings the direction up of the rest before into that of the rest behind, if scale, misalignment and bias are right. Each
turn gives two numbers, of all gyros together, so their states are one estimate. Biases come of the rests as well.
"""

from dataclasses import dataclass

import numpy as np

from estimator.errors import RecordingError
from estimator.geometry.array import SensorArray
from estimator.geometry.kinematics import GRAVITY_MPS2
from estimator.geometry.model import Prior, regressor_maps
from estimator.observations.rows import in_order
from estimator.packaged import sentence
from estimator.recordings.recording import ImuData
from estimator.recordings.reference import Poses
from estimator.types import Floats

_GAP_STEPS = 3.5  # usual steps: the motion in a longer gap is unknown
_MEAN_S, _FEWEST = 0.5, 10  # neighbouring means at rest give the noise; the least number of them
_ITERATIONS = 8
_SETTLED = 1e-3  # sigmas
_FACTOR, _SKEW, _OFFSET_MPS2 = 0.03, 0.02, 0.5  # errors of accelerometers, one sigma
_LENGTH = 3e-4  # accuracy of an accelerometer for the length of gravity, as far as a few rests do not show it


@dataclass(frozen=True, slots=True, eq=False)
class Laid:
    """Estimate for gyros (m): states x (m, 4) as in ``model``, covariance (4 m, 4 m), noise of a sample (m,) in rad/s.

    ``turns`` is the number used; ``excess`` the mean square residual relative to the expected one.
    """

    x: Floats
    covariance: Floats
    noise_rps: Floats
    turns: int
    excess: float


@dataclass(frozen=True, slots=True, eq=False)
class _Turn:
    """Samples of the outputs (n, m) from the end of rest ``first`` to the beginning of the next."""

    first: int
    t_s: Floats
    rate_rps: Floats


def estimate(data: ImuData, poses: Poses, prior: Prior) -> Laid:
    """Return the states that best carry the direction of gravity from rest to rest, and the noise of a sample at rest.

    With them come their covariance, the number of turns in use, and the mean square misfit relative to the noise. The
    biases are those of the mean of all rests. A misfit beyond the noise widens the covariance. RecordingError if the
    gyros do not span space, or there are gaps between all rests.
    """
    array, m = data.array, len(data.array)
    if np.linalg.matrix_rank(array.p, tol=0.1) < 3:
        raise RecordingError("gravity between rests needs gyros about three axes to compute the attitude")
    turns, still, rest_s = _cut(data, poses)
    if not turns:
        raise RecordingError("the samples have gaps between all rests. Log without gaps while the body is turned")
    rests = np.array([part.mean(axis=0) for part in still])
    noise = np.sqrt(np.mean([part.var(axis=0) for part in still], axis=0))
    period_s = float(np.median(np.diff(data.t_ns))) * 1e-9
    width = max(round(_MEAN_S / period_s), 1)
    steps = [np.diff(p[: len(p) // width * width].reshape(-1, width, m).mean(axis=1), axis=0) for p in still]
    seen = np.vstack(steps) * np.sqrt(width / 2)
    arw = np.sqrt(np.mean(seen**2, axis=0) if len(seen) > _FEWEST else noise**2) * np.sqrt(period_s)
    wander = np.zeros(m)
    if len(rests) > 1:  # a bias changes within a turn as it does from rest to rest
        beyond = np.diff(rests, axis=0) ** 2 / 2 - arw**2 * 0.5 * (1 / rest_s[1:] + 1 / rest_s[:-1])[:, None]
        wander = np.sqrt(np.maximum(beyond.mean(axis=0), 0.0))
    known = np.diag(np.tile(1 / prior.variances(), m))
    at_rest = np.zeros((m, 4 * m))
    at_rest[np.arange(m), 4 * np.arange(m) + 1] = -1.0
    weight = np.sum(1 / (arw**2 / rest_s[:, None] + wander**2), axis=0)  # of the mean of all rests
    mean = np.sum(rests / (arw**2 / rest_s[:, None] + wander**2), axis=0) / weight
    x, covariance, squares = np.zeros(4 * m), np.zeros((4 * m, 4 * m)), 0.0
    for _ in range(_ITERATIONS):
        left, slopes, doubt = _linear(array, poses, turns, x.reshape(m, 4), arw, wander)
        root = np.linalg.cholesky(doubt)
        white, own = np.linalg.solve(root, left), np.linalg.solve(root, slopes)
        covariance = np.linalg.inv(own.T @ own + at_rest.T @ (weight[:, None] * at_rest) + known)
        step = covariance @ (own.T @ white + at_rest.T @ (weight * (mean - at_rest @ x)) - known @ x)
        squares = float(np.sum((white - own @ step) ** 2))
        x = x + step
        if np.abs(step / np.sqrt(np.diag(covariance))).max() < _SETTLED:
            break
    excess = squares / max(2 * len(turns) - 3 * m, 1)
    return Laid(x.reshape(m, 4), covariance * max(excess, 1.0), noise, len(turns), excess)


def directions_up(force_mps2: Floats, *, from_rests: bool) -> tuple[Floats, float, Floats]:
    """Return directions up (k, 3) from specific forces at rest, the uncertainty of each in rad, and common shifts (q,
    k, 3).

    ``from_rests``: scale factors, skews and offsets of the accelerometer are estimated so that all rests have the same
    length; body x is along its x axis, body y in the plane of its x and y. The remaining uncertainty moves all
    directions by the shifts, one sigma each. Otherwise the accelerometer is taken as correct: the uncertainty is 0, and
    there are no shifts.
    """
    from scipy.optimize import least_squares

    if not from_rests:
        return _unit(force_mps2), 0.0, np.zeros((0, len(force_mps2), 3))
    expected = np.array([_FACTOR, _SKEW, _FACTOR, _SKEW, _SKEW, _FACTOR, *[_OFFSET_MPS2] * 3])

    def corrected(x: Floats) -> Floats:
        matrix = np.eye(3)
        matrix[np.tril_indices(3)] += x[:6] * expected[:6]
        return np.asarray(np.linalg.solve(matrix, (force_mps2 - x[6:] * expected[6:]).T).T)

    x, doubt, covariance = np.zeros(9), _LENGTH, np.eye(9)
    for _ in range(4):

        def left(x: Floats, doubt: float = doubt) -> Floats:
            return np.concatenate([(np.linalg.norm(corrected(x), axis=1) / GRAVITY_MPS2 - 1) / doubt, x])

        found = least_squares(left, x)
        x, covariance = found.x, np.linalg.inv(found.jac.T @ found.jac)
        free = len(force_mps2) - (9 - float(np.trace(covariance)))  # less what the rests determine of the accelerometer
        squares = doubt**2 * float(np.sum(found.fun[:-9] ** 2))
        doubt = float(np.sqrt((_LENGTH**2 + squares) / (1 + free)))
    roots = np.linalg.cholesky(covariance).T
    up = _unit(corrected(x))
    return up, doubt, np.array([0.5 * (_unit(corrected(x + d)) - _unit(corrected(x - d))) for d in roots])


def accelerometer_note(poses: Poses) -> str:
    """Return a sentence on the accuracy of the directions up."""
    each = f"{len(poses.up)} rests, the direction up to {np.degrees(float(np.median(poses.sd_rad))):.2g} deg each"
    if not len(poses.shifts):
        return f"gravity is the reference: {each}; the accelerometer is used as stated"
    common = np.degrees(float(np.sqrt(np.mean(np.sum(poses.shifts**2, axis=(0, 2)) / 2))))
    return sentence("observations.gravity", each=each, common_deg=common)


def _unit(vectors: Floats) -> Floats:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def _cut(data: ImuData, poses: Poses) -> tuple[list[_Turn], list[Floats], Floats]:
    """Return the turns between rests that have no gaps, the outputs (n, m) of each rest, and the rests' lengths (k,)
    in s.

    A gap is longer than a few sampling periods; no rest counts as shorter than that.
    """
    t_ns, rate = in_order(data)
    first, last = np.searchsorted(t_ns, poses.t_start_ns), np.searchsorted(t_ns, poses.t_end_ns, side="right") - 1
    t_s = (t_ns - t_ns[0]) * 1e-9
    turns, longest_s = [], _GAP_STEPS * float(np.median(np.diff(t_s)))
    for number, (end, start) in enumerate(zip(last[:-1].tolist(), first[1:].tolist(), strict=True)):
        between = slice(end, start + 1)
        if start > end and np.diff(t_s[between]).max() < longest_s:
            turns.append(_Turn(number, t_s[between], rate[between]))
    still = [rate[a : b + 1] for a, b in zip(first.tolist(), last.tolist(), strict=True)]
    return turns, still, np.maximum(t_s[last] - t_s[first], longest_s)


def _linear(
    array: SensorArray, poses: Poses, turns: list[_Turn], x: Floats, arw: Floats, wander: Floats
) -> tuple[Floats, Floats, Floats]:
    """Return the residuals of the turns for states x (m, 4) (r,), their derivatives (r, 4 m), and their covariance (r,
    r).

    Each turn has two residuals, the components of the error of the direction up across it. ``arw`` and ``wander`` (m,)
    are the noise of the gyros and how far their biases change within a turn.
    """
    maps, m, k = regressor_maps(array), len(array), len(poses.up)
    inverse = np.linalg.pinv(array.p - x[:, :1] * array.p + x[:, 2:3] * array.k - x[:, 3:] * array.j)
    left, slopes, moved = np.zeros(2 * len(turns)), np.zeros((2 * len(turns), m, 4)), np.zeros((2 * len(turns), k, 3))
    own = np.zeros(2 * len(turns))
    for n, turn in enumerate(turns):
        rows = slice(2 * n, 2 * n + 2)
        w = (turn.rate_rps + x[:, 1]) @ inverse.T
        attitude = _attitudes(turn.t_s, w)
        carry = attitude[-1].T
        up, then = carry @ poses.up[turn.first], poses.up[turn.first + 1]
        basis = np.linalg.svd(then[None])[2][1:]  # across the direction that is found
        left[rows] = basis @ (then - up)
        moved[rows, turn.first], moved[rows, turn.first + 1] = basis @ carry, -basis
        # A rate that is off by d turns the end by d summed up in its axes, and the direction up by up x that.
        one = np.column_stack([np.ones(len(w)), w])
        summed = np.trapezoid(attitude[:, None] * one[:, :, None, None], turn.t_s, axis=0)  # (4, 3, 3)
        across = basis @ np.cross(np.eye(3), up) @ carry
        slopes[rows] = -np.einsum("ab,cbd,dm,msc->ams", across, summed, inverse, maps)
        length_s = float(turn.t_s[-1] - turn.t_s[0])
        own[rows] = np.mean(arw**2) * length_s + np.mean(wander**2) * length_s**2
    flat = moved.reshape(len(moved), -1)
    shared = flat @ poses.shifts.reshape(len(poses.shifts), 3 * k).T
    doubt = np.diag(own) + (flat * np.repeat(poses.sd_rad**2, 3)) @ flat.T + shared @ shared.T
    return left, slopes.reshape(len(left), -1), doubt


def _attitudes(t_s: Floats, w_rps: Floats) -> Floats:
    """Return the attitudes (n, 3, 3), from the body to its first orientation, for rates (n, 3) that are linear in
    between.
    """
    from scipy.spatial.transform import Rotation

    step_s = np.diff(t_s)[:, None]
    turned = 0.5 * (w_rps[1:] + w_rps[:-1]) * step_s + np.cross(w_rps[:-1], w_rps[1:]) * step_s**2 / 12
    product = np.concatenate([np.eye(3)[None], Rotation.from_rotvec(turned).as_matrix()])
    width = 1
    while width < len(product):  # products of 2, 4, 8, ... neighbours
        product[width:] = product[:-width] @ product[width:]
        width *= 2
    return np.asarray(product)
