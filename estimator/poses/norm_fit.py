"""The norm method: nine parameters of an accelerometer triad from rests in unknown poses, with gravity alone.

Each rest gives one equation, the length of its specific force. What the rests do not determine is stated as that.
"""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from estimator.poses.intrinsic import Intrinsic, Lengths
from estimator.types import Flags, Floats

PARAMETERS = 9
PLAUSIBLE = np.array([0.05] * 3 + [0.05] * 3 + [0.05] * 3)
"""Sizes of errors of an accelerometer: of its scale, of the bias in g, of the angles in rad."""
_SHOWN = 0.1  # share of the plausible variance that may be left of a parameter that the rests show
_ITERATIONS, _SETTLED = 50, 1e-9  # plausible sizes
_SUBSETS, _IMPROVED = 200, 4  # of rests, tried as the good ones
_FAR = 6.0  # sigmas of the good ones
_FALSE = 0.01  # probability of refusing any rest of a good session
_LARGEST_SHARE = 0.25  # of the rests that are refused at most


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class Rests:
    """Mean outputs (n, 3) of rests, the covariance of each mean (n, 3, 3) by white noise, and gravity in m/s2.

    ``wander`` (n,) is the variance of a mean, in outputs, by noise that does not average out; it counts where residuals
    cannot show it. Without ``noise_known`` the covariances are right but for a common factor.
    """

    outputs: Floats
    covariance: Floats
    wander: Floats
    gravity_mps2: float
    noise_known: bool = True

    def __len__(self) -> int:
        return len(self.outputs)

    def only(self, flags: Flags) -> Self:
        """Return the rests of which ``flags`` (n,) is true."""
        return replace(
            self,
            outputs=self.outputs[flags],
            covariance=self.covariance[flags],
            wander=self.wander[flags],
        )


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class NormFit:
    """Parameters with their covariance (9, 9), in the order of ``intrinsic.NAMES``, without that of gravity.

    ``shown`` (9,) tells which parameters the rests determine; the values of the others are not to be used.
    ``residual_mps2`` (n,) are lengths less gravity, ``between_mps2`` the standard deviation of rests beyond the noise
    of their means. ``freedom`` counts rests less parameters, 0 if the residuals cannot show the noise.

    ``factor`` is the ratio of the half width of an interval of 95 % to the standard uncertainty: Student's if the
    residuals give the noise, normal if they are no larger than the noise within the rests says. Together both cover
    93 to 97 % for any scatter of rests from two degrees of freedom on.
    """

    parameters: Intrinsic
    covariance: Floats
    shown: Flags
    residual_mps2: Floats
    sd_mps2: Floats
    between_mps2: float
    freedom: int
    factor: float


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class Doubtful:
    """A rest that does not fit the others: its number, the residual in m/s2 without it, and in its own sigma."""

    rest: int
    off_mps2: float
    sigmas: float


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class _Linear:
    """Residuals (n,), their derivatives (n, 9) by scaled parameters, and their variances (n,), at some parameters.

    ``wander`` (n,) are the variances by noise that does not average out.
    """

    residual: Floats
    slopes: Floats
    variance: Floats
    wander: Floats


def start_of(rests: Rests, *, scale_known: bool) -> Intrinsic:
    """Return parameters to begin with: the ideal ones, or centre and half widths of the outputs of raw counts.

    An axis whose half width is below half of the median one, as it was hardly turned, gets the median.
    """
    if scale_known:
        return Intrinsic.ideal()
    low, high = rests.outputs.min(axis=0), rests.outputs.max(axis=0)
    half = 0.5 * (high - low)
    half = np.where(half > 0.5 * np.median(half), half, np.median(half))
    return Intrinsic(scale=half / rests.gravity_mps2, offset=0.5 * (low + high), angle_rad=np.zeros(3))


def fit_robustly(rests: Rests, start: Intrinsic) -> tuple[NormFit, list[Doubtful]]:
    """Return the fit of the rests that agree with each other, and the others.

    Rests far off the fit of those that agree best are set aside, and come back if the others predict them. The rest
    that fits least is tested by its residual without it (Student's t, over all rests together). At least eleven rests,
    and three quarters of all, are kept; of fewer than eleven none is tested.
    """
    from scipy.stats import t

    count = len(rests)
    least = max(PARAMETERS + 2, int(np.ceil((1 - _LARGEST_SHARE) * count)))
    if count < least:
        return fit(rests, start), []
    kept = _near(rests, start, least)
    current = fit(rests.only(kept), start)
    for _ in range(2 * count):
        deleted = _deleted(rests, kept, current)
        limit = float(t.isf(0.5 * _FALSE / count, max(current.freedom - 1, 1)))
        outside = np.flatnonzero(~kept)
        nearest = outside[np.argmin(np.abs(deleted[outside]))] if len(outside) else -1
        inside = np.flatnonzero(kept)
        worst = inside[np.argmax(np.abs(deleted[inside]))]
        if nearest >= 0 and abs(deleted[nearest]) <= limit:
            kept[nearest] = True
        elif abs(deleted[worst]) > limit and kept.sum() > least:
            kept[worst] = False
        else:
            break
        current = fit(rests.only(kept), current.parameters)
    deleted = _deleted(rests, kept, current)
    linear = _linear(rests, current.parameters)
    doubtful = [
        Doubtful(rest=int(at), off_mps2=float(linear.residual[at]), sigmas=float(abs(deleted[at])))
        for at in np.flatnonzero(~kept)
    ]
    return current, doubtful


