"""The calibration methods that the paper names, each from recorded rows to states.

All methods end in the states of ``estimator.geometry.model``, decoded without approximation, so that only the method
differs and not the model. ``w`` is the body rate (rows, 3), ``y`` the outputs (rows, n), both in rad/s.

Operations are counted from the dimensions, one multiplication, addition or division each. Sums of symmetric products
count their upper half. Work that does not grow with the rows is not counted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from drivers.types import Floats
from estimator.errors import EstimatorError
from estimator.geometry.array import SensorArray
from estimator.geometry.model import regressor_maps
from estimator.observations.rows import Observations
from station.studies.paper_filter import decoded, regressors

_NULL_SHARE = 1e-9  # of the greatest eigenvalue: below it a direction carries no information
_SEEN = 1e-6  # share of a state that may lie in directions without information


@dataclass(frozen=True, slots=True, eq=False)
class BaselineEstimate:
    """States and their stated sigmas (n, 4), NaN where the method does not determine them.

    ``operations`` is the arithmetic of the whole estimate. ``unseen`` (d, n, 4) spans what the observation
    cannot see, as combinations of x = [k, b, s_j, s_k]; see ``unseen_directions`` for their order.
    """

    states: Floats
    sd: Floats
    operations: int
    unseen: Floats = field(default_factory=lambda: np.empty((0, 0, 4)))


def least_squares(w_rps: Floats, y_rps: Floats, array: SensorArray) -> BaselineEstimate:
    """Fit the output error of each gyro on [1, w] by an orthogonal transform; return states, sigmas and operations.

    ``w_rps`` (N, 3) are body rates, ``y_rps`` (N, n) the outputs. The noise of each gyro is that of its residual, taken
    to be white.
    """
    rows, n = y_rps.shape
    q, r = np.linalg.qr(regressors(w_rps))
    z = y_rps - w_rps @ array.p.T
    projected = q.T @ z
    coefficients = np.linalg.solve(r, projected)
    noise = np.sqrt((np.sum(z**2, axis=0) - np.sum(projected**2, axis=0)) / (rows - 4))
    inverse = np.linalg.inv(r)
    covariance = noise[:, None, None] ** 2 * (inverse @ inverse.T)
    states, sd = decoded(*_from_coefficients(array, coefficients.T, covariance))
    # Output error 6n, QR with Q 4 x 4^2, projection and squares 8n + 2n + 2n.
    return BaselineEstimate(states, sd, rows * (18 * n + 64))


def six_position(pairs: Sequence[tuple[Observations, Observations]], array: SensorArray) -> BaselineEstimate:
    """Solve the means at three pairs of positions, plus and minus, by the classic sums and differences.

    A position is the rows at one attitude, or during one steady rotation.

    Half of the difference of a pair is g . (w+ - w-)/2 in each gyro, free of its bias: three pairs give the row g = (1
    - k) pbar of any gyro, whatever its direction. With rotation about the axes this is g_axis = (y+ - y-) / 2w. The
    mean of all six gives the bias. The stated sigma takes the scatter within the positions for white noise, as is the
    custom.

    EstimatorError unless there are three pairs whose half differences of the input span space.
    """
    positions = [position for pair in pairs for position in pair]
    w = np.array([position.w_rps.mean(axis=0) for position in positions])
    y = np.array([position.y_rps.mean(axis=0) for position in positions])
    halves = np.kron(np.eye(3), [0.5, -0.5])
    if len(pairs) != 3 or np.linalg.matrix_rank(halves @ w, tol=1e-9) < 3:
        raise EstimatorError("six positions need three pairs whose inputs differ along three directions")
    row_of = np.linalg.solve(halves @ w, halves)  # (3, 6): g from the six means
    minus_bias_of = np.full(6, 1 / 6) - w.mean(axis=0) @ row_of
    solution = np.vstack([minus_bias_of, row_of])
    means = y - w @ array.p.T
    scatter = np.array([np.var(p.y_rps - p.w_rps @ array.p.T, axis=0, ddof=1) for p in positions])
    counts = np.array([len(p.y_rps) for p in positions])
    of_means = scatter.mean(axis=0)[:, None] / counts  # (n, 6)
    covariance = np.einsum("ap,np,bp->nab", solution, of_means, solution)
    states, sd = decoded(*_from_coefficients(array, (solution @ means).T, covariance))
    n = len(array)
    return BaselineEstimate(states, sd, int(counts.sum()) * (n + 3))


def direct_observation(w_rps: Floats, y_rps: Floats, array: SensorArray) -> BaselineEstimate:
    """Observe the three table rates, pinv(P) y, alone: n gyros are seen through three numbers a sample."""
    return _through_transform(w_rps, y_rps, array, table_rates(array))


def augmented_observation(w_rps: Floats, y_rps: Floats, array: SensorArray) -> BaselineEstimate:
    """Observe the three table rates and the n - 3 parity combinations that no body rate reaches.

    Both together are an invertible transform of the n outputs.
    """
    rates = table_rates(array)
    return _through_transform(w_rps, y_rps, array, np.vstack([rates, _null_rows(rates)]))


def table_rates(array: SensorArray) -> Floats:
    """Return the combinations (3, n) of the outputs that give the body rate of perfect gyros, pinv(P)."""
    return np.asarray(np.linalg.pinv(array.p), dtype=np.float64)


def unseen_directions(array: SensorArray, transform: Floats) -> Floats:
    """Return what ``transform`` (m, n) of the outputs cannot see, as unit vectors of x: (4 (n - m), n, 4).

    For each combination v of gyros that the transform loses come four directions: the biases in the ratio of v,
    then the sensitivity rows shifted in that ratio along body x, y, z. The latter mix k, s_j and s_k.
    """
    directions = []
    maps = regressor_maps(array)
    for v in _null_rows(transform):
        for column in range(4):
            shift = np.zeros(4)
            shift[column] = 1.0 if column else -1.0  # a bias lowers the output
            x = np.array([v_i * np.linalg.solve(a.T, shift) for v_i, a in zip(v, maps, strict=True)])
            directions.append(x / np.linalg.norm(x))
    return np.array(directions).reshape(-1, len(array), 4)


def _through_transform(w_rps: Floats, y_rps: Floats, array: SensorArray, transform: Floats) -> BaselineEstimate:
    """Estimate all 4 n states together from ``transform`` (m, n) of the output error, weighted for its noise.

    ``w_rps`` (N, 3) are body rates, ``y_rps`` (N, n) the outputs. States that it does not show are NaN, as are their
    sigmas; the result also has the directions that it cannot see.
    """
    rows, (m, n) = len(y_rps), transform.shape
    white = np.linalg.solve(np.linalg.cholesky(transform @ transform.T), transform)
    observed = (y_rps - w_rps @ array.p.T) @ white.T
    columns, maps = regressors(w_rps), regressor_maps(array)
    shared = columns.T @ columns
    each = np.einsum("iab,bc,ldc->iald", maps, shared, maps)  # [1, w] products seen by gyros i and l
    information = (each * (white.T @ white)[:, None, :, None]).reshape(4 * n, 4 * n)
    right = np.einsum("iab,bm,mi->ia", maps, columns.T @ observed, white).ravel()
    values, vectors = np.linalg.eigh(information)
    sees = values > _NULL_SHARE * values[-1]
    inverse = (vectors[:, sees] / values[sees]) @ vectors[:, sees].T
    x = inverse @ right
    noise = np.sqrt((np.sum(observed**2) - right @ x) / (rows * m - int(sees.sum())))
    covariance = np.array([noise**2 * inverse[4 * i : 4 * i + 4, 4 * i : 4 * i + 4] for i in range(n)])
    states, sd = decoded(x.reshape(n, 4), covariance)
    hidden = np.sum(vectors[:, ~sees] ** 2, axis=1).reshape(n, 4) > _SEEN
    # A misalignment is s / (1 - k): it is seen where both are.
    hidden[:, 2:] |= hidden[:, :1]
    states[hidden], sd[hidden] = np.nan, np.nan
    # Output error 6n, transform 2mn, squares 2m, products of [1, w] with each other 20 and with the transformed 8m.
    return BaselineEstimate(states, sd, rows * (6 * n + 2 * m * n + 10 * m + 20), unseen_directions(array, transform))


def _null_rows(matrix: Floats) -> Floats:
    """Return an orthonormal basis (n - m, n) of what ``matrix`` (m, n) maps to zero, its largest entries positive."""
    _, singular, right = np.linalg.svd(matrix)
    basis = right[int(np.sum(singular > _NULL_SHARE * singular[0])) :]
    largest = np.take_along_axis(basis, np.abs(basis).argmax(axis=1)[:, None], axis=1)
    return np.asarray(basis * np.sign(largest))


def _from_coefficients(array: SensorArray, coefficients: Floats, covariance: Floats) -> tuple[Floats, Floats]:
    """Return x (n, 4) and its covariance from the coefficients (n, 4) of the output error on [1, w]."""
    inverse = np.linalg.inv(regressor_maps(array).transpose(0, 2, 1))
    return np.einsum("nab,nb->na", inverse, coefficients), inverse @ covariance @ inverse.transpose(0, 2, 1)
