"""Columns of a vibration, over the samples of a run as they fell."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimator.estimation.runs.run import Run
from estimator.observations.rows import observations
from estimator.recordings.recording import Recording
from estimator.types import Floats


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """Samples of one run: instants (n,) and output errors (n, m)."""

    t_s: Floats
    z_rps: Floats
    names: tuple[str, ...]


def samples_of(run: Run) -> Samples:
    """Return the samples of a run that its reference covers."""
    recording = Recording({"it": run.data}, run.recording.reference, run.recording.site, path=run.recording.path)
    t: list[Floats] = [np.empty(0)]
    z = [np.empty((0, len(run.array)))]
    for part in observations(recording, "it"):
        if part.t_ns is not None:
            t.append(np.asarray(part.t_ns * 1e-9, dtype=np.float64))
            z.append(part.y_rps - part.w_rps @ run.array.p.T)
    each = slice(None, None, run.held)  # of samples that are held, one tells all
    return Samples(np.concatenate(t)[each], np.vstack(z)[each], run.array.names)


def tone_columns(frequency_hz: float, run: Run, samples: Samples) -> Floats:
    """Return the means over the blocks of a run (b, 2) of a cosine and a sine, over its samples as they fell."""
    start_s = run.t_s[0] - 0.5 * run.length_s
    number = np.floor((samples.t_s - start_s) / run.length_s + 1e-9).astype(np.intp)
    block = np.round((run.t_s - run.t_s[0]) / run.length_s).astype(np.intp)
    inside = (number >= 0) & (number <= block[-1])
    counts = np.bincount(number[inside], minlength=block[-1] + 1)
    phase = 2 * np.pi * frequency_hz * samples.t_s[inside]
    sums = [np.bincount(number[inside], f(phase), minlength=block[-1] + 1) for f in (np.cos, np.sin)]
    return np.asarray(np.column_stack(sums)[block] / np.maximum(counts[block], 1)[:, None])