def fit(rests: Rests, start: Intrinsic) -> NormFit:
    """Return the generalised least-squares fit of the rests, from the parameters ``start``.

    With more rests than parameters, the residuals give the variance between rests (Paule and Mandel 1982), or the scale
    of all variances if the noise of the means is not known. If the rests do not determine all parameters, the residuals
    are not used and a prior of plausible sizes is added to the information.
    """
    from scipy.stats import norm, t

    parameters = _minimised(rests, start, 0.0)
    shown = _shown(rests, parameters)
    freedom = max(len(rests) - PARAMETERS, 0) if shown.all() else 0
    between = 0.0
    if freedom and rests.noise_known:
        parameters, between = _with_between(rests, parameters, freedom)
    linear = _linear(rests, parameters)
    variance = linear.variance + (between**2 if freedom else linear.wander)
    if freedom and not rests.noise_known:
        variance = variance * float(np.sum(linear.residual**2 / variance)) / freedom
    information = (linear.slopes / variance[:, None]).T @ linear.slopes
    prior = np.zeros(PARAMETERS) if shown.all() else np.ones(PARAMETERS)
    scaled = np.linalg.pinv(information + np.diag(prior), hermitian=True)
    sizes = _sizes(rests, parameters)
    from_residuals = freedom > 0 and (between > 0 or not rests.noise_known)
    return NormFit(
        parameters=parameters,
        covariance=scaled * np.outer(sizes, sizes),
        shown=shown,
        residual_mps2=linear.residual,
        sd_mps2=np.sqrt(variance),
        between_mps2=between,
        freedom=freedom,
        factor=float(t.ppf(0.975, freedom) if from_residuals else norm.ppf(0.975)),
    )


def _sizes(rests: Rests, parameters: Intrinsic) -> Floats:
    """Return plausible sizes (9,) of errors, in units of the parameters."""
    in_outputs = np.concatenate([parameters.scale, parameters.scale * rests.gravity_mps2, np.ones(3)])
    return np.asarray(PLAUSIBLE * np.abs(in_outputs))


def _linear(rests: Rests, parameters: Intrinsic) -> _Linear:
    """Return the residuals at some parameters; the bias of a length by the noise of a mean is taken off."""
    lengths = Lengths.of(parameters, rests.outputs)
    variance = np.einsum("ni,nij,nj->n", lengths.by_output, rests.covariance, lengths.by_output)
    across = np.einsum("ij,nij->n", lengths.inverse, rests.covariance) - variance
    excess = across / (2 * rests.gravity_mps2)
    return _Linear(
        residual=lengths.length_mps2 - excess - rests.gravity_mps2,
        slopes=lengths.by_parameter * _sizes(rests, parameters),
        variance=np.maximum(variance, 1e-18 * rests.gravity_mps2**2),
        wander=rests.wander * np.sum(lengths.by_output**2, axis=1),
    )


def _minimised(rests: Rests, start: Intrinsic, between: float) -> Intrinsic:
    """Return the parameters of least squares from ``start``, by damped steps (Levenberg, Marquardt).

    ``between`` is as for ``_cost``. If the rests do not determine all parameters, all are drawn to ``start``, within
    plausible sizes.
    """
    parameters = start
    sizes = _sizes(rests, start)
    damping = 1e-3
    regular = np.zeros(PARAMETERS)
    if not _shown(rests, start).all():
        regular = np.ones(PARAMETERS)
    origin = start.vector
    cost = _cost(rests, parameters, between, regular, origin, sizes)
    for _ in range(_ITERATIONS):
        linear = _linear(rests, parameters)
        now = _sizes(rests, parameters)
        weight = 1 / (linear.variance + between**2)
        slopes = linear.slopes * (sizes / now)
        apart = (parameters.vector - origin) / sizes
        gradient = slopes.T @ (weight * linear.residual) + regular * apart
        curvature = (slopes * weight[:, None]).T @ slopes + np.diag(regular)
        step = -np.linalg.lstsq(curvature + damping * np.diag(np.diag(curvature)), gradient, rcond=None)[0]
        tried = Intrinsic.of_vector(parameters.vector + step * sizes)
        tried_cost = _cost(rests, tried, between, regular, origin, sizes)
        if tried_cost <= cost:
            parameters, cost, damping = tried, tried_cost, damping * 0.1
            if np.abs(step).max() < _SETTLED:
                break
        else:
            damping = max(damping, 1e-6) * 10
    return parameters


