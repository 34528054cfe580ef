"""The origin of a residual: redundant gyros tell an error of the body rate, common to all, from their own errors.

An error dw of the body rate (the table, the site, the clock) shows in n gyros with sense axes P as P dw. What lies
outside the column space of P can only be the gyros' own. Errors of their own fall into both parts, as noise does: in
the mean a share of rank(P) / n of them looks common. One slow error of its own in each of n = rank(P) + 1 gyros may by
chance look common to all but a little.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from estimator.estimation.runs.run import Run
from estimator.estimation.spectra import NoiseShapes, Stretch, cosines
from estimator.geometry.model import decode
from estimator.packaged import sentence
from estimator.tracing.augmented import Augmented
from estimator.types import Floats

WHITE_DOUBT = 2.33
"""Over the root of half the coefficients: doubt of a white noise's variance that their median gave."""
_SEEN = 0.05  # a direction that gyros see by less than this share of another is not common to them
_BANDS = (1, 4, 16, 64)  # all frequencies, and these fractions of them: slow errors stand out among the slow
_BEYOND = 5.0  # sigmas
_LEAST_OWN = 0.01  # share of the power that misalignment of the axes leaves outside of the common part at most
_FEWEST_BLOCKS = 10
_FEWEST_IN_BAND = 40
_GAP_S = 5.0


class Origin(StrEnum):
    """Where a residual comes from: errors that gyros have in common, errors of their own, or noise only."""

    NOISE = "within noise"
    COMMON = "common to all gyros"
    OWN = "own to each"


@dataclass(frozen=True, slots=True)
class Split:
    """A residual, split into the part that gyros have in common and their own part.

    ``common`` and ``own`` are power beyond the noise, summed over gyros, over the noise of one; 0.1 a gyro is chance.
    ``own_share`` is the gyros' own share of it, corrected for own power that looks common; None within the noise.
    ``spare`` is the number of gyros beyond the axes that they span.
    """

    origin: Origin
    common: float
    own: float
    own_share: float | None
    spare: int


def shape_of(model: Augmented, stretch: Stretch, span_s: float = 0.0) -> Floats:
    """Return the variance (b,) of a model's noise by frequency, over its white noise, the bias over ``span_s``."""
    shapes = NoiseShapes(np.array([model.instability]), np.array([model.walk]), np.zeros(1), np.zeros(1), span_s)
    return np.asarray(shapes.density(stretch)[0][stretch.band])


