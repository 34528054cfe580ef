"""Block-information (Gram) form of the batch estimate.

All gyros of a source share the regressors [1, w], so the products of the columns [1, w, y] are everything
an estimate needs (sufficient statistics): one pass over the data, any number of gyros, sums of blocks and of
recordings are sums of matrices, and the digits that a covariance filter loses are kept.
"""

from dataclasses import dataclass

import numpy as np

from estimator.errors import RecordingError
from estimator.geometry.array import SensorArray
from estimator.geometry.model import Prior, regressor_maps
from estimator.observations.rows import observations
from estimator.recordings.motion.body_rates import GAP_NS
from estimator.recordings.recording import ImuData, Recording
from estimator.types import Floats

_LEAST_NOISE_RPS = 1e-9  # below any gyro; without noise at all the information has no inverse
_CHUNK_ROWS = 8192  # 8192 x 8 columns stay in the second-level cache while they are multiplied


@dataclass(frozen=True, slots=True, eq=False)
class Gram:
    """Products of the columns [1, wx, wy, wz, y_1 ... y_m], summed over ``rows`` rows."""

    rows: int
    products: Floats

    @classmethod
    def empty(cls, channels: int) -> "Gram":
        """Return the sum over no rows."""
        return cls(0, np.zeros((4 + channels, 4 + channels)))

    @classmethod
    def of(cls, w_rps: Floats, y_rps: Floats, weight: Floats | None = None) -> "Gram":
        """Return the products of columns [1, body rates (rows, 3), outputs (rows, m)], summed in chunks.

        Each row, with its 1, is multiplied by ``weight`` (rows,) before, if that is given.
        """
        rows, channels = y_rps.shape
        total = np.zeros((4 + channels, 4 + channels))
        # Columns lie along rows of the workspace: filling it costs half of what interleaved columns cost.
        columns = np.empty((4 + channels, min(rows, _CHUNK_ROWS)))
        for start in range(0, rows, _CHUNK_ROWS):
            stop = min(start + _CHUNK_ROWS, rows)
            block = columns[:, : stop - start]
            block[0] = 1.0
            block[1:4] = w_rps[start:stop].T
            block[4:] = y_rps[start:stop].T
            if weight is not None:
                block *= weight[start:stop]
            total += block @ block.T
        return cls(rows, total)

    def __add__(self, other: "Gram") -> "Gram":
        return Gram(self.rows + other.rows, self.products + other.products)


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Estimate of one source: states x (m, 4), covariance (m, 4, 4), noise of one row (m,) in rad/s."""

    x: Floats
    covariance: Floats
    noise_rps: Floats


def solve(gram: Gram, array: SensorArray, prior: Prior, noise_rps: Floats | None = None) -> Solution:
    """Return the estimate of [k, b, s_j, s_k] of every gyro under the prior.

    ``noise_rps`` (m,) is the white noise of one row; by default it is taken from the residual of a fit without the
    prior, with ``_LEAST_NOISE_RPS`` as the least. States that the rows do not show stay as the prior has them.
    """
    m = len(array)
    maps = regressor_maps(array)
    shared, cross = gram.products[:4, :4], gram.products[:4, 4:]
    nominal = np.vstack([np.zeros(m), array.p.T])  # y that a perfect gyro gives, on the columns [1, w]
    error = cross - shared @ nominal  # [1, w]' z
    squares = (
        np.diag(gram.products)[4:]
        - 2 * np.einsum("ij,ij->j", nominal, cross)
        + np.einsum("ij,ik,kj->j", nominal, shared, nominal)
    )
    information = maps @ shared @ maps.transpose(0, 2, 1)
    right = np.einsum("mij,jm->mi", maps, error)
    if noise_rps is None:
        noise_rps = np.empty(m)
        for i in range(m):
            # Least squares alone: the residual must not carry the pull of the prior.
            least = np.linalg.lstsq(information[i], right[i], rcond=1e-13)[0]
            rest = squares[i] - right[i] @ least
            noise_rps[i] = np.sqrt(max(rest, 0.0) / max(gram.rows - 4, 1))
        noise_rps = np.maximum(noise_rps, _LEAST_NOISE_RPS)
    inverse_prior = np.diag(1 / prior.variances())
    scaled = information / (noise_rps**2)[:, None, None] + inverse_prior
    x = np.linalg.solve(scaled, (right / (noise_rps**2)[:, None])[..., None])[..., 0]
    covariance = np.linalg.inv(scaled)
    return Solution(x, 0.5 * (covariance + covariance.transpose(0, 2, 1)), noise_rps)


def gram_of(recording: Recording, source: str, data: ImuData) -> Gram:
    """Return the Gram matrix of one source over all rows that the reference covers.

    Raises RecordingError for fewer than four turns, or fewer than eight rows against any reference but turns and poses.
    """
    gram = Gram.empty(len(data.array))
    for part in observations(recording, data):
        gram += Gram.of(part.w_rps, part.y_rps, part.weight)
    turns = recording.turns
    if turns is not None and gram.rows < 4:
        raise RecordingError(
            f"{recording.name}: {gram.rows} of {len(turns.sd_rad)} turns hold samples of {source}: "
            "four states per gyro need at least four turns or rests"
        )
    instants_ns = recording.reference.instants_ns
    if instants_ns is not None and gram.rows < 8:
        step_s = float(np.median(np.diff(instants_ns, prepend=0))) * 1e-9
        seldom = f", whose readings are {step_s:.3g} s apart: read it more often" if step_s > GAP_NS * 1e-9 else ""
        raise RecordingError(
            f"{recording.name}: source {source} has {len(data.t_ns)} samples, {gram.rows} of them with "
            f"reference data: too few to estimate four states per gyro{seldom}"
        )
    return gram
