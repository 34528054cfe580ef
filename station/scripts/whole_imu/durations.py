"""How long the turns and rests of a script last: a problem of few variables, with a slow and slightly noisy prediction.

The logarithms of sigmas are modelled about the best variables so far, and the model is solved in their neighbourhood,
again and again. A variance is modelled as a floor plus the inverse of information that grows with each time: the floor
is what noise that does not average out, gravity and the table leave. Floor and shares of the times are those that fit
value and slopes of the prediction.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from drivers.types import Floats

_STEP = 0.1  # of the logarithm of a time, for slopes: beyond what single blocks of the prediction matter
_REACH, _SHORTEST_REACH = 1.0, 0.1  # of the logarithm of a time, in which a model is trusted
_SHORTER = 0.4
_SINGLE_STEPS = (0.15, 0.07)
_MOST_MODELS = 6
_SETTLED = 3e-3  # share of the cost
_OUTSIDE = 10.0  # cost of a sigma beyond its limit, per logarithm


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Times:
    """The time of a script: ``fixed_s`` plus times v (p,) that each occur ``counts`` (p,) times.

    None is below ``least`` (p,) or above ``most_s``. All are in s.
    """

    fixed_s: float
    counts: Floats
    least: Floats
    most_s: float

    def log_total(self, u: Floats) -> float:
        """Return the logarithm of the time for logarithms u (p,) of the times."""
        return math.log(self.fixed_s + float(self.counts @ np.exp(u)))

    def within(self, v: Floats, total_s: float) -> Floats:
        """Return times v (p,) with what is above their least changed in common, so that the total is ``total_s``."""
        above_s = float(self.counts @ (v - self.least))
        slack_s = total_s - self.fixed_s - float(self.counts @ self.least)
        if above_s <= 0:
            return np.asarray(self.least + slack_s / self.counts / len(self.least))
        return np.asarray(self.least + (v - self.least) * slack_s / above_s)

    def slope(self, u: Floats) -> Floats:
        """Return its derivative (p,) by them."""
        return np.asarray(self.counts * np.exp(u) / math.exp(self.log_total(u)))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Model:
    """Logarithms of sigmas (r,) about variables ``u`` (p,)."""

    u: Floats
    variance: Floats
    floor: Floats
    shares: Floats

    @classmethod
    def of(cls, u: Floats, logs: Floats, slopes: Floats) -> "_Model":
        """Return the model that has the values ``logs`` (r,) and ``slopes`` (r, p) at ``u`` (p,).

        A rising slope counts as none; slopes that fall by more than 1/2 in sum count as 1/2; a sigma that falls nowhere
        has equal shares.
        """
        falls = np.maximum(-2 * slopes, 0.0)
        total = falls.sum(axis=1)
        variance = np.exp(2 * logs)
        shares = falls / np.maximum(total, 1e-12)[:, None]
        shares[total <= 0] = 1 / len(u)
        return cls(u=u, variance=variance, floor=variance * (1 - np.minimum(total, 1.0)), shares=shares)

    def at(self, u: Floats) -> tuple[Floats, Floats]:
        """Return the logarithms (r,) at other variables, and their derivatives (r, p)."""
        grown = self.shares * np.exp(u - self.u)
        information = grown.sum(axis=1)
        falling = (self.variance - self.floor) / information
        variance = self.floor + falling
        return 0.5 * np.log(variance), -0.5 * (falling / information / variance)[:, None] * grown


def least_time(times: Times, start: Floats, excess: Callable[[Floats], Floats]) -> Floats:
    """Return the times (p,) of the least total for which no ``excess`` (r,) is above zero, as nearly as it is found.

    ``excess`` gives the logarithms of the sigmas over their limits for times (p,). The search begins at ``start`` (p,).
    The caller checks the result: it may miss limits.
    """

    def merit(v: Floats, logs: Floats) -> float:
        return times.log_total(np.log(v)) + _OUTSIDE * max(float(logs.max()), 0.0)

    def step(model: _Model, reach: float) -> Floats:
        return _shortest(model, times, reach)

    v = _by_models(start, excess, merit, step)
    return _one_by_one(v, lambda v: merit(v, excess(v)), times)


def least_cost(times: Times, start: Floats, total_s: float, cost: Callable[[Floats], float]) -> Floats:
    """Return the times (p,) of least ``cost``, the logarithm of a sigma, whose total is ``total_s``.

    The search begins at ``start`` (p,), scaled to that total.
    """

    def costs(v: Floats) -> Floats:
        return np.array([cost(v)])

    def merit(v: Floats, logs: Floats) -> float:
        del v
        return float(logs[0])

    def step(model: _Model, reach: float) -> Floats:
        return _lowest(model, times, math.log(total_s), reach)

    v = _by_models(times.within(start, total_s), costs, merit, step)
    return times.within(_one_by_one(v, lambda v: cost(times.within(v, total_s)), times), total_s)


def _by_models(
    start: Floats,
    function: Callable[[Floats], Floats],
    merit: Callable[[Floats, Floats], float],
    step: Callable[[_Model, float], Floats],
) -> Floats:
    """Return the times (p,) of the least ``merit`` that steps from model to model find, from ``start`` (p,).

    ``function(times)`` gives the logarithms (r,) of sigmas to be modelled, ``merit(times, logarithms)`` is to be
    lowered, and ``step(model, reach)`` gives the logarithms (p,) of the next times. A step that does not gain is made
    again, shorter; the search ends after six models or when one gains little.
    """
    v = start
    logs = function(v)
    reach = _REACH
    for _ in range(_MOST_MODELS):
        u = np.log(v)
        moved = [function(np.exp(u + change)) for change in _STEP * np.eye(len(u))]
        slopes = np.column_stack([(there - logs) / _STEP for there in moved])
        model = _Model.of(u, logs, slopes)
        before = merit(v, logs)
        while reach > _SHORTEST_REACH:
            tried = np.exp(step(model, reach))
            found = function(tried)
            if merit(tried, found) < before:
                v, logs = tried, found
                break
            reach *= _SHORTER
        if merit(v, logs) > before - _SETTLED:
            break
    return np.asarray(v)


def _one_by_one(v: Floats, merit: Callable[[Floats], float], times: Times) -> Floats:
    """Return the times (p,) of least ``merit(times)`` that changes of one time alone find, from ``v`` (p,).

    No time gets below its least. Sigmas of places go up and down a little with the angles at which ramps begin, which
    no model has.
    """
    best = merit(v)
    for size in _SINGLE_STEPS:
        for change in size * np.vstack([np.eye(len(v)), -np.eye(len(v))]):
            tried = np.maximum(v * np.exp(change), times.least)
            value = merit(tried)
            if value < best:
                v, best = tried, value
    return v


def _bounds(model: _Model, times: Times, reach: float) -> list[tuple[float, float]]:
    low = np.maximum(np.log(times.least), model.u - reach)
    high = np.minimum(math.log(times.most_s), model.u + reach)
    return list(zip(low.tolist(), np.maximum(low, high).tolist(), strict=True))


def _shortest(model: _Model, times: Times, reach: float) -> Floats:
    """Return the variables of the least time with every sigma of a model within its limit, or as near as can be.

    Variables are logarithms of times (p,), within ``reach`` of those about which the model was made.
    """
    from scipy.optimize import minimize  # slow to import: only where a search is made

    # The last variable is by how much the limits are exceeded.
    found = minimize(
        lambda x: times.log_total(x[:-1]) + _OUTSIDE * x[-1],
        np.append(model.u, max(float(model.at(model.u)[0].max()), 0.0)),
        jac=lambda x: np.append(times.slope(x[:-1]), _OUTSIDE),
        method="SLSQP",
        bounds=[*_bounds(model, times, reach), (0.0, None)],
        constraints=[
            {
                "type": "ineq",
                "fun": lambda x: x[-1] - model.at(x[:-1])[0],
                "jac": lambda x: np.hstack([-model.at(x[:-1])[1], np.ones((len(model.floor), 1))]),
            }
        ],
        options={"maxiter": 200, "ftol": 1e-8},
    )
    return np.asarray(found.x[:-1])


def _lowest(model: _Model, times: Times, log_total: float, reach: float) -> Floats:
    """Return the variables of the lowest sigma of a model in a total time, given as its logarithm ``log_total``.

    Variables are logarithms of times (p,), within ``reach`` of those about which the model was made.
    """
    from scipy.optimize import minimize  # as above

    found = minimize(
        lambda u: float(model.at(u)[0][0]),
        model.u,
        jac=lambda u: model.at(u)[1][0],
        method="SLSQP",
        bounds=_bounds(model, times, reach),
        constraints=[
            {
                "type": "eq",
                "fun": lambda u: np.array([times.log_total(u) - log_total]),
                "jac": lambda u: times.slope(u)[None],
            }
        ],
        options={"maxiter": 200, "ftol": 1e-8},
    )
    return np.asarray(found.x)
