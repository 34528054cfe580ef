"""Searches a family of scripts for the least time to given sigmas, or for the least sigmas in a given time.

Which ways of turning are put together is gone through one by one; how long each turn lasts is found by sequential
quadratic programming on sums that are exact for white noise and a base at rest. What coloured noise and Earth rate
change is taken from the full prediction, as a factor on each sigma, until both agree.
"""

import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from drivers.types import AxisLimits, Flags, Floats
from station.scripts.script import Script
from station.scripts.script_family import Shape, Way, one_way, ways_of

LONGEST_S = 2 * 3600.0
"""No script longer than this is looked for."""
_MOST_WAYS = 3  # as many directions span every body rate
_CYCLES = (1, 2, 3, 4, 6, 8)
_KEPT = 3  # shapes that are computed under all of the noise
_ROUNDS = 10
_AGREED = 0.002  # share of a sigma to which steering and prediction agree
_WORTH = 0.005  # share of time or sigma that something more complicated must save
_MISSED = 1e-4  # share by which a limit may be missed in a step; the rounds that follow take it away
_NEAR = 0.05  # shapes this much worse under white noise are not considered further
_COARSE_S = 0.01
_EASE = math.sqrt(0.5)
_QUARTER, _EIGHTH = math.pi / 2, math.pi / 4


@dataclass(frozen=True, slots=True, eq=False)
class Needs:
    """n gyros and their goals: ``sd`` (n, 4), infinite where a state is not required.

    ``maps`` (n, 4, 4) lead from [1, w] to the states, ``arw`` (n,) is in rad/s/rtHz, ``prior`` (n, 4) are variances.
    """

    maps: Floats
    arw: Floats
    prior: Floats
    sd: Floats

    def covariances(self, information: Floats) -> Floats:
        """Return the covariances (n, 4, 4) from the summed [1, w][1, w]' (4, 4) over time, white noise."""
        return np.asarray(np.linalg.inv(self._of_states(information) + np.eye(4) / self.prior[:, :, None]))

    def changes(self, covariances: Floats, slopes: Floats) -> Floats:
        """Return how these change (v, n, 4, 4) with v variables, from the slopes of the sums (v, 4, 4)."""
        return np.asarray(-covariances @ self._of_states(slopes[:, None]) @ covariances)

    def _of_states(self, products: Floats) -> Floats:
        maps = self.maps / self.arw[:, None, None]
        return np.asarray(maps @ products @ maps.transpose(0, 2, 1))

    def excess(self, covariances: Floats) -> Floats:
        """Return the logarithm of each required sigma's ratio to its limit (s,), above zero where it is missed."""
        wanted = np.isfinite(self.sd)
        return np.asarray(np.log(sds_of(covariances)[wanted] / self.sd[wanted]))

    def cost(self, covariances: Floats, criterion: str) -> tuple[float, Floats]:
        """Return a logarithm of the size of required sigmas, and its derivative (n, 4, 4) by ``covariances``.

        ``covariances`` (n, 4, 4) are those of the states. Criterion "D" gives half the log of their determinants, as a
        mean over the required states; any other half the log of the sum of variances relative to the required ones.
        States without a requirement do not count.
        """
        wanted = np.isfinite(self.sd)
        slope = np.zeros_like(covariances)
        value = 0.0
        for i in np.flatnonzero(wanted.any(axis=1)):
            at = np.ix_(*[np.flatnonzero(wanted[i])] * 2)
            if criterion == "D":
                value += float(np.linalg.slogdet(covariances[i][at])[1])
                slope[i][at] = np.linalg.inv(covariances[i][at])
            else:
                slope[i] = np.diag(1 / self.sd[i] ** 2)
                value += float(np.sum(slope[i] * covariances[i]))
        count = int(wanted.sum())
        return (
            (value / 2 / count, slope / 2 / count) if criterion == "D" else (0.5 * math.log(value), slope / 2 / value)
        )


def sds_of(covariances: Floats) -> Floats:
    """Return the sigmas (n, 4)."""
    return np.asarray(np.sqrt(np.diagonal(covariances, axis1=1, axis2=2)))


@dataclass(frozen=True, slots=True, eq=False)
class FoundScript:
    """A script, its predicted sigmas (n, 4), and the number of combinations of turns that were compared.

    ``force_sd`` (m, 7) are the sigmas of states and places of accelerometers, if the search looked at any.
    """

    script: Script
    sd: Floats
    compared: int
    force_sd: Floats = field(default_factory=lambda: np.zeros((0, 7)))


