"""Searches scripts for a whole IMU: the least time to given sigmas, or the least sigmas in a given time.

Gyros and accelerometers count together. Sigmas are those of the full prediction, under coloured noise and with the
errors of the table. How long turns and rests last is found by sequential quadratic programming; which turns and
attitudes there are is tried one after the other, each change kept if it gains.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from drivers.types import AxisLimits, Floats
from station.scripts.prediction import Prediction
from station.scripts.script import Script
from station.scripts.script_family import Way
from station.scripts.script_search import LONGEST_S, FoundScript
from station.scripts.whole_imu.attitudes import attitudes_of, chosen, in_order
from station.scripts.whole_imu.durations import Times, least_cost, least_time
from station.scripts.whole_imu.family import Structure, driven_limits

_CYCLES = (1, 2, 4, 8)
_MORE_POSES = (4, 8)
_RICHER = ((1, 0), (2, 4), (4, 8))  # cycles and further poses, until the sigmas are reached
_WORTH = 0.005  # share of time or sigma that something more complicated must save
_MISSED = 1e-3  # share by which a script is lengthened beyond what a missed limit takes
_ROUNDS = 2
_NEAR = 0.01  # logarithm of a sigma above its limit that lengthening takes away
_MOST_LONGER = 8
_LONGER = 1.5  # by how much more a script is lengthened if it did not help
_TOO_MUCH = 0.3  # logarithm of a sigma above its limit that no lengthening is tried for


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class JointNeeds:
    """Required sigmas of gyros (n, 4) and of states and places of accelerometers (m, 7); infinite where none is."""

    gyro_sd: Floats
    force_sd: Floats

    def excess(self, prediction: Prediction) -> Floats:
        """Return the logarithm of each required sigma's ratio to its limit (s,), above zero where it is missed."""
        reached = np.concatenate([prediction.gyro_sd.ravel(), prediction.accelerometer_sd.ravel()])
        required = np.concatenate([self.gyro_sd.ravel(), self.force_sd.ravel()])
        wanted = np.isfinite(required)
        return np.asarray(np.log(reached[wanted] / required[wanted]))

    def cost(self, prediction: Prediction, criterion: str) -> float:
        """Return the logarithm of the typical sigma of what is required, relative to the requirement.

        Criterion "D" uses the determinants of the covariances, any other the mean of the variances. States without a
        requirement do not count.
        """
        parts = [
            _relative(covariance, sd)
            for covariances, required in (
                (prediction.gyros, self.gyro_sd),
                (prediction.accelerometers, self.force_sd),
            )
            for covariance, sd in zip(covariances, required, strict=True)
        ]
        count = sum(len(part) for part in parts)
        if criterion == "D":
            return float(sum(np.linalg.slogdet(part)[1] for part in parts if len(part))) / 2 / count
        return 0.5 * math.log(sum(float(np.trace(part)) for part in parts) / count)


