"""Estimates and sigmas under noise that is not white, and that noise itself, from block means.

How much of the noise is bias instability and how much rate random walk is not known beforehand. A grid of ratios
to the angle random walk is gone through; for each, generalised least squares gives the states, and the residual
the likelihood (restricted, the states and the scale integrated out). The estimate is the mean over the grid and
its covariance holds the doubt about the noise too. Gyros of one device are of one make: what the others say of
the ratios is the better part of what is expected of each.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.array import SensorArray
from estimator.blocks import Blocks
from estimator.model import Prior, regressor_maps
from estimator.noise import MeansCovariance, NoiseModel

Floats = NDArray[np.float64]

MOST_BLOCKS = 200
"""Blocks are merged until no more than this are left: the work grows with their third power."""
FEWEST_BLOCKS = 24
"""Fewer do not tell what noise is not white."""
_LEAST_BLOCKS = 10  # fewer do not tell how much noise there is
_FINEST_S = 1.0
_WHITE = 0.65  # expected before the data: that a kind of coloured noise is too small to matter
_OWN = 0.1  # share of the expectation on a gyro that does not follow the other gyros of its device
_STATED_SPREAD = np.log(3.0)  # how far a device's instability may be from its data sheet
_LEAST_VARIANCE = 1e-30
_ACCELERATING = 0.02  # change of rate from block to block, as a share of the largest rate, that counts as a ramp
_FEWEST_STEADY = 8


@dataclass(frozen=True, slots=True, eq=False)
class NoiseGrid:
    """Ratios of instability (rtHz) and walk (Hz) to the angle random walk, (G,) each, with log expectations."""

    instability: Floats
    walk: Floats
    log_prior: Floats

    @classmethod
    def over(cls, span_s: float, stated: NoiseModel | None = None) -> NoiseGrid:
        """Return the grid that a recording of this length can tell anything about; ``stated``: the data sheet's."""
        instability, chance_b = _expected(
            np.geomspace(0.7, 100, 10) / np.sqrt(span_s), stated.instability / stated.arw if stated else 0.0
        )
        walk, chance_k = _expected(np.geomspace(0.3, 60, 7) / span_s, stated.walk / stated.arw if stated else 0.0)
        b, k = (part.ravel() for part in np.meshgrid(instability, walk, indexing="ij"))
        return cls(b, k, np.log(np.outer(chance_b, chance_k).ravel()))

    @classmethod
    def white(cls) -> NoiseGrid:
        """Return the grid that holds white noise only, for recordings too short to tell."""
        return cls(np.zeros(1), np.zeros(1), np.zeros(1))


def _expected(sizes: Floats, stated: float) -> tuple[Floats, Floats]:
    values = np.concatenate([[0.0], sizes])
    if stated <= 0:
        return values, np.concatenate([[_WHITE], np.full(len(sizes), (1 - _WHITE) / len(sizes))])
    below = stated < sizes[0]  # a size that cannot matter counts as none
    chance = np.exp(
        -0.5 * (np.log(np.concatenate([[sizes[0] / 2], sizes]) / max(stated, sizes[0] / 2)) / _STATED_SPREAD) ** 2
    )
    chance[0] = chance[0] if below else min(chance[0], 0.05)
    return values, chance / chance.sum()


@dataclass(frozen=True, slots=True, eq=False)
class GridFit:
    """For each grid point and gyro: states x (G, m, 4), covariance (G, m, 4, 4), ARW (G, m), evidence (G, m)."""

    grid: NoiseGrid
    x: Floats
    covariance: Floats
    arw: Floats
    log_evidence: Floats


@dataclass(frozen=True, slots=True)
class NoiseFound:
    """Noise of one gyro as found, and what 95 % of the expectation is below."""

    mean: NoiseModel
    instability_below: float
    walk_below: float


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """What a fit needs of one source: its blocks (as of ``coarse``), its array, its data sheet."""

    blocks: Blocks
    array: SensorArray
    prior: Prior


