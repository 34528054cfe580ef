"""How outputs follow a reference: the delay between both, and the residual of a line through all values.

Both sides are means over the same intervals. The delay is looked for over all that is plausible before it is refined,
so it does not depend on where a search begins. Intervals that do not fit, as of a spike or a limit, do not count.
"""

from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from estimator.geometry.kinematics import Site
from estimator.geometry.noise import SD_OF_MEDIAN
from estimator.observations.turned import Turned
from estimator.recordings.motion.body_rates import BodyRates
from estimator.recordings.recording import ImuData
from estimator.recordings.reference import Reference
from estimator.types import Flags, Floats

LONGEST_S = 0.3
"""Longest delay between gyros and reference that is looked for, either way."""
_STEP_S = 0.01  # of the delays that are tried first
_REFINED = 1e-3  # of two such steps: how closely the best delay is found
_ALIKE = 1e-6  # losses that differ by less are compared without the rounding of normal equations
_LENGTH_S, _PERIODS = 0.05, 3  # of an interval: so long, and no fewer sampling periods
_SLOW_S = 0.5  # length of means that show the gyros' response to slow motion
_FILTER_S, _HARDLY = 0.2, 1e-3  # time constant of a filter, and how much an expectation of it counts
_MOST, _FEWEST = 6000, 40  # intervals used of a long recording, and the fewest for a result
_TURNS_RPS = float(np.radians(0.5))  # rms of a body rate that determines a delay
_FITS = 4.0  # standard deviations from the line beyond which an interval does not count
_ROUNDS = 2
_ALLOWED = 0.02  # share of the rate: an interval that is off by less counts, however quiet the others are
_INNER = 0.7  # of the outputs' range: values near its ends may be at a limit, and do not count
_ENDS = 1e-3  # share of the outputs beyond each end of their range
_USUAL = 0.9  # quantile of the rates beyond which an interval has no more weight
_MIDDLE, _AT_MOST = (0.05, 0.95), 0.15  # share of the range of nearly all outputs that an interval may be off
_SEEN = 1e-3  # of the rate about the axis that turns most: one that turns by less is not seen
_LEAST_NOISE_RPS = 1e-6
_AT_ONCE = 16_384  # intervals of a search: their arrays fit into the cache of a processor
_DELAYS: "WeakKeyDictionary[ImuData, tuple[Reference, Site | None, float]]" = WeakKeyDictionary()