def _relative(covariance: Floats, required: Floats) -> Floats:
    """Return the covariance (r, r) of what is required of a sensor, in units of the required sigmas."""
    at = np.flatnonzero(np.isfinite(required))
    return np.asarray(covariance[np.ix_(at, at)] / np.outer(required[at], required[at]))


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class _Solved:
    """A structure with its variables and its cost, a logarithm of time or sigma, so that differences are relative."""

    cost: float
    structure: Structure
    v: Floats
    found: FoundScript


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class WholeImuSearch:
    """The search space and the goals. ``predict`` is the prediction for a script, coarse or not.

    ``ways`` are the sets of turns to try. No rest, at the ends or in one of the at least ``poses`` attitudes, is
    shorter than ``rest_s``. ``total_s`` is the time given, None for the least. Ramps are no steeper than
    ``gentle_rps2`` where that costs nothing.
    """

    needs: JointNeeds
    ways: Sequence[tuple[Way, ...]]
    limits: Mapping[str, AxisLimits]
    gimbals: tuple[str, ...]
    rest_s: float
    poses: int
    predict: Callable[[Script, bool], Prediction]
    total_s: float | None = None
    criterion: str = "D"
    gentle_rps2: float = math.inf
    on_progress: Callable[[str], None] = lambda text: None

    def longest(self) -> Script:
        """Return a script of about LONGEST_S with all turns and poses: more time brings no more."""
        structure = self._structure(self.ways[0], self.poses + _MORE_POSES[-1], _CYCLES[-1])
        share = (LONGEST_S - structure.time_s(structure.least)) / float(structure.counts @ structure.least)
        return structure.script(structure.least * (1 + max(share, 0.0)), "longest")

    def best(self) -> FoundScript | None:
        """Return the best script; None if none up to LONGEST_S reaches every sigma, or none fits into ``total_s``.

        It has more turns and poses where it takes them to reach the sigmas at all, and as long as that gains; its ramps
        are eased at last. ``compared`` is the number of structures tried before that.
        """
        best: _Solved | None = None
        compared = 0
        for cycles, more in _RICHER:
            tried = [self._solved(self._structure(ways, self.poses + more, cycles)) for ways in self.ways]
            compared += len(tried)
            best = min((one for one in tried if one is not None), key=lambda one: one.cost, default=None)
            if best is not None:
                break
        if best is None:
            return None
        for changes in (_with_more_poses, _with_more_cycles):
            for structure in changes(self, best.structure):
                compared += 1
                better = self._solved(structure, best)
                if better is None or better.cost > best.cost - _WORTH:
                    break
                best = better
        return replace(self._eased(best).found, compared=compared)

    def with_poses(self, structure: Structure, count: int) -> Structure:
        """Return a structure with ``count`` attitudes, or as many as the table has."""
        attitudes = chosen(attitudes_of(self.gimbals, self.limits), count)
        return replace(structure, attitudes=tuple(in_order(attitudes, self.limits)))

    def _structure(self, ways: tuple[Way, ...], poses: int, cycles: int) -> Structure:
        """Return the structure of a script that turns in ``ways``, ``cycles`` times each.

        It has ``poses`` static poses, or as many as the table can take.
        """
        bare = Structure(
            ways=ways,
            attitudes=(),
            cycles=cycles,
            rest_s=self.rest_s,
            limits=driven_limits(self.limits),
            gimbals=self.gimbals,
        )
        return self.with_poses(bare, poses)

    def _solved(self, structure: Structure, before: _Solved | None = None) -> _Solved | None:
        """Return the best variables of a structure, with its script; None if it does not reach the goal.

        The search starts from the variables of ``before`` where it has as many, each scaled to the same time in all.
        The result is reported by ``on_progress``.
        """
        problem = _Problem(self, structure)
        start = structure.usual
        if before is not None and len(before.v) == len(start):
            start = np.maximum(before.v * before.structure.counts / structure.counts, structure.least)
        solved = problem.shortest(start) if self.total_s is None else problem.best_within(start, self.total_s)
        result = "does not reach them" if solved is None else f"{solved.found.script.least_s:.1f} s"
        if solved is not None and self.total_s is not None:
            result = f"sigmas {math.exp(solved.cost):.3g} times those required"
        self.on_progress(f"{structure.described()}: {result}")
        return solved

    def _eased(self, best: _Solved) -> _Solved:
        """Return the same with gentler ramps if that costs nothing: of ``gentle_rps2``, else halfway to it.

        ``best`` itself if neither does, or if its ramps are not steeper.
        """
        steepest = max(limit.acceleration_rps2 for limit in best.structure.limits.values())
        if self.gentle_rps2 >= steepest:
            return best
        for acceleration_rps2 in (self.gentle_rps2, math.sqrt(self.gentle_rps2 * steepest)):
            self.on_progress(f"with ramps of {math.degrees(acceleration_rps2):.3g} deg/s2:")
            eased = self._solved(best.structure.with_ramps(acceleration_rps2), best)
            if eased is not None and eased.cost <= best.cost + _WORTH:
                return eased
        return best