def coarse(blocks: Blocks) -> Blocks:
    """Return blocks of a second or more, at most about 200.

    Where that would leave less than ten, they are shorter, and less than ``FEWEST_BLOCKS`` nevertheless.
    """
    span = int(blocks.index[-1] - blocks.index[0]) + 1 if len(blocks.index) else 1
    factor = max(round(_FINEST_S / blocks.length_s), -(-span // MOST_BLOCKS))
    return blocks.merged(max(min(factor, span // _LEAST_BLOCKS), 1))


def fit_grids(parts: Sequence[Part], grid: NoiseGrid) -> list[GridFit]:
    """Return the estimate of every gyro of each source at every point of the grid."""
    groups: dict[bytes, list[int]] = {}
    for number, part in enumerate(parts):  # sources with the same blocks share the work on their covariance
        blocks = part.blocks
        key = blocks.index.tobytes() + blocks.held_s.tobytes() + np.float64(blocks.length_s).tobytes()
        groups.setdefault(key, []).append(number)
    fits: dict[int, GridFit] = {}
    for members in groups.values():
        fits.update(zip(members, _fit_group([parts[n] for n in members], grid), strict=True))
    return [fits[n] for n in range(len(parts))]


def _fit_group(parts: Sequence[Part], grid: NoiseGrid) -> list[GridFit]:
    blocks = parts[0].blocks
    means = MeansCovariance.of(blocks.t_s, blocks.length_s, blocks.held_s)
    columns = [np.column_stack([np.ones(len(p.blocks.index)), p.blocks.w_rps, p.blocks.z_rps]) for p in parts]
    edges = np.cumsum([0, *(c.shape[1] for c in columns)])
    side_by_side = np.hstack(columns)
    ramp = np.mean([_ramp_variance(p.blocks) for p in parts], axis=0)
    means = MeansCovariance(means.white + ramp, means.flicker, means.walk)
    fits = [_empty_fit(grid, len(p.array)) for p in parts]
    for g, (instability, walk) in enumerate(zip(grid.instability, grid.walk, strict=True)):
        covariance = means.under(NoiseModel(1.0, float(instability), float(walk)))
        log_determinant = 2 * float(np.log(np.diag(np.linalg.cholesky(covariance))).sum())
        whitened = np.linalg.solve(covariance, side_by_side)
        for part, own, fit, start, stop in zip(parts, columns, fits, edges[:-1], edges[1:], strict=True):
            _fit_point(part, own.T @ whitened[:, start:stop], log_determinant, float(ramp.max()), fit, g)
    return fits


def _ramp_variance(blocks: Blocks) -> Floats:
    """Return what a mean over each block scatters more (B,) because the rate changes, over the ARW squared.

    While an axis accelerates, what the table reports is off by its timing and by what lies between two readings.
    How much is taken from the residual there, compared with the residual where the rate is steady.
    """
    none = np.zeros(len(blocks.index))
    size = float(np.abs(blocks.w_rps).max(initial=0.0))
    change = np.abs(np.diff(blocks.w_rps, axis=0, prepend=blocks.w_rps[:1])).max(axis=1)
    ramp = np.maximum(change, np.append(change[1:], 0.0)) > _ACCELERATING * size
    pairs = ~(ramp[1:] | ramp[:-1]) & (np.diff(blocks.index) == 1)
    if pairs.sum() < _FEWEST_STEADY or not ramp.any():
        return none
    regressors = np.column_stack([np.ones(len(ramp)), blocks.w_rps])
    rest = blocks.z_rps - regressors @ np.linalg.lstsq(regressors[~ramp], blocks.z_rps[~ramp], rcond=1e-10)[0]
    white = np.mean(np.diff(rest, axis=0)[pairs] ** 2, axis=0) / 2 * blocks.length_s
    excess = np.mean(rest[ramp] ** 2, axis=0) - np.mean(rest[~ramp] ** 2, axis=0)
    # Only what is beyond chance: the mean square of so few has this much scatter of its own.
    excess -= 2 * np.sqrt(2 / ramp.sum()) * np.mean(rest[~ramp] ** 2, axis=0)
    return np.where(ramp, float(np.mean(np.maximum(excess, 0.0) / np.maximum(white, _LEAST_VARIANCE))), 0.0)


def _empty_fit(grid: NoiseGrid, m: int) -> GridFit:
    count = len(grid.instability)
    return GridFit(
        grid, np.empty((count, m, 4)), np.empty((count, m, 4, 4)), np.empty((count, m)), np.empty((count, m))
    )


def _fit_point(part: Part, products: Floats, log_determinant: float, ramp: float, fit: GridFit, g: int) -> None:
    """Fill row ``g`` of a fit from the products of [1, w, z] under an angle random walk of one."""
    blocks, m = part.blocks, len(part.array)
    squares, rank, log_information = _residual(products)
    dof = max(len(blocks.index) - rank, 1)
    variance = np.maximum(squares / dof, _LEAST_VARIANCE)
    fit.arw[g] = np.sqrt(variance)
    fit.log_evidence[g] = -0.5 * (dof * np.log(variance) + log_determinant + log_information)
    total = np.array(products)
    # What happens within a block is judged against the noise at the lowest frequency that fits into it.
    lowest_hz = 0.5 / blocks.length_s
    density = (
        1
        + ramp * blocks.length_s
        + fit.grid.instability[g] ** 2 / (2 * np.pi * lowest_hz)
        + (fit.grid.walk[g] / (2 * np.pi * lowest_hz)) ** 2
    )
    total[1:, 1:] += blocks.within * (blocks.period_s / density)
    maps = regressor_maps(part.array)
    information = maps @ total[:4, :4] @ maps.transpose(0, 2, 1)
    right = np.einsum("mij,jm->mi", maps, total[:4, 4 : 4 + m])
    scaled = information / variance[:, None, None] + np.diag(1 / part.prior.variances())
    covariance = np.linalg.inv(scaled)
    fit.covariance[g] = 0.5 * (covariance + covariance.transpose(0, 2, 1))
    fit.x[g] = np.linalg.solve(scaled, (right / variance[:, None])[..., None])[..., 0]


def weights(fits: Sequence[GridFit]) -> list[Floats]:
    """Return the weight (G, m) of each grid point for each gyro of the sources of one device.

    All fits must be over the same grid. A gyro is expected to be like the others of its device, but for a share.
    """
    evidence = np.hstack([fit.log_evidence for fit in fits])
    own = fits[0].grid.log_prior[:, None]
    others = own + evidence.sum(axis=1, keepdims=True) - evidence
    others = np.exp(others - others.max(axis=0))
    expected = (1 - _OWN) * others / others.sum(axis=0) + _OWN * np.exp(own)
    if evidence.shape[1] == 1:
        expected = np.exp(own)
    total = evidence + np.log(expected)
    total = np.exp(total - total.max(axis=0))
    total /= total.sum(axis=0)
    return np.split(total, np.cumsum([fit.x.shape[1] for fit in fits])[:-1], axis=1)


def combine(fit: GridFit, weight: Floats) -> tuple[Floats, Floats, list[NoiseFound]]:
    """Return states x (m, 4), covariance (m, 4, 4) and the noise of each gyro, over the weighted grid."""
    x = np.einsum("gm,gmi->mi", weight, fit.x)
    spread = fit.x - x
    covariance = np.einsum("gm,gmij->mij", weight, fit.covariance + spread[..., :, None] * spread[..., None, :])
    return x, covariance, [_noise(fit, weight[:, i], i) for i in range(x.shape[0])]


def _noise(fit: GridFit, weight: Floats, gyro: int) -> NoiseFound:
    arw = fit.arw[:, gyro]
    instability, walk = fit.grid.instability * arw, fit.grid.walk * arw
    mean = NoiseModel(float(weight @ arw), float(weight @ instability), float(weight @ walk))
    return NoiseFound(mean, quantile(instability, weight), quantile(walk, weight))


def quantile(values: Floats, weight: Floats, share: float = 0.95) -> float:
    """Return the value below which a share of the weight lies."""
    order = np.argsort(values)
    reached = np.searchsorted(np.cumsum(weight[order]), share - 1e-12)
    return float(values[order][min(int(reached), len(order) - 1)])


def _residual(products: Floats) -> tuple[Floats, int, float]:
    """Return squares left by least squares on [1, w] (m,), its rank, and log determinant of what was seen."""
    shared, cross = products[:4, :4], products[:4, 4:]
    scale = np.sqrt(np.maximum(np.diag(shared), 1e-300))
    values, vectors = np.linalg.eigh(shared / np.outer(scale, scale))
    seen = values > 1e-10
    basis = (vectors / scale[:, None])[:, seen]
    parts = basis.T @ cross
    squares = np.diag(products)[4:] - np.sum(parts**2 / values[seen, None], axis=0)
    logs = float(np.log(values[seen]).sum() + 2 * np.log(scale).sum())
    return np.maximum(squares, 0.0), int(seen.sum()), logs
