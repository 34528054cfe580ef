"""Columns of many candidates that are scanned again and again, each time beside another model.

Within a band of frequencies the noise is the same, so the products of a candidate's columns with one another, summed by
band once, serve every model and every noise. Only the products with the columns of the model are new each time.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby, pairwise
from typing import Self

import numpy as np
from numpy.typing import NDArray

from estimator.estimation.evidence import Evidence
from estimator.estimation.runs.run import with_gyro
from estimator.tracing.candidates import Candidate
from estimator.tracing.run_columns import RunColumns, of_gyro
from estimator.types import Floats

Places = tuple[tuple[int, int], ...]
"""By run with a gyro: the run's number, and the number of its columns there."""


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class Stack:
    """The columns of k candidates with p parameters each, for the ``gyros`` that have these columns.

    ``numbers`` (k,) are the places of the candidates among all. ``columns`` (k, p, rows) are in rad/s at the largest
    sizes, the rows being the frequencies of one stretch after another. ``products`` (k, p, p, bands) are their products
    by band, ``first_rows`` (bands,) the first row of each band.
    """

    gyros: tuple[int, ...]
    numbers: NDArray[np.intp]
    columns: Floats
    products: Floats
    first_rows: NDArray[np.intp]

    def only(self, number: int) -> Self:
        """Return the stack of the one candidate with this place among all."""
        its = self.numbers == number
        return replace(self, numbers=self.numbers[its], columns=self.columns[its], products=self.products[its])


def stacks_of(columns: Sequence[RunColumns], evidence: Evidence, candidates: Sequence[Candidate]) -> list[Stack]:
    """Return the columns of candidates on some runs, those with the same number of parameters in one stack.

    Candidates whose columns are the same for all gyros have one stack for all gyros that are in the same runs, others
    have one for each gyro.
    """
    order = sorted(range(len(candidates)), key=lambda n: _form(candidates[n]))
    return [
        stack
        for _, group in groupby(order, key=lambda n: _form(candidates[n]))
        for stack in _stacks_of_form(columns, evidence, candidates, np.array(list(group), dtype=np.intp))
    ]


def _form(candidate: Candidate) -> tuple[int, bool]:
    """Return the key of candidates whose columns fit in one stack."""
    return len(candidate.effect.parameters), candidate.alike


def _stacks_of_form(
    columns: Sequence[RunColumns], evidence: Evidence, candidates: Sequence[Candidate], numbers: NDArray[np.intp]
) -> list[Stack]:
    """Return the stacks of the candidates with these numbers, at least one, which are all of one form (``_form``).

    ``columns`` has one entry for each run. Gyros share a stack if they are in the same runs and have the same columns
    there; so each distinct set of ``Places`` gives one stack, which holds all the candidates.
    """
    of_runs = [[one.of(candidates[number]) for number in numbers.tolist()] for one in columns]
    gyros_at: dict[Places, list[int]] = {}
    for number, gyro in enumerate(evidence.gyros):
        places = tuple((run, own) for run, _, own in with_gyro([one.run for one in columns], gyro.name))
        if all(len(one) == 1 for run, _ in places for one in of_runs[run]):
            places = tuple((run, 0) for run, _ in places)
        gyros_at.setdefault(places, []).append(number)
    found = []
    for places, gyros in gyros_at.items():
        whole = np.concatenate([np.array([of_gyro(one, own) for one in of_runs[run]]) for run, own in places], axis=-1)
        bands = np.concatenate([np.diff(s.band, prepend=-1) > 0 for s in evidence.gyros[gyros[0]].stretches])
        first_rows = np.flatnonzero(bands)
        found.append(
            Stack(
                gyros=tuple(gyros),
                numbers=numbers,
                columns=whole,
                products=_products_by_band(whole, first_rows),
                first_rows=first_rows,
            )
        )
    return found


def _products_by_band(columns: Floats, first_rows: NDArray[np.intp]) -> Floats:
    """Return the products (k, p, p, bands) of columns (k, p, rows) of the same candidate, summed within each band."""
    edges = [*first_rows.tolist(), columns.shape[-1]]
    parts = [columns[..., first:last] for first, last in pairwise(edges)]
    return np.stack([part @ part.swapaxes(1, 2) for part in parts], axis=-1)
