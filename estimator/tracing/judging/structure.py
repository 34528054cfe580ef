"""Errors that a model lacks: what the phases of the verification runs show beyond the drawn errors of the model.

Draws of the parameters assume that the model is complete. Cosine coefficients of the residual in each phase show what
is missing. How much of it is a wandering bias, and so no error of the model, is told by the rests: nothing that the
motion causes changes within one.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimator.estimation.runs.run import Run, with_gyro
from estimator.estimation.spectra import Stretch, cosines
from estimator.tracing.augmented import Augmented
from estimator.tracing.judging.shared_errors import Sharing
from estimator.tracing.judging.verification import DRAWS, Drawn, phases_of
from estimator.tracing.residuals.origin import shape_of
from estimator.types import Floats

_LACKS = ((1, 1.0), (6, 0.1), (36, 0.1))
"""Numbers of cosines in a phase, and the prior odds that a model lacks something in them."""
_LEAST_SEEN, _MOST_SEEN, _SIZES = 0.03, 3.0, 64  # over the doubt, and over what is shown: sizes of what a model lacks
_CLEAR = 500.0  # log odds beyond which nothing is open
_SHARES = np.linspace(0.0025, 0.9975, 200)
"""Shares of the modelled wander of a bias that may be there."""


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class _PhaseShape:
    """Cosine coefficients (k,) of one gyro's residual in one phase, in rad/s over the root of the blocks.

    ``before`` and ``after`` are those of the two models, ``noise`` the variance that the noise of the last predicts for
    each, ``white`` that of its white noise alone.
    """

    at_rest: bool
    before: Floats
    after: Floats
    noise: Floats
    white: float


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class _GyroShape:
    """The phases of one gyro, and by how much its squared residual is larger under the first model.

    The square of the noise is in both residuals, so it is not in the difference.
    """

    phases: Sequence[_PhaseShape]
    difference: float

    @property
    def difference_sd(self) -> float:
        """Standard deviation of the difference by noise."""
        variances = (4 * np.sum((phase.before - phase.after) ** 2 * phase.noise) for phase in self.phases)
        return float(np.sqrt(sum(variances)))


def with_structure(
    runs: Sequence[Run],
    first: int,
    models: tuple[Augmented, Augmented],
    errors: Mapping[str, Drawn],
    sharing: Sharing,
) -> dict[str, Drawn]:
    """Return the drawn errors of two models on ``runs``, plus what the phases show beyond them.

    Whether an effect is missing is one question for all gyros; how much, one for each gyro. Draws with a larger error
    than the phases show are less likely. Where an effect is missing, the error of the first model is that of the last
    plus the measured difference of their squared residuals, since what is missing may be like what the models differ
    in. ``first`` is the number of the first run, ``errors`` are by gyro. Gyros without a phase of full blocks keep
    theirs. What gyros certainly share is no wander.
    """
    drawn = dict(errors)
    shapes = {name: _shape(runs, first, models, name) for name in errors}
    shapes = {name: shape for name, shape in shapes.items() if shape.phases}
    wander = _share_of_wander([phase for shape in shapes.values() for phase in shape.phases])
    if sharing.certain:
        wander = (1 - sharing.share) * wander
    for name, shape in shapes.items():
        shown, doubt = _beyond_noise(shape.phases, 1, wander)
        beyond = np.maximum(drawn[name].after - shown.max(), 0.0)
        drawn[name] = drawn[name].chosen(_by_chance(-0.5 * (beyond / doubt) ** 2))
    incomplete = {name: np.zeros(DRAWS, dtype=np.bool_) for name in shapes}
    # Chance contributes little to means, so little shows there; structure within phases has to be larger.
    for orders, odds in _LACKS:
        open_squares = {}
        for name, shape in shapes.items():
            shown, doubt = _beyond_noise(shape.phases, orders, wander)
            open_squares[name] = shown - drawn[name].after, doubt
        lacking = _lacking(open_squares, odds)
        for name, squares in lacking.items():
            drawn[name] = drawn[name].more_by(squares)
            incomplete[name] |= squares > 0
    for number, (name, shape) in enumerate(shapes.items()):
        chance = shape.difference_sd * np.random.default_rng((1, number)).standard_normal(DRAWS)
        before = np.maximum(drawn[name].after + shape.difference + chance, 0.0)
        drawn[name] = replace(drawn[name], before=np.where(incomplete[name], before, drawn[name].before))
    return drawn


def _shape(runs: Sequence[Run], first: int, models: tuple[Augmented, Augmented], name: str) -> _GyroShape:
    """Return the shape of a gyro's residuals under two models; phases without full blocks are left out.

    It also has by how much the last model lowers the squares of all full blocks, phases or not.
    """
    last = models[-1]
    sigma_rps = float(last.arw[last.names.index(name)])
    phases = []
    difference = 0.0
    for number, run, i in with_gyro(runs, name):
        before, after = (run.z_rps[:, i] - model.predict(run, first + number, i)[0] for model in models)
        held = run.weight > 0
        difference += float(np.sum(before[held] ** 2) - np.sum(after[held] ** 2))
        white = sigma_rps**2 / run.length_s
        span_s = float(run.t_s[-1] - run.t_s[0]) + run.length_s
        for phase in phases_of(run):
            full = held[phase.blocks]
            if not full.any():
                continue
            stretch = Stretch.of(0, slice(0, int(full.sum())), run.length_s, True)
            phases.append(
                _PhaseShape(
                    at_rest=phase.kind == "rest",
                    before=cosines(before[phase.blocks][full]),
                    after=cosines(after[phase.blocks][full]),
                    noise=white * shape_of(last, stretch, span_s),
                    white=white,
                )
            )
    return _GyroShape(phases=phases, difference=difference)


def _share_of_wander(phases: Sequence[_PhaseShape]) -> Floats:
    """Return draws (n,) of the share of a model's wandering bias that is there.

    Only coefficients beyond the mean of rests count; slow errors that no motion causes remain in them. Without rests
    nothing is known: nearly none, or nearly all, is as likely as half.
    """
    log_likely = -0.5 * np.log(_SHARES * (1 - _SHARES))
    for phase in phases:
        if phase.at_rest:
            variance = phase.white + _SHARES[:, None] * (phase.noise[1:] - phase.white)
            log_likely = log_likely - 0.5 * (np.log(variance) + phase.after[1:] ** 2 / variance).sum(axis=1)
    drawn = _SHARES[_by_chance(log_likely)]
    return np.asarray(np.random.default_rng(0).permutation(drawn))


def _beyond_noise(phases: Sequence[_PhaseShape], orders: int, wander: Floats) -> tuple[Floats, float]:
    """Return the squares (n,) that the last model leaves beyond noise, and their standard deviation.

    ``orders`` coefficients count in each phase, summed over blocks; ``wander`` (n,) are draws of the share of the
    modelled wander that is noise.
    """
    beyond_white, of_wander, variance = 0.0, 0.0, 0.0
    for phase in phases:
        squares = phase.after[:orders] ** 2
        noise = phase.noise[:orders]
        beyond_white += float(np.sum(squares - phase.white))
        of_wander += float(np.sum(noise - phase.white))
        variance += float(np.sum(2 * noise**2 + 4 * noise * np.maximum(squares - noise, 0.0)))
    return beyond_white - wander * of_wander, float(np.sqrt(variance))


def _lacking(shown: Mapping[str, tuple[Floats, float]], odds: float) -> dict[str, Floats]:
    """Return by gyro draws (n,) of the squares that a model lacks: none in any gyro, or some in each.

    ``shown`` is by gyro what the phases show (n,) and its standard deviation; ``odds`` are the prior odds that an
    effect is missing.
    """
    beyond = {}
    log_odds = np.full(DRAWS, np.log(odds))
    for number, (name, (squares, doubt)) in enumerate(shown.items(), 1):
        beyond[name], likelier = _beyond(np.random.default_rng(number), squares, doubt)
        log_odds += likelier
    incomplete = np.random.default_rng(0).random(DRAWS) < 1 / (1 + np.exp(-np.clip(log_odds, -_CLEAR, _CLEAR)))
    return {name: squares * incomplete for name, squares in beyond.items()}


def _beyond(random: np.random.Generator, shown: Floats, sd: float) -> tuple[Floats, Floats]:
    """Return draws (n,) of a sum of squares that shows as ``shown`` (n,) within ``sd``, given that there is one.

    Also returns the log odds (n,) that there is one; the prior is even, and equal for the logarithm of each size.
    """
    largest = max(float(shown.max()), sd)
    sizes = np.geomspace(_LEAST_SEEN * sd, _MOST_SEEN * largest, _SIZES)
    logs = -0.5 * ((shown[:, None] - sizes) / sd) ** 2
    total = np.logaddexp.reduce(logs, axis=1)
    upto = np.cumsum(np.exp(logs - total[:, None]), axis=1)
    number = (upto < random.random(len(shown))[:, None]).sum(axis=1)
    return sizes[np.minimum(number, _SIZES - 1)], total - np.log(_SIZES) + 0.5 * (shown / sd) ** 2


def _by_chance(log_likely: Floats) -> NDArray[np.intp]:
    """Return as many numbers as draws, each repeated in proportion to its likelihood."""
    share = np.exp(log_likely - log_likely.max())
    upto = np.cumsum(share) / share.sum()
    return np.searchsorted(upto, (np.arange(DRAWS) + 0.5) / DRAWS).astype(np.intp)
