"""The wandering bias of inertial sensors: flicker noise as a sum of Gauss-Markov processes, and a random walk."""

import math

import numpy as np

from drivers.types import Floats

_CORRELATION_TIMES_S = np.array([1.0, 10.0, 100.0, 1000.0])
# A decade-spaced sum of Gauss-Markov processes of equal variance s^2 has a flat Allan deviation of 0.775 s;
# bias instability B is the one whose floor is 0.664 B (IEEE Std 952, Annex C).
_SHARE = 0.664 / 0.775


class Wander:
    """The biases of several sensors of a kind, in the unit of their outputs."""

    def __init__(
        self, *, count: int, bias_instability: float, random_walk: float, period_s: float, random: np.random.Generator
    ) -> None:
        """Start ``count`` sensors in a state as after a long time, drawn from ``random``; ``period_s`` is one sample.

        ``bias_instability`` is in the unit of the outputs, ``random_walk`` in that per root second; the walk starts at
        0.
        """
        self._size = _SHARE * bias_instability
        self._random_walk = random_walk
        self._period_s = period_s
        self._random = random
        self._processes = random.standard_normal((len(_CORRELATION_TIMES_S), count))
        self._walk = np.zeros(count)
        self._decays: dict[int, tuple[Floats, Floats]] = {}

    def step(self, samples: int) -> Floats:
        """Move on by ``samples`` samples, and return the biases (count,) then."""
        keep, push = self._decay(samples)
        self._processes = keep * self._processes + push * self._random.standard_normal(self._processes.shape)
        if self._random_walk:
            step = self._random_walk * math.sqrt(samples * self._period_s)
            self._walk = self._walk + step * self._random.standard_normal(len(self._walk))
        return np.asarray(self._size * self._processes.sum(axis=0) + self._walk)

    def steps(self, samples: int, count: int) -> Floats:
        """Move on by ``count`` steps of ``samples`` samples, and return the biases (count, sensors) after each.

        They are those that as many calls of ``step`` would give.
        """
        keep, push = self._decay(samples)
        shape = self._processes.shape
        rows = shape[0] + bool(self._random_walk)
        noise = self._random.standard_normal((count, rows, shape[1]))
        pushed, processes = push * noise[:, : shape[0]], self._processes
        for row in pushed:  # becomes the processes
            row += keep * processes
            processes = row
        self._processes = processes.copy()
        walk = self._walk
        if self._random_walk:
            step = self._random_walk * math.sqrt(samples * self._period_s)
            walk = np.cumsum(np.vstack([walk, step * noise[:, -1]]), axis=0)[1:]
            self._walk = walk[-1].copy() if count else self._walk
        return np.asarray(self._size * pushed.sum(axis=1) + walk)

    def _decay(self, samples: int) -> tuple[Floats, Floats]:
        """Return the factors of the old processes and of new noise over this many samples."""
        if samples not in self._decays:
            keep = np.exp(-samples * self._period_s / _CORRELATION_TIMES_S)[:, None]
            self._decays[samples] = keep, np.sqrt(1 - keep**2)
        return self._decays[samples]
