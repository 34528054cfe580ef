"""Noise of a gyro: angle random walk, bias instability, rate random walk; covariance of means.

Bias instability is flicker noise of two-sided density ``B^2 / (2 pi f)`` (IEEE Std 952, Annex C), whose Allan
deviation is flat at 0.664 B. It is represented by Gauss-Markov processes spread evenly over the logarithm of the
correlation time, each with variance ``B^2 / pi`` per unit of it, from a second to ten times the span looked at.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np

from estimator.types import Floats

SD_OF_MEDIAN = 1.4826
"""Standard deviation of a normal distribution over the median of its distances from the middle."""
_STEPS_A_DECADE = 2
_SHORTEST_S = 1.0


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """Angle random walk in rad/s/rtHz, bias instability in rad/s, rate random walk in rad/s/rts."""

    arw: float
    instability: float = 0.0
    walk: float = 0.0


@dataclass(frozen=True, slots=True)
class NoiseFound:
    """Estimated noise of one gyro, with upper 95 % limits."""

    mean: NoiseModel
    instability_below: float
    walk_below: float


@dataclass(frozen=True, slots=True, eq=False)
class MeansCovariance:
    """Covariance of block means, for unit size of each kind of noise, each (B, B); for blocks of equal length.

    ``white`` is the diagonal (B,): one over the time that is covered by samples.
    """

    white: Floats
    flicker: Floats
    walk: Floats

    @classmethod
    def of(cls, t_s: Floats, length_s: float, held_s: Floats) -> Self:
        """Return the covariance for blocks of ``length_s`` centred at ``t_s`` (B,), with samples over ``held_s`` (B,).

        It is kept in three parts of unit noise, white, flicker and walk, which ``under`` puts together.
        """
        lag = np.abs(t_s[:, None] - t_s[None, :])
        same = np.eye(len(t_s), dtype=bool)
        longest = 10 * max(float(t_s[-1] - t_s[0]), 10 * _SHORTEST_S)
        count = int(np.ceil(np.log10(longest / _SHORTEST_S) * _STEPS_A_DECADE)) + 1
        times = np.geomspace(_SHORTEST_S, longest, count)
        variance = np.log(times[1] / times[0]) / np.pi
        flicker = np.zeros_like(lag)
        for time_s in times:
            x = length_s / time_s
            flicker += np.where(
                same,
                2 * (x - 1 + np.exp(-x)) / x**2,
                2 * (np.cosh(x) - 1) / x**2 * np.exp(-np.maximum(lag, length_s) / time_s),
            )
        since = t_s - t_s[0]
        return cls(1 / held_s, variance * flicker, np.minimum(since[:, None], since[None, :]))

    def under(self, noise: NoiseModel) -> Floats:
        """Return the covariance (B, B) in (rad/s)^2 under this noise."""
        total = noise.instability**2 * self.flicker + noise.walk**2 * self.walk
        total[np.diag_indices_from(total)] += noise.arw**2 * self.white
        return total
