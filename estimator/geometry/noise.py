"""Noise of a gyro: angle random walk, bias instability, rate random walk; covariance of means, Allan deviation.

Bias instability is flicker noise of two-sided density ``B^2 / (2 pi f)`` (IEEE Std 952, Annex C), whose Allan
deviation is flat at 0.664 B. It is represented by Gauss-Markov processes spread evenly over the logarithm of the
correlation time, each with variance ``B^2 / pi`` per unit of it, from a second to ten times the span looked at.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from estimator.types import Floats

SD_OF_MEDIAN = 1.4826
"""Standard deviation of a normal distribution over the median of its distances from the middle."""
_STEPS_A_DECADE = 2
_SHORTEST_S = 1.0
_FEWEST_SAMPLES = 9


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """Angle random walk in rad/s/rtHz, bias instability in rad/s, rate random walk in rad/s/rts."""

    arw: float
    instability: float = 0.0
    walk: float = 0.0


@dataclass(frozen=True, slots=True)
class NoiseFound:
    """Noise of one gyro as found, and what 95 % of the expectation is below."""

    mean: NoiseModel
    instability_below: float
    walk_below: float


@dataclass(frozen=True, slots=True, eq=False)
class MeansCovariance:
    """Covariance of means over blocks of one length, per unit of each kind of noise squared, each (B, B).

    ``white`` is the diagonal (B,): one over the time that a block holds samples for.
    """

    white: Floats
    flicker: Floats
    walk: Floats

    @classmethod
    def of(cls, t_s: Floats, length_s: float, held_s: Floats) -> Self:
        """Return it for blocks centred at ``t_s`` (B,), of which samples cover ``held_s`` (B,)."""
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


def allan_deviation_of_parts(
    parts_rps: Sequence[Floats], period_s: float, per_decade: int = 5
) -> tuple[Floats, Floats]:
    """Return averaging times (t,) and the overlapping Allan deviation (t, m) of rates evenly sampled.

    They come in stretches (n, m) that do not follow on each other; each counts by its differences. The times go up to
    a third of the longest, where an estimate still rests on a few averages.
    """
    longest = max((len(part) for part in parts_rps), default=0)
    if longest < _FEWEST_SAMPLES:
        return np.empty(0), np.empty((0, parts_rps[0].shape[1] if parts_rps else 0))
    last = longest // 3
    widths = np.unique(
        np.round(np.logspace(0, np.log10(last), max(int(np.log10(last) * per_decade), 1) + 1)).astype(int)
    )
    squares = np.zeros((len(widths), parts_rps[0].shape[1]))
    counts = np.zeros((len(widths), 1))
    for rate_rps in parts_rps:
        angle = np.vstack([np.zeros((1, rate_rps.shape[1])), np.cumsum(rate_rps - rate_rps.mean(axis=0), axis=0)])
        for row, width in enumerate(widths[3 * widths <= len(rate_rps)]):
            second = angle[2 * width :] - 2 * angle[width:-width] + angle[: -2 * width]
            squares[row] += 0.5 * np.sum(second**2, axis=0) / width**2
            counts[row] += len(second)
    return widths * period_s, np.sqrt(squares / counts)


def identify(tau_s: Floats, deviation_rps: Floats, span_s: float) -> list[NoiseModel]:
    """Return the noise of each gyro whose Allan deviation (t, m), of ``span_s`` in all, was measured.

    The three terms of the Allan variance are fitted, none below zero. A point counts by its number of independent
    averages, ``span / tau``. What the span is too short for comes out as zero or as chance would have it.
    """
    from scipy.optimize import nnls

    shapes = np.column_stack([1 / tau_s, np.full_like(tau_s, 2 * np.log(2) / np.pi), tau_s / 3])
    found = []
    for variance in deviation_rps.T**2:
        weight = np.sqrt(span_s / tau_s) / variance
        scale = np.linalg.norm(shapes * weight[:, None], axis=0)
        parts, _ = nnls(shapes * weight[:, None] / scale, variance * weight)
        found.append(NoiseModel(*(float(part) for part in np.sqrt(parts / scale))))
    return found
