"""The likelihood of N, B and K by bands of the cosine transform, greatest and along one of the three.

The sum of squares ``S`` of ``n`` coefficients of a band has a chi-square distribution about ``n v``, with the variance
``v = shapes @ squares`` and the ``squares`` of N, B and K, none below zero. All functions take p problems at once.
"""

from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from estimator.types import Flags, Floats

_MOST_STEPS, _ENOUGH = 40, 1e-3
_HALVINGS = 8
_MOST_TRIES, _NEAR = 20, 0.01
_FREE = [np.array(free) for free in product((False, True), repeat=3) if any(free)]
"""Which of the three squares may be above zero."""


@dataclass(frozen=True, slots=True, eq=False)
class Bands:
    """Sums of squares (p, b) over bands, the number of coefficients in each (p, b), shapes (b, 3).

    A band without coefficients has a sum of 0 and no influence.
    """

    sums: Floats
    counts: Floats
    shapes: Floats

    def select(self, rows: NDArray[np.intp]) -> "Bands":
        """Return the problems of these numbers, which may come again."""
        return replace(self, sums=self.sums[rows], counts=self.counts[rows])

    def without(self, dropped: Flags) -> "Bands":
        """Return the same without some bands (p, b) or (b,)."""
        return replace(self, sums=np.where(dropped, 0.0, self.sums), counts=np.where(dropped, 0.0, self.counts))

    def deviance(self, squares: Floats) -> Floats:
        """Return minus twice the log likelihood (p,) of squares (p, 3), but for a constant.

        Infinite where a band with coefficients would have no variance.
        """
        variance = squares @ self.shapes.T
        with np.errstate(divide="ignore", invalid="ignore"):
            parts = self.counts * np.log(variance) + self.sums / variance
        parts = np.where(self.counts > 0, parts, 0.0)
        return np.asarray(np.where(np.isfinite(parts).all(axis=1), parts.sum(axis=1), np.inf))

    def information(self, squares: Floats) -> Floats:
        """Return the Fisher information (p, 3, 3) of the squares."""
        weight = self.counts / (2 * (squares @ self.shapes.T) ** 2)
        return np.asarray(np.einsum("bi,pb,bj->pij", self.shapes, weight, self.shapes))

    def fit(self, start: Floats, fixed: int | None = None) -> tuple[Floats, Floats]:
        """Return the most likely squares (p, 3) and their deviance (p,); column ``fixed`` stays as in ``start``.

        Each step is a weighted least-squares fit with the variances of the previous step (Fisher scoring), halved until
        the likelihood rises.
        """
        squares = start.copy()
        deviance = self.deviance(squares)
        for _ in range(_MOST_STEPS):
            direction = self._scored(squares, fixed) - squares
            share = np.ones(len(squares))
            for _ in range(_HALVINGS):
                tried = squares + share[:, None] * direction
                reached = self.deviance(tried)
                worse = reached > deviance
                if not worse.any():
                    break
                share[worse] /= 2
            better = reached <= deviance
            gain = np.where(better, deviance - reached, 0.0)
            squares = np.where(better[:, None], tried, squares)
            deviance = np.where(better, reached, deviance)
            if not (gain > _ENOUGH).any():
                break
        return squares, deviance

    def _scored(self, squares: Floats, fixed: int | None) -> Floats:
        """Return the non-negative least-squares fit (p, 3) of N, B and K squared, weighted by the variances at
        ``squares``.

        The term number ``fixed`` keeps its value of ``squares`` (p, 3); None fits all.
        """
        weight = 1 / (squares @ self.shapes.T) ** 2
        gram = np.einsum("bi,pb,bj->pij", self.shapes, self.counts * weight, self.shapes)
        right = (self.sums * weight) @ self.shapes
        found = np.zeros_like(squares)
        if fixed is not None:
            right = right - gram[:, :, fixed] * squares[:, [fixed]]
        scale = np.sqrt(np.maximum(np.einsum("pii->pi", gram), 1e-300))
        gram = gram / (scale[:, :, None] * scale[:, None, :])
        right = right / scale
        least = np.zeros(len(squares))
        for free in _FREE:
            if fixed is not None and free[fixed]:
                continue
            matrix = np.where(free[:, None] & free, gram, np.eye(3))
            solution = np.linalg.solve(matrix, np.where(free, right, 0.0)[:, :, None])[:, :, 0]
            value = -np.sum(solution * right, axis=1)
            better = (solution >= 0).all(axis=1) & (value < least)
            found[better] = solution[better]
            least[better] = value[better]
        found /= scale
        if fixed is not None:
            found[:, fixed] = squares[:, fixed]
        return found

    def crossing(self, best: Floats, term: int, rise: float, *, above: bool) -> Floats:
        """Return the square (p,) of a term at which the deviance, the others fitted, is ``rise`` above its minimum.

        ``best`` (p, 3) are the most likely squares of the three terms of each of p sensors. The crossing is searched
        above that of the term, or below it if ``above`` is false; there it is 0 if the deviance rises less than that.
        """
        least = self.deviance(best)
        inner = best[:, term]
        variance = np.linalg.inv(self._conditioned(best))[:, term, term]
        outer = inner + 2 * np.sqrt(variance) if above else inner / 2
        near = np.full(len(best), -rise)
        guess = best
        for _ in range(_MOST_TRIES):
            guess, deviance = self._fit_at(guess, term, outer)
            far = deviance - least - rise
            short = far < 0
            if not short.any():
                break
            inner, near = np.where(short, outer, inner), np.where(short, far, near)
            outer = np.where(short, outer * 2 if above else outer / 2, outer)
        crossed = far >= 0
        for _ in range(_MOST_TRIES):
            root_near = np.sqrt(rise) - np.sqrt(np.maximum(near + rise, 0.0))
            root_far = np.sqrt(np.maximum(far + rise, 0.0)) - np.sqrt(rise)
            share = np.clip(root_near / np.maximum(root_near + root_far, 1e-300), 0.02, 0.98)
            middle = inner + share * (outer - inner)
            guess, deviance = self._fit_at(guess, term, middle)
            there = deviance - least - rise
            if (np.abs(there[crossed]) < _NEAR * rise).all():
                break
            outside = there > 0
            outer, far = np.where(outside, middle, outer), np.where(outside, there, far)
            inner, near = np.where(outside, inner, middle), np.where(outside, near, there)
        return np.asarray(middle if above else np.where(crossed, middle, 0.0))

    def _conditioned(self, squares: Floats) -> Floats:
        """Return the Fisher information (p, 3, 3), and a little more where it is singular."""
        information = self.information(squares)
        diagonal = np.einsum("pii->pi", information)
        return np.asarray(information + 1e-9 * diagonal[:, :, None] * np.eye(3))

    def _fit_at(self, guess: Floats, term: int, square: Floats) -> tuple[Floats, Floats]:
        """Return the fit with this square (p,) of a term, begun at a guess (p, 3), and its deviance (p,)."""
        start = guess.copy()
        start[:, term] = square
        dark = ~np.isfinite(self.deviance(start))
        start[dark] += self._faint(term)[dark]
        return self.fit(start, term)

    def _faint(self, term: int) -> Floats:
        """Return squares (p, 3) of the other terms so small that every band just has some variance."""
        mean = self.sums.sum(axis=1) / self.counts.sum(axis=1)
        faint = mean[:, None] / self.shapes.max(axis=0)
        faint[:, term] = 0.0
        return np.asarray(faint)