@dataclass(frozen=True, slots=True, eq=False)
class _Solved:
    """A shape with its variables and its cost, a logarithm of time or sigma, so that differences are relative."""

    cost: float
    shape: Shape
    v: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Search:
    """The search space and the goals. ``predict`` gives the covariances (n, 4, 4) of a script under the complete noise.

    ``rest_s`` is kept at both ends. ``criterion`` is "D" or "A". ``coloured`` says whether repeating the turns can
    help; ``one_directional`` also allows scripts in which no axis turns back. Ramps are no steeper than ``gentle_rps2``
    where that costs nothing.
    """

    needs: Needs
    limits: Mapping[str, AxisLimits]
    gimbals: tuple[str, ...]
    rest_s: float
    predict: Callable[[Script], Floats]
    criterion: str = "D"
    gentle_rps2: float = math.inf
    coloured: bool = False
    one_directional: bool = False
    on_progress: Callable[[str], None] = lambda text: None

    def unreachable(self) -> Flags:
        """Return which sigmas (n, 4) no script of the family reaches, however long, even under white noise."""
        shape = self._shape(ways_of(self.gimbals, (0.0, _QUARTER)))
        information = shape.information(np.full(len(shape.least), LONGEST_S))
        return np.asarray(sds_of(self.needs.covariances(information)) > self.needs.sd)

    def longest(self) -> Script:
        """Return a script of about LONGEST_S that turns about everything again and again: more time brings no more."""
        ways = ways_of(self.gimbals, (0.0, _QUARTER))
        cycles = _CYCLES[-1]
        turn_s = LONGEST_S / (2 * cycles * len(ways))
        return self._shape(ways).again(cycles).script(np.array([turn_s] * len(ways) + [self.rest_s]), "longest")

    def least_time(self) -> FoundScript | None:
        """Return the shortest script that reaches every required sigma; None if none up to LONGEST_S does."""
        return self._chosen(lambda shape: _shortest(shape, self.needs), self._settled)

    def least_sigmas(self, total_s: float) -> FoundScript | None:
        """Return the script of length ``total_s`` with the least criterion under all noise.

        It may be a little shorter, as its times are rounded down. None if no turns fit into it. Whether the sigmas are
        reached does not matter.
        """

        def solve(shape: Shape) -> _Solved | None:
            return _best_within(shape, self.needs, total_s, self.criterion)

        def settle(shape: Shape) -> tuple[float, FoundScript] | None:
            solved = solve(shape)
            if solved is None:
                return None
            script = shape.script(solved.v, f"best in {total_s:g} s", up=False)
            covariances = self.predict(script)
            return self.needs.cost(covariances, self.criterion)[0], FoundScript(script, sds_of(covariances), 0)

        return self._chosen(solve, settle)

    def ways(self, total_s: float | None, most: int) -> list[tuple[Way, ...]]:
        """Return up to ``most`` combinations of turns, the best under white noise, in ``total_s``; None: least time."""
        if total_s is None:
            ranked = self._ranked(lambda shape: _shortest(shape, self.needs))
        else:
            ranked = self._ranked(lambda shape: _best_within(shape, self.needs, total_s, self.criterion))
        return [solved.shape.ways for solved in ranked[:most]]

    def _chosen(
        self, solve: Callable[[Shape], _Solved | None], settle: Callable[[Shape], tuple[float, FoundScript] | None]
    ) -> FoundScript | None:
        """Return the best script: the shapes best under white noise by ``solve``, settled under all noise.

        ``solve(shape)`` and ``settle(shape)``, which also returns the cost, give None for a shape that does not reach
        the goal. More cycles are tried while they gain. Each settled shape is told by ``on_progress``. Among nearly
        equal ones that with the fewest steps is taken, with ramps as gentle as it costs nothing; its ``compared`` is
        the number of combinations of turns. None if no shape can be settled.
        """
        ranked = self._ranked(solve)
        found: list[tuple[float, FoundScript, Shape]] = []
        for solved in ranked[:_KEPT]:
            before = math.inf
            again = self.coloured and not solved.shape.ways[0].sign  # each turn comes back, and drift could matter
            for cycles in _CYCLES if again else _CYCLES[:1]:
                shape = solved.shape.again(cycles)
                settled = settle(shape)
                if settled is None:
                    continue
                found.append((*settled, shape))
                self.on_progress(f"{_listed(shape)}: {settled[1].script.least_s:.1f} s")
                if settled[0] > before - _WORTH:
                    break  # more ramps, and no gain from them
                before = settled[0]
        if not found:
            return None
        # Where the bias alone decides, many are equally short: the one with the fewest steps is taken.
        enough = min(cost for cost, _, _ in found) + _WORTH
        _, best, shape = min((f for f in found if f[0] <= enough), key=lambda f: len(f[1].script.steps))
        return replace(self._eased(best, shape, enough, settle), compared=sum(1 for _ in self._combinations()))

    def _eased(
        self,
        best: FoundScript,
        shape: Shape,
        enough: float,
        settle: Callable[[Shape], tuple[float, FoundScript] | None],
    ) -> FoundScript:
        """Return the script with the gentlest ramps whose cost, by ``settle``, is at most ``enough``.

        The acceleration is lowered in steps, down to ``gentle_rps2`` at most. ``best`` is returned if no step succeeds.
        """
        steepest = max(limit.acceleration_rps2 for limit in self.limits.values())
        while steepest > self.gentle_rps2:
            steepest = max(steepest * _EASE, self.gentle_rps2)
            eased = settle(shape.with_ramps(steepest))
            if eased is None or eased[0] > enough:
                break
            best = eased[1]
        return best

    def _ranked(self, solve: Callable[[Shape], _Solved | None]) -> list[_Solved]:
        """Return the shapes that ``solve`` can solve and that may be the best, by cost; empty if there are none.

        Left out are those 5 % worse than the best. Those of nearly the least cost are sorted by their number of moves.
        If the best turns there and back, slanted variants of it are tried, too. How many could be solved is told by
        ``on_progress``.
        """
        solved = [s for ways in self._combinations() if (s := solve(self._shape(ways))) is not None]
        self.on_progress(f"{len(solved)} combinations of turns compared")
        if not solved:
            return []
        best = min(solved, key=lambda s: s.cost)
        if not best.shape.ways[0].sign:
            solved += self._slanted(best, solve)
        least = min(s.cost for s in solved)
        near = [s for s in solved if s.cost <= least + _NEAR]
        return sorted(near, key=lambda s: (max(s.cost, least + _WORTH), sum(way.moved for way in s.shape.ways)))

    def _slanted(self, best: _Solved, solve: Callable[[Shape], _Solved | None]) -> Iterator[_Solved]:
        """Yield the solved shapes with the ways of the best and one more, where that saves more than 0.5 %.

        In the further way, each inner axis is at 0, 45, -45 or 90 deg.
        """
        for way in ways_of(self.gimbals, (0.0, _QUARTER, _EIGHTH, -_EIGHTH)):
            if way not in best.shape.ways:
                more = solve(self._shape([*best.shape.ways, way]))
                if more is not None and more.cost < best.cost - _WORTH:
                    yield more

    def _shape(self, ways: Sequence[Way]) -> Shape:
        return Shape(ways, 1, self.rest_s, self.limits, self.gimbals)

    def _combinations(self) -> Iterator[tuple[Way, ...]]:
        ways = ways_of(self.gimbals, (0.0, _QUARTER))
        for count in range(1, min(_MOST_WAYS, len(ways)) + 1):
            for chosen in itertools.combinations(ways, count):
                yield chosen
                if self.one_directional and not any(way.moved for way in chosen):
                    yield from one_way(chosen)

    def _settled(self, shape: Shape) -> tuple[float, FoundScript] | None:
        """Return the cost and the shortest script of a shape that reaches all sigmas under the complete noise.

        The cost is the logarithm of its length in s. None if no script of the shape reaches them within ``LONGEST_S``,
        or none was found in ten rounds.
        """
        factor = np.ones_like(self.needs.sd)
        found: FoundScript | None = None
        for _ in range(_ROUNDS):
            needs = replace(self.needs, sd=self.needs.sd / factor)
            solved = _shortest(shape, needs)
            if solved is None:
                break
            best = _best_within(shape, needs, _time_s(shape, solved.v), self.criterion, keep=True) or solved
            script = shape.script(best.v, "improved")
            covariances = self.predict(script)
            worst = float(self.needs.excess(covariances).max())
            if worst <= 0 and (found is None or script.least_s < found.script.least_s):
                found = FoundScript(script, sds_of(covariances), 0)
            if -_AGREED <= worst <= 0:
                break
            white = sds_of(self.needs.covariances(shape.information(best.v)))
            factor = sds_of(covariances) / white * (1 + _AGREED / 2)
        return (math.log(found.script.least_s), found) if found else None


