"""How far the numbers of an effect that were tuned may be off: constants, and the shape of a law.

The model is linear in the sizes of effects only. A time constant or a shape enters it by the change of its columns, as
a number that all gyros share: where it is not well known, so is what the effect predicts, and what stands beside it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from estimator.effects.effect import Parameter
from estimator.estimation.runs.run import Run
from estimator.tracing.augmented import Part
from estimator.tracing.candidates import Candidate
from estimator.tracing.laws.common_shape import others
from estimator.tracing.scan import at
from estimator.tracing.search import Search
from estimator.types import Floats

_STEP = 0.02  # share of a constant over which the change of the columns is taken


def with_spreads(search: Search, parts: Sequence[Part]) -> list[Part]:
    """Return effects with the spread of their tuned numbers, as a part of its own beside each.

    Effects without such numbers, delays, steps and tones have none: sizes are in the model, an instant changes next to
    nothing.
    """
    sizes = search.evidence.posterior([part.term for part in parts if part.tone is None])
    found = []
    for part in parts:
        if part.tone is None:
            columns = _Columns.of(search, part.candidate, sizes.of(part.term))
            if columns.count:
                part = replace(part, spread=_spread(search, part, columns))
        found.append(part)
    return found


@dataclass(frozen=True, slots=True, eq=False)
class _Columns:
    """Columns of the tuned numbers of an effect, of which the gyros ``names`` have the ``sizes`` (gyros, p).

    ``constant`` is the effect if it has a constant, ``pieces`` the law of which it is a shape; each may be None.
    """

    names: tuple[str, ...]
    sizes: Floats
    constant: Candidate | None
    pieces: Candidate | None
    across: Floats

    @classmethod
    def of(cls, search: Search, candidate: Candidate, sizes: Floats) -> "_Columns":
        """Return the columns of an effect."""
        tuned = candidate.theta is not None and candidate.of is not None
        constant = candidate if tuned and not candidate.by_size and candidate.run is None else None
        across = others(np.array(candidate.along)) if candidate.along else np.empty((0, 0))
        names = tuple(gyro.name for gyro in search.evidence.gyros)
        pieces = candidate.pieces
        if pieces is not None and pieces.of is not None and candidate.theta is not None:
            pieces = at(pieces, candidate.theta)
        return cls(names, sizes, constant, pieces, across)

    @property
    def count(self) -> int:
        """How many numbers were tuned."""
        return int(self.constant is not None) + len(self.across.T)

    def __call__(self, run: Run, gyro: int) -> Floats:
        """Return the columns (b, count) of a gyro of a run: of the share of the constant, and of the shape."""
        sizes = self.sizes[self.names.index(run.array.names[gyro])]
        columns = [np.empty((len(run.t_s), 0))]
        if self.constant is not None:
            theta = self.constant.theta
            assert theta is not None
            up, down = (at(self.constant, theta * (1 + step)).columns(run, gyro) for step in (_STEP, -_STEP))
            columns.append((up - down) @ sizes[:, None] / (2 * _STEP))
        if self.pieces is not None:
            columns.append(sizes[0] * self.pieces.columns(run, gyro) @ self.across)
        return np.hstack(columns)


def _spread(search: Search, part: Part, columns: _Columns) -> Part:
    parameters = tuple(Parameter(f"spread {n}", "1", 1.0) for n in range(columns.count))
    effect = replace(part.candidate.effect, parameters=parameters)
    candidate = Candidate(f"spread of {part.candidate.name}", effect, by_gyro=columns)
    return Part(candidate, search.spread_term(candidate, part.term))
