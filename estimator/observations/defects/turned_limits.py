"""Limits of outputs beside turns of known angle: turns in which an output stays at its largest come out too small."""

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from estimator.geometry.noise import SD_OF_MEDIAN
from estimator.observations.defects.limits import Limit
from estimator.recordings.recording import ImuData
from estimator.recordings.reference import Turns
from estimator.types import Floats

_SENSED = 0.5  # part of a turn that a gyro must sense
_BAND = 0.02  # of the largest output: how far outputs at a limit vary
_STAYED_S, _FEWEST = 0.05, 5  # for how long an output must stay there, and for how many samples
_LESS, _SIGMAS = 0.02, 5.0  # share, and standard deviations, by which such turns must be too small
_FEWEST_TURNS = 2


def limits_by_turns(data: ImuData, turns: Turns) -> list[list[Limit]]:
    """Return by gyro the limits of its outputs, found by comparing turns that stay at the highest values with others.

    Turns of which a gyro senses less than half do not count. Its output at rest is the median in the rests among the
    turns, else between turns, else of all.
    """
    spans = np.column_stack(
        [np.searchsorted(data.t_ns, turns.t_start_ns), np.searchsorted(data.t_ns, turns.t_end_ns, side="right")]
    )
    still = np.linalg.norm(turns.turn_rad, axis=1) == 0
    found: list[list[Limit]] = []
    for i, p in enumerate(data.array.p):
        output = data.rate_rps[:, i]
        rests = [output[a:b] for a, b in spans[still].tolist()]
        level = float(np.nanmedian(np.concatenate(rests))) if rests else _at_rest(output, spans)
        about = turns.turn_rad @ p
        sensed = np.abs(about) > _SENSED * np.linalg.norm(turns.turn_rad, axis=1)
        found.append(_of_gyro(data, output - level, level, spans[sensed & ~still], about[sensed & ~still]))
    return found


def _at_rest(output: Floats, spans: NDArray[np.intp]) -> float:
    """Return the output between turns, or of all where there is nothing between."""
    between = [output[int(b) : int(a)] for (_, b), (a, _) in pairwise(spans.tolist())]
    known = np.concatenate([np.empty(0), *between])
    return float(np.nanmedian(known if np.isfinite(known).any() else output))


def _of_gyro(data: ImuData, output: Floats, level: float, spans: NDArray[np.intp], about: Floats) -> list[Limit]:
    """Return the limits of one gyro, the upper one first; empty if there are too few turns of either kind.

    ``output`` (n,) is relative to ``level``, its value at rest. ``spans`` (t, 2) are the first row and one past the
    last of its turns, ``about`` (t,) the angles about its sense axis in rad.
    """
    period_s = float(np.median(np.diff(data.t_ns))) * 1e-9
    least = max(round(_STAYED_S / period_s), _FEWEST)
    parts = [output[int(a) : int(b)] for a, b in spans.tolist()]
    if len(parts) < 2 * _FEWEST_TURNS:
        return []
    share = np.array([_turned(data, part, int(a)) for part, (a, _) in zip(parts, spans.tolist(), strict=True)]) / about
    stays = np.zeros((len(parts), 2), dtype=np.bool_)
    tops = []
    for column, side in enumerate((1.0, -1.0)):
        top = max(float(np.nanmax(side * part, initial=0.0)) for part in parts)
        tops.append(top)
        stays[:, column] = [np.count_nonzero(side * part > (1 - _BAND) * top) >= least for part in parts]
    free = share[~stays.any(axis=1)]
    found = []
    for column, side in enumerate((1.0, -1.0)):
        own = share[stays[:, column]]
        if not len(own) or len(free) < _FEWEST_TURNS:
            continue
        scatter = max(SD_OF_MEDIAN * float(np.median(np.abs(free - np.median(free)))), 1e-6)
        less = float(np.median(free) - np.median(own))
        if less > max(_LESS, _SIGMAS * scatter * (1 / len(free) + 1 / len(own)) ** 0.5):
            width = _BAND * tops[column]
            found.append(Limit(level + side * (tops[column] - width / 2), side, width))
    return found


def _turned(data: ImuData, part: Floats, first: int) -> float:
    t_s = data.t_ns[first : first + len(part)] * 1e-9
    known = np.isfinite(part)
    return float(np.trapezoid(part[known], t_s[known])) if known.sum() > 1 else np.nan