def _time_s(shape: Shape, v: Floats) -> float:
    return float(shape.information(v)[0, 0])


def _listed(shape: Shape) -> str:
    names = ", ".join(
        way.axis + "".join(f" with {axis} at {math.degrees(angle):g} deg" for axis, angle in way.pose if angle)
        for way in shape.ways
    )
    return names if shape.cycles == 1 else f"{names}; {shape.cycles} times"


def _shortest(shape: Shape, needs: Needs) -> _Solved | None:
    """Return the variables for the least time in which a shape reaches every sigma under white noise.

    The cost is the logarithm of that time in s. None if it cannot within ``LONGEST_S``.
    """

    def excess(v: Floats) -> Floats:
        return needs.excess(needs.covariances(shape.information(v)))

    start = _first_enough(shape, lambda v: bool(excess(v).max() <= 0))
    if start is None:
        return None
    time_slope = shape.slopes(start)[:, 0, 0]

    def cost(v: Floats) -> tuple[float, Floats]:
        total_s = _time_s(shape, v)
        return math.log(total_s), time_slope / total_s

    v = _minimum(cost, start, shape.least, [_kept(shape, needs)])
    if excess(v).max() > _MISSED or cost(v)[0] > cost(start)[0]:
        v = start
    return _Solved(cost(v)[0], shape, v)


