"""Samples of a run as they fell, and their means over its blocks."""

from dataclasses import dataclass

import numpy as np

from estimator.estimation.runs.run import Run
from estimator.observations.rows import observations
from estimator.types import Floats


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """Samples of one run: instants (n,) and output errors (n, m)."""

    t_s: Floats
    z_rps: Floats
    names: tuple[str, ...]


def samples_of(run: Run) -> Samples:
    """Return the output errors (n, m) in rad/s, with instants, at the samples of a run that its reference covers.

    Of a value that is held over several samples there is one. Empty for turns, and for references without rates.
    """
    t: list[Floats] = [np.empty(0)]
    z = [np.empty((0, len(run.array)))]
    for part in observations(run.recording, run.data):
        if part.t_ns is not None:
            t.append(np.asarray(part.t_ns * 1e-9, dtype=np.float64))
            z.append(part.y_rps - part.w_rps @ run.array.p.T)
    each = slice(None, None, run.held)  # one of each group of held samples suffices
    return Samples(np.concatenate(t)[each], np.vstack(z)[each], run.array.names)


def tone_columns(frequency_hz: float, run: Run, samples: Samples) -> Floats:
    """Return the means over the blocks of a run (b, 2) of a cosine and a sine, over its samples as they fell."""
    phase = 2 * np.pi * frequency_hz * samples.t_s
    return means_of(run, samples.t_s, np.column_stack([np.cos(phase), np.sin(phase)]))[0]


def means_of(run: Run, t_s: Floats, values: Floats) -> tuple[Floats, Floats]:
    """Return the means (b, c) of values (n, c) over the blocks of a run, and the number of values in each (b, 1).

    The mean of a block without values is 0. Values outside all blocks are left out.
    """
    start_s = run.t_s[0] - 0.5 * run.length_s
    number = np.floor((t_s - start_s) / run.length_s + 1e-9).astype(np.intp)
    block = np.round((run.t_s - run.t_s[0]) / run.length_s).astype(np.intp)
    inside, count = (number >= 0) & (number <= block[-1]), block[-1] + 1
    sums = np.column_stack([np.bincount(number[inside], column[inside], count)[block] for column in values.T])
    counts = np.bincount(number[inside], minlength=count)[block, None]
    return np.asarray(sums / np.maximum(counts, 1)), counts.astype(np.float64)
