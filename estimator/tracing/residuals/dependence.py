"""What a residual depends on: the share of its power explained by functions of time, rate, angle and so on."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.estimation.runs.run import Run
from estimator.tracing.candidates import candidates_of
from estimator.types import Floats

Columns = NDArray[np.intp]

_VARIABLES = ("time", "rate", "direction", "angle", "acceleration", "temperature", "gravity")
_BY_CHANCE = 1e-4  # a dependence more probable than this under white noise does not count
_INDEPENDENT = 1e-8  # share of a column's squares that must remain beside the others


@dataclass(frozen=True, slots=True)
class Dependence:
    """Share of a residual's power beyond the noise that depends on a variable; 0 where chance explains it. Shares
    overlap.

    ``p_value`` is the probability that white noise shows as much.
    """

    variable: str
    share: float
    p_value: float


@dataclass(frozen=True, slots=True, eq=False)
class Group:
    """Columns, the columns ``beside`` which they count, and the squares over the noise that the model's ``doubt``
    adds.
    """

    columns: Columns
    beside: Columns
    doubt: float = 0.0


class Regressors:
    """Functions of each variable over the blocks of runs; ``where`` gives the places of each variable's columns."""

    def __init__(self, runs: Sequence[Run]) -> None:
        """Take the candidates that can be tried on these runs and depend on a known variable.

        Nonlinear ones, unless their setting is a size, and those of single runs, such as steps, are left out.
        """
        self._runs = [run.coarse() for run in runs]
        candidates = [c for c in candidates_of(runs)[0] if (c.theta is None or c.by_size) and c.run is None]
        of = {c.name: c.depends_on or c.effect.record.depends_on for c in candidates}
        self._known: dict[tuple[str, int, int | None], Floats] = {}
        self._candidates = sorted((c for c in candidates if of[c.name]), key=lambda c: _VARIABLES.index(of[c.name]))
        self.count = sum(len(c.effect.parameters) for c in self._candidates)
        self.where: Mapping[str, Columns] = {
            variable: np.flatnonzero([of[c.name] == variable for c in self._candidates for _ in c.effect.parameters])
            for variable in dict.fromkeys(of[c.name] for c in self._candidates)
        }

    def columns(self, number: int, gyro: int) -> Floats:
        """Return the columns (b, q) of all candidates for a gyro of run ``number``; they are kept for the next call."""
        columns = [np.empty((len(self._runs[number].t_s), 0))]
        for candidate in self._candidates:
            key = candidate.name, number, None if candidate.alike else gyro
            if key not in self._known:
                self._known[key] = self._runs[number].columns(candidate.effect, gyro) * candidate.effect.largest
            columns.append(self._known[key])
        return np.hstack(columns)


def dependences(
    gram: Floats, rest: int, groups: Mapping[str, Group], count: float, doubt: float
) -> tuple[float, tuple[Dependence, ...]]:
    """Return the share of a whitened residual's power beyond the noise, and what that depends on, by variable.

    ``gram`` holds the products of all columns, of which ``rest`` is the residual with ``count`` degrees of freedom.
    What its squares exceed ``count`` by is taken for noise up to ``doubt``, but dependences that are no chance count
    even within that. ``groups`` holds the columns of each variable. A dependence that may be chance has share 0.
    """
    from scipy.special import fdtrc  # of the F distribution; scipy.stats takes a second to import

    total = float(gram[rest, rest])
    found = []
    for variable, group in groups.items():
        power, rank = _squares_explained(gram, group.columns, group.beside, rest)
        left = max(count - rank, 1.0)
        # So many columns explain so much of noise by chance: the rest is the dependence.
        chance = (rank + group.doubt) * max(total - power, 1e-12 * total) / left
        p_value = float(fdtrc(rank, left, power / chance)) if rank else 1.0
        found.append((variable, power - chance, p_value))
    shown = [beyond for _, beyond, p_value in found if p_value < _BY_CHANCE]
    excess = max([total - count if total - count > doubt else 0.0, *shown])
    return excess / max(total, 1e-300), tuple(
        Dependence(variable, float(np.clip(beyond / excess, 0.0, 1.0)) if p_value < _BY_CHANCE else 0.0, p_value)
        for variable, beyond, p_value in found
    )


def _squares_explained(gram: Floats, columns: Columns, beside: Columns, rest: int) -> tuple[float, int]:
    """Return the squares of the residual that ``columns`` explain after ``beside``, and how many are independent.

    ``gram`` (c, c) holds the products of all columns; column number ``rest`` is the residual. Columns of zeros are left
    out. Return (0.0, 0) if all ``columns`` are zeros.
    """
    size = np.sqrt(np.diag(gram)[columns])
    columns, size = columns[size > 0], size[size > 0]
    if not len(columns):
        return 0.0, 0
    products, right = gram[np.ix_(columns, columns)], gram[columns, rest]
    if len(beside):
        scale = np.sqrt(np.maximum(np.diag(gram)[beside], 1e-300))
        inner = np.linalg.pinv(gram[np.ix_(beside, beside)] / np.outer(scale, scale), 1e-10, hermitian=True)
        across = gram[np.ix_(beside, columns)] / scale[:, None]
        products = products - across.T @ inner @ across
        right = right - across.T @ inner @ (gram[beside, rest] / scale)
    values, vectors = np.linalg.eigh(products / np.outer(size, size))
    kept = values > _INDEPENDENT * len(columns)
    onto = vectors[:, kept].T @ (right / size)
    return float(np.sum(onto**2 / values[kept])), int(kept.sum())