def _cost(rests: Rests, parameters: Intrinsic, between: float, regular: Floats, origin: Floats, sizes: Floats) -> float:
    """Return the weighted sum of squares, infinity for parameters that no triad has.

    ``between`` is the scatter between rests in addition to their noise, in m/s2. ``regular`` (9,) weighs the distance
    of the parameters from ``origin`` (9,), in units of ``sizes`` (9,).
    """
    if (parameters.scale <= 0).any() or np.linalg.eigvalsh(parameters.cosines)[0] <= 0.01:
        return np.inf
    linear = _linear(rests, parameters)
    apart = (parameters.vector - origin) / sizes
    squares = float(np.sum(linear.residual**2 / (linear.variance + between**2)))
    return squares + float(np.sum(regular * apart**2))


def _shown(rests: Rests, parameters: Intrinsic) -> Flags:
    """Return which parameters (9,) the rests determine: their part of plausible variance that is left is small.

    By the singular values of the derivatives, scaled by noise and by plausible sizes.
    """
    linear = _linear(rests, parameters)
    _, values, directions = np.linalg.svd(linear.slopes / np.sqrt(linear.variance)[:, None])
    values = np.concatenate([values, np.zeros(PARAMETERS - len(values))])
    left = (directions**2).T @ (1 / (1 + values**2))
    return np.asarray(left < _SHOWN)


def _with_between(rests: Rests, parameters: Intrinsic, freedom: int) -> tuple[Intrinsic, float]:
    """Return parameters and the standard deviation between rests, in m/s2, at which residuals are as large as expected.

    The squares of the residuals, over their variances, then add up to ``freedom``. The standard deviation is 0 if they
    add up to no more than that without it.
    """

    def excess(parameters: Intrinsic, between: float) -> float:
        linear = _linear(rests, parameters)
        return float(np.sum(linear.residual**2 / (linear.variance + between**2))) - freedom

    if excess(parameters, 0.0) <= 0:
        return parameters, 0.0
    low, high = 0.0, float(np.sqrt(np.mean(_linear(rests, parameters).residual ** 2) * len(rests) / freedom)) * 2
    best = parameters
    for _ in range(40):
        between = 0.5 * (low + high)
        best = _minimised(rests, best, between)
        if excess(best, between) > 0:
            low = between
        else:
            high = between
        if high - low < 1e-4 * high:
            break
    return best, high


def _near(rests: Rests, start: Intrinsic, least: int) -> Flags:
    """Return which rests (n,) agree with the ``least`` of them that agree best: least trimmed squares.

    Fits of random subsets, each improved by its own best rests, in the linear model about the present fit (Rousseeuw
    and Van Driessen 2006).
    """
    random = np.random.default_rng(0)
    parameters = _minimised(rests, start, 0.0)
    best: Flags = np.ones(len(rests), dtype=bool)
    for _ in range(2):
        linear = _linear(rests, parameters)
        sd = np.sqrt(linear.variance)
        slopes, left = linear.slopes / sd[:, None], linear.residual / sd
        lowest = np.inf
        for _ in range(_SUBSETS):
            subset = random.choice(len(rests), PARAMETERS + 1, replace=False)
            for _ in range(_IMPROVED):
                step = np.linalg.lstsq(slopes[subset], -left[subset], rcond=None)[0]
                squares = (left + slopes @ step) ** 2
                subset = np.argpartition(squares, least - 1)[:least]
            total = float(squares[subset].sum())
            if total < lowest:
                lowest = total
                best = np.zeros(len(rests), dtype=bool)
                best[subset] = True
        parameters = _minimised(rests.only(best), parameters, 0.0)
    linear = _linear(rests, parameters)
    size = np.abs(linear.residual) / np.sqrt(linear.variance)
    usual = float(np.sqrt(np.sum(size[best] ** 2) / max(best.sum() - PARAMETERS, 1)))
    return np.asarray(best | (size <= _FAR * max(usual, 1e-9)))


def _deleted(rests: Rests, used: Flags, current: NormFit) -> Floats:
    """Return the residual of each rest (n,) without it in the fit, in its own sigma (externally studentised).

    ``used`` (n,) are the rests in the fit ``current``. It is 0 for a rest that alone determines a parameter.
    """
    linear = _linear(rests, current.parameters)
    variance = linear.variance + current.between_mps2**2
    own = linear.slopes[used]
    inverse = np.linalg.pinv((own / variance[used][:, None]).T @ own, hermitian=True)
    leverage = np.einsum("ni,ij,nj->n", linear.slopes, inverse, linear.slopes) / variance
    squares = linear.residual**2 / variance
    total = float(squares[used].sum())
    freedom = max(int(used.sum()) - PARAMETERS, 1)
    remaining = np.maximum(1 - leverage, 1e-9)
    inside = (total - squares / remaining) / max(freedom - 1, 1)
    scale = np.where(used, inside, total / freedom)
    if rests.noise_known:
        scale = np.maximum(scale, 1.0)
    spread = np.where(used, remaining, 1 + leverage)
    usable = np.where(used & (leverage > 1 - 1e-6), 0.0, 1.0)
    return np.asarray(
        usable
        * linear.residual
        / np.sqrt(variance * np.maximum(spread * scale, 1e-12))
        * np.where(used, 1 / remaining * spread, 1.0)
    )