def _best_within(shape: Shape, needs: Needs, total_s: float, criterion: str, *, keep: bool = False) -> _Solved | None:
    """Return the variables for the least criterion in ``total_s`` under white noise.

    ``keep``: with all sigmas within their requirements. None if the shape does not fit into the time or they cannot be.
    """
    slack = total_s - _time_s(shape, shape.least)
    if slack < 0:
        return None
    time_slope = shape.slopes(shape.least)[:, 0, 0]
    start = shape.least + slack / time_slope / len(time_slope)

    def cost(v: Floats) -> tuple[float, Floats]:
        covariances = needs.covariances(shape.information(v))
        value, slope = needs.cost(covariances, criterion)
        return value, np.einsum("nij,vnij->v", slope, needs.changes(covariances, shape.slopes(v)))

    in_time = _Limit("eq", lambda v: np.array([_time_s(shape, v) / total_s - 1]), lambda v: time_slope[None] / total_s)
    v = _minimum(cost, start, shape.least, [in_time, *([_kept(shape, needs)] if keep else [])])
    missed = needs.excess(needs.covariances(shape.information(v))).max() if keep else 0.0
    if missed > _MISSED or abs(_time_s(shape, v) / total_s - 1) > _MISSED:
        return None
    return _Solved(cost(v)[0], shape, v)


@dataclass(frozen=True, slots=True)
class _Limit:
    """A condition on the variables: ``value`` (c,) is zero ("eq") or not negative ("ineq"); ``slope`` (c, v)."""

    kind: str
    value: Callable[[Floats], Floats]
    slope: Callable[[Floats], Floats]


def _kept(shape: Shape, needs: Needs) -> _Limit:
    """Return the condition that no sigma exceeds its requirement."""
    return _Limit(
        "ineq",
        lambda v: -needs.excess(needs.covariances(shape.information(v))),
        lambda v: -_excess_slopes(shape, needs, v),
    )


def _excess_slopes(shape: Shape, needs: Needs, v: Floats) -> Floats:
    covariances = needs.covariances(shape.information(v))
    changes = np.diagonal(needs.changes(covariances, shape.slopes(v)), axis1=2, axis2=3)  # (v, n, 4)
    share = 0.5 * changes / np.diagonal(covariances, axis1=1, axis2=2)
    return np.asarray(share[:, np.isfinite(needs.sd)].T)


def _first_enough(shape: Shape, enough: Callable[[Floats], bool]) -> Floats | None:
    """Return the variables of one common length, the least for which ``enough`` is true, to ``_COARSE_S``.

    A variable whose least value is longer has that instead. None if ``enough`` is not true at ``LONGEST_S``.
    """
    low, high = 0.0, float(LONGEST_S / shape.slopes(shape.least)[:, 0, 0].sum())
    if not enough(np.maximum(shape.least, high)):
        return None
    while high - low > _COARSE_S:
        middle = 0.5 * (low + high)
        low, high = (low, middle) if enough(np.maximum(shape.least, middle)) else (middle, high)
    return np.asarray(np.maximum(shape.least, high))


def _minimum(
    cost: Callable[[Floats], tuple[float, Floats]], start: Floats, least: Floats, limits: Sequence[_Limit]
) -> Floats:
    """Return the variables (v,) of least ``cost``, none below ``least`` (v,), under the conditions ``limits``.

    The search begins at ``start``. ``cost`` and the conditions also give their derivatives. That the search ends
    without convergence is no error: the caller checks the conditions.
    """
    from scipy.optimize import minimize  # slow to import: only where a search is made

    def scaled(u: Floats) -> tuple[float, Floats]:
        value, slope = cost(np.exp(u))
        return value, slope * np.exp(u)

    def condition(limit: _Limit) -> dict[str, Any]:
        return {
            "type": limit.kind,
            "fun": lambda u: limit.value(np.exp(u)),
            "jac": lambda u: limit.slope(np.exp(u)) * np.exp(u),
        }

    # In logarithms of time, in which the sigmas bend least.
    found = minimize(
        scaled,
        np.log(start),
        jac=True,
        method="SLSQP",
        bounds=[(low, None) for low in np.log(least)],
        constraints=[condition(limit) for limit in limits],
        options={"maxiter": 100, "ftol": 1e-7},
    )
    return np.asarray(np.maximum(np.exp(found.x), least))