def _with_more_poses(search: WholeImuSearch, structure: Structure) -> Iterator[Structure]:
    """Yield the structure with more and more attitudes, as far as the table has more."""
    for more in _MORE_POSES:
        changed = search.with_poses(structure, search.poses + more)
        if len(changed.attitudes) > len(structure.attitudes):
            yield changed


def _with_more_cycles(search: WholeImuSearch, structure: Structure) -> Iterator[Structure]:
    """Yield the structure with its turns repeated, the attitudes between them."""
    del search
    for cycles in _CYCLES:
        if cycles > structure.cycles:
            yield replace(structure, cycles=cycles)


class _Problem:
    """The search for the variables of one structure."""

    def __init__(self, search: WholeImuSearch, structure: Structure) -> None:
        """Compute how the times of ``structure`` make up that of a script; nothing is searched."""
        self._search = search
        self._structure = structure
        self._times = Times(
            fixed_s=structure.time_s(np.zeros(len(structure.least))),
            counts=structure.counts,
            least=structure.least,
            most_s=LONGEST_S,
        )

    def shortest(self, start: Floats) -> _Solved | None:
        """Return the variables of the least time in which every sigma is reached, with their script; None if there are
        none.

        By how much the full prediction exceeds the coarse one is taken from the last result, until both agree. None as
        well if a sigma is then far beyond its limit.
        """
        needs = self._search.needs
        beyond = np.zeros(len(needs.excess(self._predicted(start))))
        v = start
        for _ in range(_ROUNDS):
            v = self._least_time(v, beyond)
            full = needs.excess(self._full(v)[1])
            if full.max() > _TOO_MUCH:
                return None
            if full.max() <= _NEAR:
                break
            beyond = full - needs.excess(self._predicted(v))
        return self._lengthened(v)

    def _least_time(self, start: Floats, beyond: Floats) -> Floats:
        """Return the variables of the least time, with ``beyond`` (s,) added to the logarithms of coarse sigmas."""
        return least_time(self._times, start, lambda v: self._search.needs.excess(self._predicted(v)) + beyond)

    def _lengthened(self, v: Floats) -> _Solved | None:
        """Return the script with these times, or with longer ones with which every sigma is reached.

        None if a few tries bring none up to ``LONGEST_S``, or if a sigma is too far beyond its limit.
        """
        longer = 0.0
        for _ in range(_MOST_LONGER):
            script, prediction = self._full(v)
            worst = float(self._search.needs.excess(prediction).max())
            if worst > _TOO_MUCH or script.least_s > LONGEST_S:
                return None
            if worst <= 0:
                cost = math.log(script.least_s)
                return _Solved(cost=cost, structure=self._structure, v=v, found=_found(script, prediction))
            longer = max(2 * worst + _MISSED, _LONGER * longer)
            v = v * math.exp(longer)
        return None

    def best_within(self, start: Floats, total_s: float) -> _Solved | None:
        """Return the variables of the least criterion in ``total_s``, searched from ``start`` (p,).

        None if the least times do not fit in. Whether the sigmas are reached does not matter.
        """
        structure = self._structure
        needs, criterion = self._search.needs, self._search.criterion
        if structure.time_s(structure.least) > total_s:
            return None
        v = least_cost(self._times, start, total_s, lambda v: needs.cost(self._predicted(v), criterion))
        script = structure.script(v, f"best in {total_s:g} s", up=False)
        prediction = self._search.predict(script, False)
        return _Solved(
            cost=needs.cost(prediction, criterion), structure=structure, v=v, found=_found(script, prediction)
        )

    def _full(self, v: Floats) -> tuple[Script, Prediction]:
        """Return the script with these variables, and its full prediction."""
        script = self._structure.script(v, "improved")
        return script, self._search.predict(script, False)

    def _predicted(self, v: Floats) -> Prediction:
        """Return the prediction for variables, in coarse steps."""
        return self._search.predict(self._structure.script(v, "tried"), True)


def _found(script: Script, prediction: Prediction) -> FoundScript:
    return FoundScript(script, prediction.gyro_sd, 0, prediction.accelerometer_sd)