def split_of(runs: Sequence[Run], rests: Sequence[Floats], model: Augmented) -> tuple[Split | None, str]:
    """Return the split of the residuals of all runs into a part common to the gyros and their own, or None and the
    reason.

    ``rests`` are the residuals (b, m) of each run under ``model``. None for no more gyros than their axes need, or
    gyros that rarely measure at the same time. The reason is "" for a split.
    """
    names = [name for name in model.names if any(name in run.array.names for run in runs)]
    arw = np.array([model.arw[model.names.index(name)] for name in names])
    left, singular, _ = np.linalg.svd(_sense_axes(runs, model, names) / arw[:, None])
    count = len(names)
    rank = int((singular > _SEEN * singular[0]).sum())
    if count <= rank:
        axes = "one axis" if rank == 1 else f"{rank} axes"
        return None, sentence("tracing.too_few_gyros", gyros=count, plural="s" * (count > 1), axes=axes)
    sums = np.zeros((len(_BANDS), 3))
    for stretch, rest in common_stretches(runs, rests, names):
        white = cosines(rest / arw) * np.sqrt(stretch.length_s / shape_of(model, stretch))[:, None]
        squares = np.column_stack([(white @ left) ** 2, np.ones(len(white))])
        squares = np.add.reduceat(squares, [0, rank, count], axis=1)
        squares[0] = 0.0  # the mean, which holds the bias since power-on
        sums += [squares[: max(len(squares) // band, 1)].sum(axis=0) for band in _BANDS]
    blocks = sums[0, 2]
    sums = sums[sums[:, 2] >= _FEWEST_IN_BAND]
    if not len(sums):
        return None, "the gyros rarely measure at the same time"
    return _split_from(sums[:, :2], sums[:, 2:], np.array([rank, count - rank]), blocks), ""


def _split_from(squares: Floats, blocks: Floats, parts: NDArray[np.intp], all_blocks: float) -> Split:
    """Return the split for squares (bands, 2) of the common and the own part.

    ``blocks`` (bands, 1) are the coefficients in each band, ``parts`` the numbers of dimensions of both, ``all_blocks``
    the coefficients of all frequencies. The band that is most beyond the noise decides; if none is clearly beyond it,
    the origin is noise and there is no share.
    """
    count = int(parts.sum())
    beyond = squares - blocks * parts
    white = WHITE_DOUBT**2 / (0.5 * all_blocks * count)
    sigmas = beyond / (blocks * parts * np.sqrt(2 / (parts * blocks) + white))
    band = int(np.argmax(sigmas.max(axis=1)))
    common, own = (float(max(b, 0.0) / all_blocks) for b in beyond[band])
    if sigmas[band].max() < _BEYOND:
        return Split(Origin.NOISE, common, own, None, int(parts[1]))
    share = float(min(own * count / parts[1] / (common + own), 1.0))
    alone = sigmas[band, 1] > _BEYOND and share > _LEAST_OWN
    return Split(Origin.OWN if alone else Origin.COMMON, common, own, share, int(parts[1]))


def _sense_axes(runs: Sequence[Run], model: Augmented, names: Sequence[str]) -> Floats:
    """Return the calibrated sense axes (n, 3) of the gyros ``names``, with their scale factors, by the states of a
    model.
    """
    axes = {}
    for run in runs:
        for i, name in enumerate(run.array.names):
            g = model.names.index(name)
            k, _, sigma_j, sigma_k = decode(model.mean[g, :4], model.covariance[g, :4, :4])[0]
            axes[name] = (1 - k) * (run.array.p[i] - sigma_k * run.array.j[i] + sigma_j * run.array.k[i])
    return np.array([axes[name] for name in names])


def common_stretches(
    runs: Sequence[Run], rests: Sequence[Floats], names: Sequence[str]
) -> list[tuple[Stretch, Floats]]:
    """Return the stretches of recordings in which all gyros measure, with their residuals (b, n) in rad/s.

    ``rests`` are the residuals (b, m) of each run, ``names`` the n gyros. A block in which any gyro is missing is 0 for
    all; a stretch ends at a gap of more than ``_GAP_S``. Recordings whose sources have blocks of different length are
    left out, and so are short stretches.
    """
    found = []
    for order in dict.fromkeys(run.order for run in runs):
        mine = [(run, rest) for run, rest in zip(runs, rests, strict=True) if run.order == order]
        length_s, start_s = mine[0][0].length_s, min(float(run.t_s[0]) for run, _ in mine)
        if any(run.length_s != length_s for run, _ in mine):
            continue
        numbers = [np.round((run.t_s - start_s) / length_s).astype(np.intp) for run, _ in mine]
        whole = np.full((max(int(number[-1]) for number in numbers) + 1, len(names)), np.nan)
        for (run, rest), number in zip(mine, numbers, strict=True):
            good = run.weight > 0
            columns = np.array([names.index(name) for name in run.array.names], dtype=np.intp)
            whole[np.ix_(number[good], columns)] = rest[good]
        complete = np.isfinite(whole).all(axis=1)
        there = np.flatnonzero(complete)
        for part in np.split(there, np.flatnonzero(np.diff(there) * length_s > _GAP_S) + 1):
            if len(part) >= _FEWEST_BLOCKS:
                blocks = slice(int(part[0]), int(part[-1]) + 1)
                values = np.where(complete[blocks, None], whole[blocks], 0.0)
                found.append((Stretch.of(order, blocks, length_s, True), values))
    return found