@dataclass(frozen=True, slots=True, eq=False)
class Following:
    """Outputs as a linear function of the body rate: ``y = [1, w(t - delay_s)] @ rows``, rows (4, m).

    ``scatter_rps`` (m,) is the usual deviation of a mean from it, as a standard deviation; ``turned`` is the body's
    motion.
    """

    delay_s: float
    rows: Floats
    scatter_rps: Floats
    turned: Turned
    means: "_Means"

    def follows(self) -> Floats:
        """Return the share (m,) of each output's variance that the line explains, 0 where none of it is known.

        It is from 0 to 1, and 0 for a constant output. Intervals that deviate far more than nearly all others are left
        out: there the reference jumps.
        """
        left = np.abs(self.means.outputs - self.rows[0] - self.means.rates(self.delay_s) @ self.rows[1:])
        shares = np.zeros(left.shape[1])
        for gyro, (own, output) in enumerate(zip(left.T, self.means.outputs.T, strict=True)):
            known = np.isfinite(own)
            if not known.any():
                continue
            known &= own <= _FITS * float(np.quantile(own[known], _USUAL))
            squares = float(np.var(output[known]))
            if squares > 0:
                shares[gyro] = max(1 - float(np.mean(own[known] ** 2)) / squares, 0.0)
        return shares

    def turning(self) -> Floats:
        """Return the covariance (3, 3) of the body rate, as means over intervals."""
        rates = self.means.rates(self.delay_s)
        known = rates[np.isfinite(rates).all(axis=1)]
        return np.asarray(np.cov(known.T, bias=True))

    def slow_rows(self) -> Floats:
        """Return rows (3, m) for slow motion, where filters on either side do not matter: fitted with the rate's
        derivatives.

        Means, or a controller that smooths its rates, make outputs look more or less sensitive to fast motion. Outputs
        with too few intervals keep their row of ``rows``.
        """
        means = self.means.longer(max(_SLOW_S, self.means.length_s)) or self.means
        step_s = means.length_s
        before, here, after = (means.rates(self.delay_s + by) for by in (step_s, 0.0, -step_s))
        columns = np.column_stack([np.ones(len(here)), here, (after - before) / 2, after - 2 * here + before])
        left = np.abs(means.outputs - self.rows[0] - here @ self.rows[1:])
        rows = self.rows[1:].copy()
        for gyro, own in enumerate(left.T):
            good = np.isfinite(own) & np.isfinite(columns).all(axis=1)
            if good.sum() < _FEWEST:
                continue
            good &= own <= _FITS * float(np.quantile(own[good], _USUAL))
            rows[:, gyro] = _least(columns[good], means.outputs[good, gyro], step_s)[1:4]
        return rows

    def expected_rps(self, t_s: Floats) -> Floats:
        """Return the expected outputs (n, m) at instants of samples (n,), NaN where unknown."""
        return np.asarray(self.rows[0] + self.turned.rates(t_s - self.delay_s) @ self.rows[1:])


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class _Means:
    """Mean outputs (n, m) over intervals of ``length_s`` from ``first_s`` (n,) on.

    ``most_rps`` (m,) limits the deviation of an interval that counts. ``gyros`` are the outputs with the indices
    ``used`` (u,), ``body`` is the body's motion, both smoothed over the same periods.
    """

    length_s: float
    first_s: Floats
    outputs: Floats
    most_rps: Floats
    used: NDArray[np.intp]
    gyros: Turned
    body: Turned

    @classmethod
    def over(
        cls, length_s: float, gyros: Turned, body: Turned, used: NDArray[np.intp], channels: int
    ) -> "_Means | None":
        """Return the means, of a few thousand intervals for a long recording; None if there are too few.

        ``channels`` is the number of gyros; outputs that are not ``used`` are NaN.
        """
        edges = np.arange(max(gyros.t_s[0], body.t_s[0]), min(gyros.t_s[-1], body.t_s[-1]), length_s)
        if len(edges) <= _FEWEST:
            return None
        chosen = np.linspace(0, len(edges) - 2, min(len(edges) - 1, _MOST)).astype(np.intp)
        outputs = np.full((len(chosen), channels), np.nan)
        outputs[:, used] = gyros.means(edges[chosen], edges[chosen + 1])
        spread = np.zeros(channels)
        for gyro, own in enumerate(outputs.T):
            known = own[np.isfinite(own)]
            if len(known):
                spread[gyro] = np.ptp(np.quantile(known, _MIDDLE))
        return cls(
            length_s=length_s,
            first_s=edges[chosen],
            outputs=outputs,
            most_rps=_AT_MOST * spread,
            used=used,
            gyros=gyros,
            body=body,
        )

    def rates(self, delay_s: float) -> Floats:
        """Return the mean body rates (n, 3) so long before, NaN where they are not known."""
        first_s = self.first_s - delay_s
        return self.body.means(first_s, first_s + self.length_s)

    def longer(self, length_s: float) -> "_Means | None":
        """Return means over longer intervals."""
        return _Means.over(length_s, self.gyros, self.body, self.used, self.outputs.shape[1])


def _least(columns: Floats, output: Floats, step_s: float) -> Floats:
    """Return the least-squares factors (10,) of [1, rate, first, second differences] (n, 10) for an output (n,).

    The second derivative of a single swing resembles the swing: what cannot be separated is attributed to the rate. An
    axis that hardly turns has the factor 0. ``step_s`` is the distance of the rates whose differences are taken.
    """
    size = np.sqrt(np.mean(columns**2, axis=0))
    of_axes = np.max(size[1:].reshape(3, 3), axis=1)  # of the rate, its first and its second differences
    largest = np.concatenate([size[:1], np.repeat(of_axes, 3)])
    scale = np.where(size > _SEEN * largest, size, np.inf)  # an axis without rotation has no factor
    # Factors of the differences are expected to be those of a filter.
    filtered = np.repeat([_FILTER_S / step_s, 0.5 * (_FILTER_S / step_s) ** 2], 3)
    expected = np.diag(np.concatenate([np.zeros(4), 1 / filtered])) * _HARDLY * float(np.std(output))
    both = np.vstack([columns / np.sqrt(len(columns)), expected]) / scale
    right = np.concatenate([output / np.sqrt(len(output)), np.zeros(len(expected))])
    return np.asarray(np.linalg.lstsq(both, right, rcond=1e-9)[0] / scale)


