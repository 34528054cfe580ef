"""Columns of candidates on a run in the cosine domain, kept for the next scan or search that needs them."""

from functools import cached_property

import numpy as np

from estimator.effects.effect import Record
from estimator.estimation.runs.run import Run
from estimator.estimation.spectra import cosines, stretches_used
from estimator.tracing.candidates import Candidate
from estimator.types import Floats


class RunColumns:
    """Columns of candidates on one run in the cosine domain, not yet divided by the noise."""

    def __init__(self, run: Run) -> None:
        """Begin without columns."""
        self.run = run
        self._stretches = stretches_used(run)
        self._kept: dict[tuple[str, float | None, Record, tuple[float, ...]], Floats] = {}

    @cached_property
    def coarse(self) -> "RunColumns":
        """The same with a few instants in each block, which do where many functions are tried."""
        return RunColumns(self.run.coarse())

    def of(self, candidate: Candidate, *, keep: bool = False) -> Floats:
        """Return a candidate's columns (gyros, p, rows) in rad/s, each at the largest size of its parameter; (1, p,
        rows) if all gyros have the same.

        The rows are the real coefficients of the cosine transform of one stretch after another, weighted by block but
        not divided by the noise. ``keep`` keeps the columns for later calls with the same candidate; those of a step in
        another recording are kept always, and those of a candidate with directions of its own (``sensed``) never.
        """
        elsewhere = candidate.run not in (None, self.run.order)  # whenever a step is, before and after it is constant
        key = candidate.name, None if elsewhere else candidate.theta, candidate.effect.record, candidate.along
        columns = self._kept.get(key)
        if columns is None:
            columns = self._worked_out(candidate)
        if (keep or elsewhere) and not candidate.sensed:  # each search estimates the sensed axes anew
            self._kept[key] = columns
        return columns * candidate.effect.largest[:, None]

    def _worked_out(self, candidate: Candidate) -> Floats:
        """Return a candidate's columns (gyros, p, rows) per unit of its p parameters, as weighted cosine coefficients.

        (1, p, rows) if they are alike for all gyros, which is not so where Earth rate is in them.
        """
        run = self.run
        alike = candidate.alike and run.earth_rps is None
        gyros = range(1 if alike else len(run.array))
        with run.grid.sharing_memories():
            columns = np.array([run.weighed(candidate.regressors(run, gyro), gyro).T for gyro in gyros])
        turned = [cosines(columns[..., blocks], axis=-1) for blocks in self._stretches]
        return turned[0] if len(turned) == 1 else np.concatenate([columns[..., :0], *turned], axis=-1)


def of_gyro(columns: Floats, gyro: int) -> Floats:
    """Return the columns (p, rows) of a gyro from (gyros, p, rows), or from (1, p, rows) if all have the same."""
    return np.asarray(columns[gyro if len(columns) > 1 else 0])
