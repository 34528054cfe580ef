"""Steps of an output that its noise does not average: while the input stays, its mean is then off by part of a step.

The mean of a rounded output deviates from the mean input by a periodic function of it, with a harmonic at each multiple
of 1/step, whose amplitude is step/(pi k) exp(-2 (pi k s/step)^2) for noise of standard deviation s. (B. Widrow,
I. Kollar, Quantization Noise, 2008.) While the input changes by some steps, rounding is noise.
"""

from dataclasses import dataclass

import numpy as np

from estimator.estimation.accelerometers.force_runs import ForceRun
from estimator.types import Floats, least_steps

_HARMONICS = np.arange(1, 31)
_STAYS = 0.1
"""Share of a step by which the input may change while rounding moves the output alike."""
_FEWEST_BLOCKS = 3
_COUNTS = 0.1
"""Share of the variance of a mean, by noise alone, from which rounding counts."""


@dataclass(kw_only=True, frozen=True, slots=True)
class CoarseSteps:
    """An output whose mean rounding moves by ``sd_mps2`` (standard deviation) while its input stays."""

    name: str
    step_mps2: float
    sd_mps2: float


def coarse_steps(run: ForceRun) -> list[CoarseSteps]:
    """Return the outputs of a run in steps that their noise does not average.

    The noise is what is seen while the input stays, less what rounding adds. Left out are outputs whose input never
    stays, that never change, or whose usual change from sample to sample exceeds a step.
    """
    found = []
    for number, name in enumerate(run.array.names):
        known = np.isfinite(run.samples.output_mps2[:, number])
        output, t_s = run.samples.output_mps2[known, number], run.samples.t_ns[known] * 1e-9
        changes = np.abs(np.diff(output))
        (step,) = least_steps(changes[:, None])
        if not np.isfinite(step) or np.median(changes) > step:  # noise of more than a step
            continue
        spans_s = _steady_spans_s(run, run.w_rps @ run.array.p[number], float(step))
        pieces = [output[np.searchsorted(t_s, first) : np.searchsorted(t_s, last)] for first, last in spans_s]
        sd_mps2 = _of_means([piece for piece in pieces if len(piece) > 1], float(step))
        if sd_mps2:
            found.append(CoarseSteps(name=name, step_mps2=float(step), sd_mps2=sd_mps2))
    return found


def _steady_spans_s(run: ForceRun, force_mps2: Floats, step: float) -> list[tuple[float, float]]:
    """Return the spans in s in which the force (b,) along an axis stays within a share of a ``step`` in m/s2.

    The force is compared with that at the beginning of a span. Spans of fewer than ``_FEWEST_BLOCKS`` are left out.
    """
    spans = []
    first = 0
    for block in range(1, len(force_mps2) + 1):
        if block < len(force_mps2) and abs(force_mps2[block] - force_mps2[first]) <= _STAYS * step:
            continue
        if block - first >= _FEWEST_BLOCKS:
            spans.append((float(run.t_s[first] - 0.5 * run.length_s), float(run.t_s[block - 1] + 0.5 * run.length_s)))
        first = block
    return spans


def _of_means(pieces: list[Floats], step: float) -> float:
    """Return the standard deviation in m/s2 by which rounding to ``step`` moves the means of pieces (n,) of an output.

    0 without pieces, or if that is little beside the noise of their means.
    """
    if not pieces:
        return 0.0
    seen = float(np.median([piece.var() for piece in pieces]))
    before = max(seen - step**2 / 12, 0.0)  # what rounding adds to noise that is not much smaller than a step
    harmonics = np.exp(-((2 * np.pi * _HARMONICS) ** 2) * before / step**2) / _HARMONICS**2
    variance = float(step**2 / (2 * np.pi**2) * harmonics.sum())
    of_mean = max(seen, step**2 / 12) / float(np.median([len(piece) for piece in pieces]))
    return float(np.sqrt(variance)) if variance > _COUNTS * of_mean else 0.0