def delay_by_motion(data: ImuData, reference: Reference, site: Site | None) -> float:
    """Return the delay in s at which outputs follow a reference, 0 where ``following`` gives nothing.

    It is looked for once as long as the data are kept, unless they are compared with another reference in between.
    """
    known = _DELAYS.get(data)
    if known is None or known[0] is not reference or known[1] != site:
        following(data, reference, site)
    return _DELAYS[data][2]


def following(data: ImuData, reference: Reference, site: Site | None) -> Following | None:
    """Return how the outputs of a source follow a reference; None if the reference gives no rates or hardly turns.

    The delay is searched for on a grid and refined; intervals near the ends of the range, or far off, are left out. It
    is remembered for ``delay_by_motion``, 0 for None.
    """
    found = _followed(data, reference, site)
    _DELAYS[data] = reference, site, 0.0 if found is None else found.delay_s
    return found


def _followed(data: ImuData, reference: Reference, site: Site | None) -> Following | None:
    """Return delay, rows and scatter of the outputs as a function of the body rate.

    Intervals with the largest errors are left out of the fit. None if the reference does not give the motion at all
    instants, there are fewer than ``_FEWEST`` intervals, or the body turns too slowly to show a delay.
    """
    body = body_turned(reference, site)
    means = None if body is None else _means(data, body)
    if body is None or means is None:
        return None
    turning = means.rates(0.0)
    turning = turning[np.isfinite(turning).all(axis=1)]
    if len(turning) < _FEWEST or float(np.sqrt(np.mean(np.sum(turning**2, axis=1)))) < _TURNS_RPS:
        return None
    inner = np.isfinite(means.outputs) & ~_near_ends(means.outputs)
    delay_s = _refined(means, _tried(means, inner), inner)
    fits = inner
    for _ in range(_ROUNDS):
        # Ramps alone may determine the delay: only the intervals with the largest errors are left out.
        _, left, _ = _line(means, delay_s, fits)
        fits = _nearer(means, delay_s, left, inner, _FITS * _quantile(left, inner, _USUAL))
        delay_s = _refined(means, delay_s, fits)
    rows, left, _ = _line(means, delay_s, fits)
    scatter = SD_OF_MEDIAN * _quantile(left, inner, 0.5)
    for _ in range(_ROUNDS):
        rows, left, _ = _line(means, delay_s, _nearer(means, delay_s, left, inner, _FITS * scatter))
        scatter = np.maximum(SD_OF_MEDIAN * _quantile(left, inner, 0.5), _LEAST_NOISE_RPS)
    return Following(delay_s, rows, scatter, body, means)


def body_turned(reference: Reference, site: Site | None) -> Turned | None:
    """Return the integrated motion of a body, about its axes.

    For a table it includes Earth rate if ``site`` is known. None if a reference does not give it at all instants, or
    has fewer than two that are known.
    """
    if reference.instants_ns is None or len(reference.instants_ns) < 2:
        return None
    if reference.by_turns:
        return Turned.of_reference(reference, site)
    table = reference.table
    assert table is not None, "readings at instants are those of a table or of another instrument"
    rates = BodyRates.of(table, site)
    inside = (table.t_ns >= rates.starts_ns) & (table.t_ns <= rates.final_until_ns)
    t_ns = table.t_ns[inside]
    return Turned.of_rates(t_ns, rates.at(t_ns)) if len(t_ns) > 1 else None


def _means(data: ImuData, body: Turned) -> _Means | None:
    """Return the mean outputs of a source and the motion of the body; None if there are too few valid samples or
    intervals.

    Outputs that are mostly not finite are not used; samples at which another one is not finite are left out.
    """
    finite = np.isfinite(data.rate_rps)
    used = np.flatnonzero(finite.mean(axis=0) > 0.5)
    whole = finite[:, used].all(axis=1)
    if not len(used) or whole.sum() < 2 * _FEWEST:
        return None
    gyros = Turned.of_rates(data.t_ns[whole], data.rate_rps[whole][:, used])
    period_s = max(float(np.median(np.diff(one.t_s))) for one in (gyros, body))
    length_s = max(_LENGTH_S, _PERIODS * period_s)
    return _Means.over(length_s, gyros.smoothed(period_s), body.smoothed(period_s), used, len(data.array))


