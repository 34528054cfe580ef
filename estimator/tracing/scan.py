"""What is left of each gyro beside a model, and how much of it a candidate would take: cheap, before it is judged."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from estimator.estimation.evidence import Evidence, Term
from estimator.estimation.runs.run import Run
from estimator.estimation.spectra import GyroSpectra, cosines
from estimator.tracing.candidates import Candidate
from estimator.tracing.tones.peaks import highest
from estimator.types import Floats

_NEAR_S = 0.005  # about where its size seems to be an effect is looked for that is exact for its size only
_SHORTEST_S = 1e-4  # of a time constant, which is not negative
_LONGEST_S = 0.3  # of a delay or a time constant: what is slower than this is no such


def at(candidate: Candidate, theta: float) -> Candidate:
    """Return a candidate with another value of what is not linear in it."""
    assert candidate.of is not None
    return replace(candidate, effect=candidate.of(theta), theta=theta)


class Scan:
    """What is left of each gyro beside a model, whitened: how much an effect would take of it."""

    def __init__(
        self,
        runs: Sequence[Run],
        evidence: Evidence,
        terms: Sequence[Term],
        turned: dict[tuple[str, float, str], Floats],
        noise: int | None = None,
    ) -> None:
        """``turned`` keeps the cosines of columns from one scan to the next, ``noise`` is that beside the model."""
        self._kept = turned
        best = int(np.argmax(evidence.noise_weight(terms))) if noise is None else noise
        columns = [*range(4), *(c for t in terms for c in t.columns)]
        self._runs, self._spectra = runs, evidence.gyros
        self._roots, self._bases, self._rest = [], [], []
        for gyro in evidence.gyros:
            density = np.concatenate([evidence.density(gyro, s)[best][s.band] for s in gyro.stretches])
            lengths_s = np.concatenate([np.full(len(s.band), s.length_s) for s in gyro.stretches])
            root = np.sqrt(lengths_s / density) / gyro.arw
            whole = np.vstack(gyro.columns) / np.sqrt(density)[:, None]
            basis, _ = np.linalg.qr(whole[:, columns])
            z = whole[:, 4]
            self._roots.append(root)
            self._bases.append(basis)
            self._rest.append(z - basis @ (basis.T @ z))

    def _turn(self, candidate: Candidate, gyro: GyroSpectra) -> Floats:
        alike = candidate.alike and all(run.earth_rps is None for run in self._runs)
        source = str([s.run for s in gyro.stretches])
        key = candidate.name, float(candidate.theta or 0.0), source if alike else gyro.name
        if key not in self._kept:
            parts = gyro.parts(self._runs, lambda number, own: candidate.columns(self._runs[number], own))
            self._kept[key] = np.vstack([cosines(part) for part in parts])
        return self._kept[key]

    def size(self, candidate: Candidate) -> float:
        """Return the size of an effect, exact for its size, that leaves least: its first parameter, all gyros alike.

        It is not fitted to its own column, which noise of the reference makes too large.
        """
        assert candidate.start is not None
        if len(candidate.start) == 1:  # a table's own rates have next to no noise
            size = self._first_size(candidate)
            return self._first_size(at(candidate, size)) if size else size

        def gain(size: float) -> float:
            return self._gain_of(candidate, size)

        start = np.sort(np.append(candidate.start, self._first_size(candidate)))
        best = int(np.argmax([gain(size) for size in start.tolist()]))
        reach = max(abs(float(start[best])), _NEAR_S)
        least = -_LONGEST_S if candidate.start.min() <= 0 else _SHORTEST_S
        low = max(float(start[best - 1]) if best else -np.inf, float(start[best]) - reach, least)
        high = min(float(start[best + 1]) if best + 1 < len(start) else np.inf, float(start[best]) + reach, _LONGEST_S)
        return highest(gain, low, high)

    def _first_size(self, candidate: Candidate) -> float:
        """Return the size by the candidate as it is: right where it is small."""
        products = self._products(candidate)
        own, right = sum(own[0, 0] for own, _ in products), sum(right[0] for _, right in products)
        sign = -1.0 if candidate.theta and candidate.theta < 0 else 1.0  # a lag of the reference is a size of its own
        return float(np.clip(sign * right / max(own, 1e-30) * candidate.effect.largest[0], -_LONGEST_S, _LONGEST_S))

    def _gain_of(self, candidate: Candidate, size: float) -> float:
        """Return how much more probable a size makes what is left, each gyro under as much noise as then is left."""
        share = abs(size) / candidate.effect.largest[0] if size else 0.0
        total = 0.0
        for rest, (own, right) in zip(self._rest, self._products(at(candidate, size)), strict=True):
            before = float(rest @ rest)
            left = before - 2 * share * right[0] + share**2 * own[0, 0]
            total -= 0.5 * len(rest) * np.log(max(left, 1e-9 * before) / before)
        return float(total)

    def gain(self, candidate: Candidate) -> float:
        """Return by how much half the squares fall if an effect is let in, each gyro by itself."""
        total = 0.0
        for own, right in self._products(candidate):
            total += 0.5 * float(right @ np.linalg.solve(own + 1e-6 * np.eye(len(own)), right))
        return total

    def _products(self, candidate: Candidate) -> list[tuple[Floats, Floats]]:
        """Return by gyro the products (p, p) of a candidate's columns beside the model, and with the rest (p,)."""
        products = []
        for gyro, root, basis, rest in zip(self._spectra, self._roots, self._bases, self._rest, strict=True):
            new = self._turn(candidate, gyro) * root[:, None]
            new = new - basis @ (basis.T @ new)
            products.append((new.T @ new, new.T @ rest))
        return products

    def width(self, candidate: Candidate) -> float:
        """Return by how much what is not linear may move before half a natural logarithm is lost."""
        assert candidate.theta is not None
        top = self.gain(candidate)
        step = 0.02 * candidate.theta
        while step < candidate.theta:
            sides = [self.gain(at(candidate, candidate.theta + sign * step)) for sign in (-1, 1)]
            fall = top - 0.5 * sum(sides)
            if fall > 0.5:
                return float(step / np.sqrt(2 * fall))
            step *= 2
        return float(candidate.theta)

    def tuned(self, candidate: Candidate) -> Candidate:
        """Return a candidate with the most telling value of what is not linear in it."""
        start = candidate.start
        assert start is not None
        if candidate.by_size:
            return at(candidate, self.size(candidate))
        gains = [self.gain(at(candidate, theta)) for theta in start.tolist()]
        best = int(np.argmax(gains))
        low, high = float(start[max(best - 1, 0)]), float(start[min(best + 1, len(start) - 1)])
        theta = highest(lambda theta: self.gain(at(candidate, theta)), low, high)
        if self.gain(at(candidate, theta)) < gains[best]:
            theta = float(start[best])
        tuned = at(candidate, theta)
        # What it costs that the value was looked for: the share of its range that would do as well. Any instant of a
        # step is as probable as any other, of a time constant any ratio.
        width = np.sqrt(2 * np.pi) * self.width(tuned)
        spread = float(start[-1] - start[0])
        share = width / spread if candidate.run is not None else width / theta / candidate.range_log
        return replace(tuned, log_tries=float(-np.log(np.clip(share, 1e-4, 1.0))))
