"""The error before and after, on runs used neither to fit nor to choose.

A run is divided into phases: rests, ramps, steady rates. In each, what is left of a gyro's output error beside a model
is projected on its mean and on the direction in which the two models differ; the rest of it is noise to both. These
projections say how wrong the compensated rate is in that phase, and whether its interval holds. Coverage is over the
phases in which the two models differ by more than an interval's standard deviation, over all if they are the same.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from estimator.estimation.runs.run import Run, with_gyro
from estimator.estimation.spectra import Stretch
from estimator.geometry.model import decode
from estimator.tracing.augmented import Augmented
from estimator.tracing.investigation import Errors, GyroErrors, Improvement, PhaseErrors, ResidualView
from estimator.tracing.judging.shared_errors import NOTHING_SHARED, Sharing
from estimator.tracing.residuals.origin import shape_of
from estimator.types import Floats

_PIECE_S, _FEWEST_IN_PIECE = 5.0, 5  # without a table: phases of this length, and no fewer blocks than these
_RAMP_SHARE = 0.02  # of the steepest acceleration of a run: the least of a ramp
_FEWEST = 2
DRAWS = 400
"""Draws of what may be true."""
_ROUNDING = 1e-9  # of a correlation: elements that are known only together must not make the factor fail
_MISFIT_DOF = 50.0  # of the misfit: coherent with the motion, so far fewer than blocks
_APART = 1.0  # sigmas of an interval by which models must differ to be compared
_FEWEST_JUDGED = 20
Misfit = Mapping[tuple[str, int], float]
"""By gyro and number of a run, what no model fits beyond the noise, summed over blocks, (rad/s)^2."""
_DIRECTION = 1e-3  # share of a direction that must remain beside the mean to count as another


@dataclass(frozen=True, slots=True)
class Phase:
    """Blocks of a run that belong to one ``kind``: rest, ramp, steady rate, or a piece of free motion."""

    blocks: slice
    kind: str


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class Judged:
    """Errors over all gyros and by gyro, the improvement, the data for pictures.

    ``surprise``: what the last model leaves, in sigmas of chance. ``understated``: probability that its error is more
    than twice what its own covariance says. ``formless``: probability that it is more than half as much again as with
    laws of known form. Both are 0 without runs held back, and ``formless`` without such laws.
    ``sharing``: what the gyros have in common in what it leaves of all runs.
    """

    before: Errors
    after: Errors
    improvement: Improvement | None
    gyros: tuple[GyroErrors, ...]
    views: tuple[ResidualView, ...]
    surprise: float
    understated: float = 0.0
    formless: float = 0.0
    sharing: Sharing = NOTHING_SHARED


@dataclass(frozen=True, slots=True, eq=False)
class _Phase:
    """One phase of a gyro before and after: ``largest`` error over its blocks.

    ``inside``, ``apart`` and ``chi`` belong to the direction in which the two models differ.
    """

    errors: PhaseErrors
    inside: tuple[bool, ...]
    largest: tuple[float, ...]
    apart: float
    chi: float


def phases_of(run: Run) -> list[Phase]:
    """Return the phases of a run in order; those that are too short are left out.

    On a table they are of kind "rest", "ramp" and "steady"; of turns each is one ("rest" or "steady"); else they are
    each a "piece" of equal length, across gaps. Those on a table and pieces have at least five blocks, ramps one.
    """
    grid = run.grid
    if run.stated_rps:  # each turn is one
        kinds = np.where(np.abs(run.w_rps).max(axis=1) > 0, "steady", "rest").tolist()
        return [Phase(slice(n, n + 1), kind) for n, kind in enumerate(kinds)]
    if grid.gimbals:
        steep = np.abs(run.fold(np.abs(grid.acceleration_rps2))).max(axis=1)
        top = np.abs(run.fold(np.abs(grid.rate_rps))).max(axis=1)
        ramp = steep > _RAMP_SHARE * max(float(steep.max()), 1e-9)
        ramp &= steep > 1e-4
        turning = top > 0.01 * max(float(top.max()), 1e-9)
        rates = np.round(run.fold(grid.rate_rps) / max(0.02 * float(top.max()), 1e-9))
        kind = np.where(ramp, 1, np.where(turning, 2, 0))
        key = np.column_stack([kind, np.where((kind == 2)[:, None], rates, 0), run.stretch])
        edges = np.flatnonzero(np.any(np.diff(key, axis=0) != 0, axis=1)) + 1
    else:
        count = max(round(_PIECE_S / run.length_s), _FEWEST_IN_PIECE)
        edges = np.arange(count, len(run.t_s), count)
        kind = np.full(len(run.t_s), 3)
    bounds = [0, *edges.tolist(), len(run.t_s)]
    names = ("rest", "ramp", "steady", "piece")
    found = [Phase(slice(a, b), names[int(kind[a])]) for a, b in pairwise(bounds) if b > a]
    least = {"rest": 5, "steady": 5, "piece": 5, "ramp": 1}
    return [p for p in found if p.blocks.stop - p.blocks.start >= least[p.kind]]


@dataclass(frozen=True, slots=True, eq=False)
class Drawn:
    """Sums over ``blocks`` of squared errors of one gyro before and after (m,), for m draws of what may be true."""

    before: Floats
    after: Floats
    blocks: float

    def __add__(self, other: "Drawn") -> "Drawn":
        return Drawn(self.before + other.before, self.after + other.after, self.blocks + other.blocks)

    def chosen(self, numbers: NDArray[np.intp]) -> "Drawn":
        """Return the draws of these numbers."""
        return replace(self, before=self.before[numbers], after=self.after[numbers])

    def more_by(self, squares: Floats) -> "Drawn":
        """Return the same with more squares (m,) in both models."""
        return replace(self, before=self.before + squares, after=self.after + squares)

    @property
    def rms_rps(self) -> tuple[float, float]:
        """Before and after, the mean over the draws."""
        n = max(self.blocks, 1.0)
        return float(np.sqrt(self.before.mean() / n)), float(np.sqrt(self.after.mean() / n))

    @property
    def improvement(self) -> Improvement:
        """Before over after, and its 95 % interval."""
        before, after = self.rms_rps
        ratios = np.sqrt(self.before / np.maximum(self.after, 1e-300))
        low, high = np.quantile(ratios, [0.025, 0.975])
        return Improvement(before / max(after, 1e-150), float(low), float(high))


def drawn(
    runs: Sequence[Run], first: int, before: Augmented, after: Augmented, true: Augmented, misfit: Misfit
) -> dict[str, Drawn]:
    """Return by gyro draws of the squared errors of two models over all of runs, without noise.

    ``true`` is the posterior of all recordings, from which the draws are. ``misfit``, by gyro and run, adds the same
    error to both models; its share that is error and not noise is drawn, the same for all gyros. ``first`` is the
    number of the first run.
    """
    sums: dict[str, Drawn] = {}
    shares = np.random.default_rng(1).beta(0.5, 0.5, DRAWS)  # nearly none, or nearly all, is as likely as half
    for name in after.names:
        g = after.names.index(name)
        random = np.random.default_rng(g)  # the same figures for the same recordings
        draws = _draws(random, true.mean[g], true.covariance[g])
        old = np.zeros(draws.shape[1])
        old[: before.mean.shape[1]] = before.mean[g]
        for number, run, i in with_gyro(runs, name):
            columns = after.columns(run, first + number, i)[run.weight > 0]
            gram = columns.T @ columns
            squares = [np.einsum("mi,ij,mj->m", draws - x, gram, draws - x) for x in (old, after.mean[g])]
            left = misfit.get((name, first + number), 0.0)
            chance = shares * random.chisquare(_MISFIT_DOF, DRAWS) / _MISFIT_DOF
            own = Drawn(squares[0] + left * chance, squares[1] + left * chance, float(len(columns)))
            sums[name] = sums[name] + own if name in sums else own
    return sums


def _draws(random: np.random.Generator, mean: Floats, covariance: Floats) -> Floats:
    """Return draws (m, c) of a normal distribution; elements of it may be known exactly.

    The correlations are factored by Cholesky: the steps are fixed in number, and units do not matter.
    """
    sd = np.sqrt(np.diag(covariance))
    scale = np.where(sd > 0, sd, 1.0)
    correlation = covariance / np.outer(scale, scale)
    correlation[np.diag_indices_from(correlation)] = 1 + _ROUNDING
    factor = np.linalg.cholesky(correlation)
    return np.asarray(mean + random.standard_normal((DRAWS, len(mean))) @ factor.T * sd)


def judge(
    runs: Sequence[Run], first: int, before: Augmented, after: Augmented, held_back: bool, errors: Mapping[str, Drawn]
) -> Judged:
    """Return the errors of two models on runs, of which the first has number ``first`` among all.

    ``errors`` are the drawn errors of the whole runs by gyro; ``held_back`` is noted. There is a view for each run and
    gyro. Gyros that the model does not have are left out, in ``gyros`` also those without phases; without effects the
    improvement is None.
    """
    found: dict[str, list[_Phase]] = {name: [] for name in after.names}
    views = []
    for number, run in enumerate(runs, first):
        parts, temperature = phases_of(run), run.grid.temperature_c
        warm = None if temperature is None else run.fold(temperature)[:, 0]
        for i, name in enumerate(run.array.names):
            if name not in after.names:
                continue
            said = [model.predict(run, number, i) for model in (before, after)]
            rests = run.z_rps[:, i] - said[0][0], run.z_rps[:, i] - said[1][0]
            found[name] += _phases(run, i, parts, (before, after), rests, [columns for _, columns in said])
            sigma = float(after.arw[after.names.index(name)]) / np.sqrt(run.length_s)
            views.append(
                ResidualView(
                    run=run.name,
                    gyro=name,
                    verification=held_back,
                    t_s=run.t_s,
                    rate_rps=run.w_rps @ run.array.p[i],
                    temperature_c=warm,
                    before_rps=rests[0],
                    after_rps=rests[1],
                    noise_rps=sigma,
                )
            )
    everything = [phase for phases in found.values() for phase in phases]
    gyros = tuple(_gyro(name, before, after, phases, errors[name]) for name, phases in found.items() if phases)
    dof = len(everything)
    surprise = (sum(phase.chi for phase in everything) - dof) / np.sqrt(2 * max(dof, 1))
    whole = sum_of(errors.values())
    return Judged(
        before=_errors(everything, 0, whole),
        after=_errors(everything, 1, whole),
        improvement=whole.improvement if after.parts else None,
        gyros=gyros,
        views=tuple(views),
        surprise=float(surprise),
    )


def _phases(
    run: Run,
    i: int,
    phases: Sequence[Phase],
    models: Sequence[Augmented],
    rests: Sequence[Floats],
    columns: Sequence[Floats],
) -> Iterator[_Phase]:
    """Yield how gyro number ``i`` errs under two models in each phase with whole blocks, and what their sigmas cover.

    ``rests`` (b,) are by model the outputs less all of it, ``columns`` (b, k) those of its states and parts.
    """
    after = models[-1]
    g = after.names.index(run.array.names[i])
    sigma = float(after.arw[g]) / np.sqrt(run.length_s)
    for phase in phases:
        keep = np.flatnonzero(run.weight[phase.blocks] > 0) + phase.blocks.start
        if not len(keep):
            continue
        basis = _basis(rests[0][keep] - rests[1][keep], sigma)
        noise = _noise(after, basis, run, len(keep), sigma)
        scores = [basis.T @ rest[keep] for rest in rests]
        # The last direction is that in which the models differ, or the mean if they do not.
        seen = [basis[:, -1] @ its[keep] for its in columns]
        doubts = [one @ model.covariance[g] @ one for one, model in zip(seen, models, strict=True)]
        variances = [float(noise[-1] + doubt) for doubt in doubts]
        u = run.w_rps[keep] @ run.array.p[i]
        yield _Phase(
            PhaseErrors(
                run=run.name,
                start_s=float(run.t_s[keep[0]] - 0.5 * run.length_s),
                end_s=float(run.t_s[keep[-1]] + 0.5 * run.length_s),
                rate_dps=float(np.degrees(u.mean())),
                kind=phase.kind,
                before_rps=float(rests[0][keep].mean()),
                after_rps=float(rests[1][keep].mean()),
                noise_rps=float(np.sqrt(noise[0] / len(keep))),
            ),
            tuple(bool(abs(s[-1]) < 1.96 * np.sqrt(v)) for s, v in zip(scores, variances, strict=True)),
            tuple(float(np.abs(basis @ s).max()) for s in scores),
            float(abs(scores[0][-1] - scores[1][-1]) / np.sqrt(variances[1])),
            float(scores[1][-1] ** 2 / variances[1]),
        )


def _basis(difference: Floats, sigma: float) -> Floats:
    """Return orthonormal directions (b, 1 or 2): the mean, and the shape in which two models differ, if any.

    The last column is the direction that tells the models apart: the mean if their difference (b,) is nearly constant.
    There is only the mean for fewer than three blocks, or a shape that is small beside the noise ``sigma`` of a block.
    """
    n = len(difference)
    mean = np.full((n, 1), 1 / np.sqrt(n))
    other = difference - difference.mean()
    size = float(np.linalg.norm(other))
    if n < _FEWEST + 1 or size < _DIRECTION * sigma:
        return mean
    # Where the difference is nearly constant its mean distinguishes the models; where it changes sign, its shape.
    if abs(float(difference.mean())) * np.sqrt(n) > size:
        return np.column_stack([other / size, mean])
    return np.column_stack([mean, other / size])


def _noise(model: Augmented, basis: Floats, run: Run, blocks: int, sigma: float) -> Floats:
    """Return the variance of each projection: white noise, and the wander of the bias since it was known."""
    span_s = float(run.t_s[-1] - run.t_s[0]) + run.length_s
    mean = shape_of(model, Stretch.of(0, slice(0, blocks), run.length_s, True), span_s)[0]
    return np.asarray(sigma**2 * (1 + (mean - 1) * basis.sum(axis=0) ** 2 / blocks))


def sum_of(errors: Iterable[Drawn]) -> Drawn:
    """Return the errors of all gyros together."""
    return sum(errors, Drawn(np.zeros(DRAWS), np.zeros(DRAWS), 0.0))


def _errors(phases: Sequence[_Phase], which: int, whole: Drawn) -> Errors:
    """Return the errors of model ``which`` (0 before, 1 after) over phases; all NaN without phases.

    The rms is that of the draws ``whole``, the largest error that of a block of a phase. The share of intervals counts
    the phases in which the models differ most, at least ``_FEWEST_JUDGED``, and all if they differ in none.
    """
    if not phases:
        return Errors(float("nan"), float("nan"), float("nan"))
    # Where the models agree their intervals hold or fail together; they are judged where they differ.
    told = sorted(phases, key=lambda p: -p.apart)
    count = max(sum(p.apart > _APART for p in told), min(_FEWEST_JUDGED, len(told)))
    inside = [p.inside[which] for p in (told[:count] if told[0].apart > 0 else told)]
    return Errors(whole.rms_rps[which], max(p.largest[which] for p in phases), float(np.mean(inside)))


def _gyro(name: str, before: Augmented, after: Augmented, phases: Sequence[_Phase], errors: Drawn) -> GyroErrors:
    """Return the errors of a gyro in all and by phase, and its decoded states with sigmas, before and after, and by how
    many of the former sigmas they moved.
    """
    g = after.names.index(name)
    (old, old_covariance), (new, covariance) = (decode(m.mean[g, :4], m.covariance[g, :4, :4]) for m in (before, after))
    moved = (new - old) / np.sqrt(np.diag(old_covariance))
    return GyroErrors(
        name=name,
        before=_errors(phases, 0, errors),
        after=_errors(phases, 1, errors),
        phases=tuple(phase.errors for phase in phases),
        states_before=old,
        states_after=new,
        moved=np.asarray(moved),
        sd_before=np.sqrt(np.diag(old_covariance)),
        sd_after=np.sqrt(np.diag(covariance)),
    )