def _near_ends(outputs: Floats) -> Flags:
    """Return as flags (n, m) which outputs are near the ends of their range: beyond 70 % of the way from the median.

    NaN is not near.
    """
    near = np.zeros(outputs.shape, dtype=np.bool_)
    for gyro, own in enumerate(outputs.T):
        known = own[np.isfinite(own)]
        if len(known):
            low, middle, high = np.quantile(known, [_ENDS, 0.5, 1 - _ENDS])
            near[:, gyro] = (own > middle + _INNER * (high - middle)) | (own < middle - _INNER * (middle - low))
    return near


def _columns(means: _Means, delay_s: float) -> tuple[Floats, Flags, Floats]:
    """Return [1, body rate] (n, 4) at a delay, NaN where unknown, flags (n,) of known ones, and weights (n,).

    The weight is 0 where the rate is unknown. Intervals that turn faster than nearly all others get less weight, so
    that a reference that jumps has no more.
    """
    w = means.rates(delay_s)
    known, weight = _weights(w.T[None])
    return np.column_stack([np.ones(len(w)), w]), known[0], weight[0]


def _weights(w: Floats) -> tuple[Flags, Floats]:
    """Return for body rates (d, 3, n) which are known (d, n), and their weights (d, n), 0 elsewhere.

    The weight is 1 for the lower nine tenths of the speeds, and falls in inverse proportion to the speed above these.
    """
    x, y, z = w.transpose(1, 0, 2)
    speed = np.sqrt(x * x + y * y + z * z)
    known = np.isfinite(speed)
    weight = np.zeros(speed.shape)
    for own, good, weights in zip(speed, known, weight, strict=True):
        if good.any():
            usual = float(np.quantile(own[good], _USUAL))
            weights[good] = np.minimum(usual / np.maximum(own[good], 1e-12), 1.0)
    return known, weight


def _line(means: _Means, delay_s: float, fits: Flags) -> tuple[Floats, Floats, Floats]:
    """Fit the outputs by least squares at a delay; return coefficients (4, m), residuals (n, m), and weights (n,).

    The coefficients of a gyro are its offset and its factors for the body rates x, y, z. ``fits`` (n, m) flags the
    intervals to use. A gyro with fewer than ``_FEWEST`` usable ones gets zeros, so that its residual is its output.
    Residuals are not weighted and cover all intervals. Weights are 0 where the rate is unknown.
    """
    columns, known, weight = _columns(means, delay_s)
    rows = np.zeros((4, means.outputs.shape[1]))
    for gyro, own in enumerate(fits.T):
        good = known & own
        if good.sum() >= _FEWEST:
            weighed = columns[good] * weight[good, None]
            scale = _scales(np.mean(weighed**2, axis=0))
            right = means.outputs[good, gyro] * weight[good]
            rows[:, gyro] = np.linalg.lstsq(weighed / scale, right, rcond=_SEEN)[0] / scale
    return rows, means.outputs - columns @ rows, weight


def _scales(squares: Floats) -> Floats:
    """Return the scales (..., 4) of columns with such mean squares: one for the body rate about all axes.

    The first column, the constant, has its own. An axis about which nothing but the Earth turns is not seen: its noise
    would be called a sensitivity.
    """
    size = np.sqrt(squares)
    size[..., 1:] = np.max(size[..., 1:], axis=-1, keepdims=True)
    return np.maximum(size, 1e-12)


def _loss(means: _Means, delay_s: float, fits: Flags) -> float:
    """Return the loss of a delay: the log of the mean square residual, each limited to ``most_rps``, averaged over
    gyros.
    """
    _, left, weight = _line(means, delay_s, fits)
    counts = fits & np.isfinite(left)
    sizes = np.minimum(np.where(counts, np.abs(left) * weight[:, None], 0.0), means.most_rps)
    number = counts.sum(axis=0)
    squares = np.sum(sizes**2, axis=0) / np.maximum(number, 1)
    return float(np.sum(number * np.log(squares + _LEAST_NOISE_RPS**2)) / max(number.sum(), 1))


def _tried(means: _Means, fits: Flags) -> float:
    """Return the delay, of a grid over all that are looked for, that leaves least.

    Normal equations of all gyros at once tell which delays may be it, in half the time of exact least squares.
    """
    tried_s = np.arange(-LONGEST_S, LONGEST_S + _STEP_S / 2, _STEP_S)
    outputs = np.where(fits, means.outputs, 0.0).T.copy()
    at_once = max(_AT_ONCE // len(means.first_s), 1)
    parts = (tried_s[first : first + at_once] for first in range(0, len(tried_s), at_once))
    losses = np.concatenate([_losses_by_normal_equations(means, outputs, part, fits) for part in parts])
    may_be = tried_s[losses <= losses.min() + _ALIKE].tolist()
    if len(may_be) == 1:
        return float(may_be[0])
    return float(may_be[int(np.argmin([_loss(means, delay, fits) for delay in may_be]))])


def _losses_by_normal_equations(means: _Means, outputs: Floats, delays_s: Floats, fits: Flags) -> Floats:
    """Return for delays (d,) what ``_loss`` returns, but for rounding, in less time.

    ``fits`` (n, m) flags the intervals that count, ``outputs`` (m, n) are 0 where they do not.
    """
    first_s = (means.first_s - delays_s[:, None]).ravel()
    w = means.body.means(first_s, first_s + means.length_s).reshape(len(delays_s), -1, 3)
    columns = np.ones((len(delays_s), 4, w.shape[1]))
    columns[:, 1:] = w.transpose(0, 2, 1)
    known, weight = _weights(columns[:, 1:])
    if not known.all():
        columns[:, 1:] = np.where(known[:, None], columns[:, 1:], 0.0)
    columns *= weight[:, None]
    right = outputs * weight[:, None]
    good = (fits.T & known[:, None]).astype(np.float64)
    number = good.sum(axis=-1)
    upper, lower = np.triu_indices(4)
    gram = np.empty((*number.shape, 4, 4))
    products = np.concatenate([columns[:, i : i + 1] * columns[:, i:] for i in range(4)], axis=1)
    gram[:, :, upper, lower] = good @ products.transpose(0, 2, 1)
    gram[:, :, lower, upper] = gram[:, :, upper, lower]
    scale = _scales(np.diagonal(gram, axis1=2, axis2=3) / np.maximum(number, 1)[..., None])
    values, vectors = np.linalg.eigh(gram / (scale[..., :, None] * scale[..., None, :]))
    seen = values > _SEEN**2 * values[..., -1:]
    along = ((right @ columns.transpose(0, 2, 1)) / scale)[..., None, :] @ vectors
    rows = (vectors @ (along[..., 0, :] / np.where(seen, values, np.inf))[..., None])[..., 0] / scale
    rows[number < _FEWEST] = 0.0
    sizes = np.minimum(np.abs(right - rows @ columns), means.most_rps[:, None]) * good
    squares = np.sum(sizes**2, axis=-1) / np.maximum(number, 1)
    losses = np.sum(number * np.log(squares + _LEAST_NOISE_RPS**2), axis=-1) / np.maximum(number.sum(axis=-1), 1)
    return np.asarray(losses)


def _refined(means: _Means, delay_s: float, fits: Flags) -> float:
    """Return the delay of least loss within one and a half steps of ``delay_s``; ``fits`` (n, m) as for ``_loss``."""
    from scipy.optimize import minimize_scalar

    found = minimize_scalar(
        lambda delay: _loss(means, delay, fits),
        bounds=(delay_s - 1.5 * _STEP_S, delay_s + 1.5 * _STEP_S),
        method="bounded",
        options={"xatol": _REFINED * 2 * _STEP_S},
    )
    return float(found.x)


def _quantile(distances: Floats, inner: Flags, share: float) -> Floats:
    """Return the distance (m,) from the line within which the ``share`` of the intervals lies; infinite without any.

    Those of ``inner`` (n, m) whose deviation in ``distances`` (n, m), of either sign, is known count.
    """
    found = np.full(distances.shape[1], np.inf)
    for gyro, own in enumerate(distances.T):
        known = own[inner[:, gyro] & np.isfinite(own)]
        if len(known):
            found[gyro] = np.quantile(np.abs(known), share)
    return found


def _nearer(means: _Means, delay_s: float, distances: Floats, inner: Flags, distance: Floats) -> Flags:
    """Return as flags (n, m) which intervals are within ``distance`` (m,) of the line, or within a share of their rate.

    Only intervals of ``inner`` (n, m) whose deviation in ``distances`` (n, m) is known may be so. The share is for a
    body that mostly rests and turns briefly: otherwise its rests alone would decide.
    """
    speed = np.linalg.norm(means.rates(delay_s), axis=1)
    allowed = np.maximum(distance, _ALLOWED * np.nan_to_num(speed)[:, None])
    return np.asarray(inner & (np.abs(np.nan_to_num(distances, nan=np.inf)) <= allowed))
