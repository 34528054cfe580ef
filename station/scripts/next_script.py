"""The script that separates rivals: the one, within the table's limits, that is predicted to do so soonest."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, permutations
from typing import Self

import numpy as np

from drivers.types import AxisLimits, Floats
from estimator.effects.catalogue import catalogue
from estimator.effects.conditions import Conditions
from estimator.effects.drift import WARM_UP
from estimator.effects.effect import Effect
from estimator.estimation.runs.run import Run
from estimator.geometry.array import SensorArray
from estimator.geometry.kinematics import Site
from estimator.geometry.model import Prior, regressor_maps
from estimator.geometry.noise import NoiseModel
from estimator.planning.planning import weighing
from station.scripts.loop_scripts import candidates
from station.scripts.planned import planned_motion
from station.scripts.script import Script, is_possible

SETTLED = 0.95
"""Posterior probability at which one of two rivals counts as found, and the predicted chance that is good enough."""
_LOG_ODDS = math.log(SETTLED / (1 - SETTLED))
_PERIOD_S = 0.05
_PAUSE_S = 15.0  # between runs: homing, closing and opening
_TAUS_S = (20.0, 60.0, 180.0, 540.0)  # a warm-up's time constant is free: together these copy any
_RETURNS_RPS = math.radians(5 / 3600)  # to within this a bias is back in another run
_LEAST_EVIDENCE = 3.0
_NOTHING = "nothing"  # the rival of an effect that has no other
_HOPELESS = 0.2


@dataclass(frozen=True, slots=True)
class NextScript:
    """A script, the probability that it decides between rivals, and the sets of rivals it is for."""

    script: Script
    probability: float
    rivals: tuple[tuple[str, ...], ...]

    def words(self) -> str:
        """Return name, length, aim and probability in one line; a probability below 20 % is said first.

        It is never given as more than 99 %.
        """
        aims = [" and ".join(own) if len(own) > 1 else f"{own[0]} from noise" for own in self.rivals]
        aim = ", ".join(aims).replace("_", " ")
        text = f"{self.script.name}, {self.script.least_s:.0f} s: separates {aim} with probability "
        text += f"{min(self.probability, 0.99):.0%}"
        hopeful = self.probability >= _HOPELESS
        return text if hopeful else f"no script of this table is likely to help; the best is {text}"


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class Past:
    """One source of one recording: its conditions, array, noise and prior."""

    source: str
    device: str
    conditions: Conditions
    array: SensorArray
    noise: NoiseModel
    prior: Prior

    @classmethod
    def of(cls, run: Run) -> Self:
        """Return the source of a run, with its conditions about every 50 ms.

        Without a data sheet, the density of white noise is estimated from the differences of samples, over all gyros.
        """
        data, noise = run.data, run.data.noise
        if noise is None:
            steps = np.diff(data.rate_rps, axis=0)
            period_s = float(np.median(np.diff(run.data.t_ns))) * 1e-9
            noise = NoiseModel(float(np.sqrt(np.median(steps**2) / 0.455 / 2 * period_s)))
        every = max(round(_PERIOD_S / run.grid.period_s), 1)
        return cls(
            source=run.source,
            device=data.device,
            conditions=run.grid.rows(slice(None, None, every)),
            array=run.array,
            noise=noise,
            prior=run.data.prior,
        )


def next_script(
    rivals: Sequence[Sequence[str]],
    evidence: Mapping[str, float],
    past: Sequence[Past],
    limits: Mapping[str, AxisLimits],
    gimbals: Sequence[str],
    site: Site | None,
    *,
    judging: Sequence[Past] = (),
    most_s: float = math.inf,
) -> NextScript | None:
    """Return the best script to decide between effects; None without runs, without known effects, or if none fits.

    ``rivals`` are sets of effects that explain the same; unknown ones are left out of them, and an effect alone in its
    set is compared with no effect. The runs ``past`` were fitted, ``judging`` only verified; ``evidence`` is the log
    evidence of each effect in both, which gives its likely size. The script is one that a table with these ``limits``,
    ``gimbals`` and ``site`` can do, and must end within ``most_s``.

    Two rivals are decided when the log of their odds exceeds that of 0.95. Its mean is half the squared misfit, in
    sigmas, that one leaves of the other's effect, plus what the former's greater freedom costs it. The shortest script
    that decides all sets with a probability of 0.95 is taken, else the best one; a longer one must be better by 0.01.
    """
    past, judging = _same_devices(past, judging)
    names = {name for own in rivals for name in own}
    effects = _effects(names, gimbals, past)
    sets = list(dict.fromkeys(known for own in rivals if (known := tuple(n for n in own if n in effects))))
    if not sets or not past:
        return None
    contests = [(own if len(own) > 1 else (*own, _NOTHING)) for own in sets]
    effects[_NOTHING] = []
    origin_s = _origin_s([*past, *judging])
    before = _Grams.of(past, effects, origin_s)
    shown = before + _Grams.of(judging, effects, origin_s)
    sizes = {name: _size(shown, name, evidence.get(name, 0.0)) for name in effects}
    best: NextScript | None = None
    possible = [script for script in candidates(limits, gimbals) if is_possible(script, limits)]
    for script in sorted(possible, key=lambda script: script.least_s):
        if script.least_s > most_s:
            break
        after = before + _Grams.of(_foreseen_conditions(script, [*past, *judging], gimbals, site), effects, origin_s)
        probability = min(_probability_separated(own, before, after, sizes) for own in contests)
        if best is None or probability > best.probability + 0.01:
            best = NextScript(script, probability, tuple(sets))
        if probability >= SETTLED:
            break
    return best


def _same_devices(past: Sequence[Past], judging: Sequence[Past]) -> tuple[list[Past], list[Past]]:
    """Return both with the device of a source that states none, by the others that have a gyro of the same name."""
    stated = {name: p.device for p in (*past, *judging) if p.device for name in p.array.names}

    def named(runs: Sequence[Past]) -> list[Past]:
        return [p if p.device else replace(p, device=stated.get(p.array.names[0], "")) for p in runs]

    return named(past), named(judging)


def _effects(names: set[str], gimbals: Sequence[str], past: Sequence[Past]) -> dict[str, list[Effect]]:
    """Return by name the effects that are known and that all these recordings have the data for.

    Other names are left out. A harmonic's name stands for all its orders; the warm-up for several time constants.
    """
    offers = frozenset[str].intersection(*(p.conditions.offers for p in past)) if past else frozenset[str]()
    span_s = max((float(p.conditions.t_s[-1] - p.conditions.t_s[0]) for p in past), default=1.0)
    found: dict[str, list[Effect]] = {}
    for effect in catalogue(gimbals, span_s):
        for name in {effect.name, effect.record.name} & names:  # harmonics of every order
            if effect.needs <= offers:
                found.setdefault(name, []).append(effect)
    if WARM_UP.name in found:
        found[WARM_UP.name] = [WARM_UP.effect(time_constant_s=tau_s) for tau_s in _TAUS_S]
    return found


@dataclass(frozen=True, slots=True, eq=False)
class _Grams:
    """Information (k, k) on [four states | parameters] of every gyro, each scaled by its plausible size.

    Keys of ``matrices`` are device and name of the gyro. ``own`` gives the columns of each effect, ``shared`` the
    effects that all gyros have in common.
    """

    matrices: Mapping[tuple[str, str], Floats]
    own: Mapping[str, slice]
    shared: frozenset[str]

    @classmethod
    def of(cls, runs: Sequence[Past], effects: Mapping[str, Sequence[Effect]], origin_s: float | None) -> Self:
        """Return the information that ``runs`` give on the states and on each effect; runs of a gyro are added up.

        ``origin_s`` is the instant at which laws of time begin; None: each run's own beginning. A bias may differ a
        little from run to run.
        """
        matrices: dict[tuple[str, str], Floats] = {}
        counts = [sum(len(e.parameters) for e in group) for group in effects.values()]
        edges = np.cumsum([4, *counts]).tolist()
        own = {name: slice(a, b) for name, (a, b) in zip(effects, pairwise(edges), strict=True)}
        for run in runs:
            c = run.conditions
            seen, keep = _conditions_since(c, c.t_s[0] if origin_s is None else origin_s)
            states = np.column_stack([np.ones(len(c.t_s)), c.w_rps])
            for gyro, gyro_map in enumerate(regressor_maps(run.array)):
                columns = [states @ (gyro_map.T * np.sqrt(run.prior.variances()))]
                for group in effects.values():
                    for effect in group:
                        largest = np.array([parameter.largest for parameter in effect.parameters])
                        columns.append(effect.columns(seen, run.array, gyro)[keep] * largest)
                gram = weighing(c.t_s, c.period_s, run.noise)(np.hstack(columns))
                key = run.device, run.array.names[gyro]
                matrices[key] = matrices.get(key, 0.0) + _with_own_bias(gram, _RETURNS_RPS / run.prior.b_rps)
        shared = frozenset(name for name, group in effects.items() if group and group[0].shared)
        return cls(matrices, own, shared)

    def __add__(self, other: Self) -> Self:
        """Return the information of both together, for the gyros of either."""
        keys = dict.fromkeys([*self.matrices, *other.matrices])
        matrices = {key: np.asarray(self.matrices.get(key, 0.0) + other.matrices.get(key, 0.0)) for key in keys}
        return replace(self, matrices=matrices)

    def beside_states(self, names: Sequence[str]) -> tuple[Floats, list[Floats]]:
        """Return the information (p, p) on the parameters of these effects, and which rows belong to each effect.

        The states are eliminated. The parameters of an effect that is not shared come once for every gyro. Rows are in
        the order of ``names``.
        """
        gyros = len(self.matrices)
        spread = [1 if name in self.shared else gyros for name in names]
        widths = [self.own[name].stop - self.own[name].start for name in names]
        edges = np.cumsum([0, *(s * w for s, w in zip(spread, widths, strict=True))])
        total = np.zeros((edges[-1], edges[-1]))
        for number, matrix in enumerate(self.matrices.values()):
            wanted = np.concatenate([np.arange(self.own[name].start, self.own[name].stop) for name in names])
            cross = matrix[:4][:, wanted]
            left = matrix[np.ix_(wanted, wanted)] - cross.T @ np.linalg.solve(matrix[:4, :4] + np.eye(4), cross)
            at = np.concatenate(
                [
                    edge + (0 if s == 1 else number * w) + np.arange(w)
                    for edge, s, w in zip(edges[:-1], spread, widths, strict=True)
                ]
            )
            total[np.ix_(at, at)] += left
        return total, [np.arange(a, b) for a, b in pairwise(edges.tolist())]


def _size(shown: _Grams, name: str, evidence: float) -> float:
    """Return how large an effect is by its log evidence, as a share of the squares of its largest plausible size."""
    total, _ = shown.beside_states([name])
    return float(min(2 * max(evidence, _LEAST_EVIDENCE) / max(np.trace(total), 1e-12), 1.0))


def _probability_separated(names: Sequence[str], before: _Grams, after: _Grams, sizes: Mapping[str, float]) -> float:
    """Return the probability that the true effect among ``names`` is separated from all others, each equally likely.

    ``before`` is the information so far, ``after`` that with a further run; ``sizes`` are the squares of likely sizes
    over the largest plausible ones. "Nothing" is not one of the true ones: an effect that a script fails to show is
    settled, too.
    """
    chances = dict.fromkeys((name for name in names if name != _NOTHING), 1.0)
    for true, other in permutations(names, 2):
        if true == _NOTHING:
            continue
        (seen, spared), (new_seen, new_spared) = (
            _misfit_and_freedom(before, true, other),
            _misfit_and_freedom(after, true, other),
        )
        chances[true] = min(chances[true], _decision_probability(sizes[true] * (new_seen - seen), new_spared - spared))
    return float(np.mean(list(chances.values())))


def _misfit_and_freedom(grams: _Grams, true: str, other: str) -> tuple[float, float]:
    """Return the squared misfit that ``other`` leaves of ``true`` at its largest plausible size, and a log of freedom.

    The misfit is in units of the noise. The latter is how much more freedom ``other`` has: a model that could explain
    more is less probable.
    """
    total, (a, b) = grams.beside_states((true, other))
    own, others, cross = total[np.ix_(a, a)], total[np.ix_(b, b)] + np.eye(len(b)), total[np.ix_(b, a)]
    copied = cross.T @ np.linalg.solve(others, cross)
    freedom = np.linalg.slogdet(others)[1] - np.linalg.slogdet(own + np.eye(len(a)))[1]
    return float(np.trace(own - copied)), 0.5 * float(freedom)


def _decision_probability(gained: float, spared: float) -> float:
    """Return the probability that the log odds exceed the limit: normal, mean ``gained`` / 2 + ``spared``, variance
    ``gained``.
    """
    mean = 0.5 * gained + spared - _LOG_ODDS
    return 0.5 * math.erfc(-mean / math.sqrt(2 * max(gained, 1e-9)))


def _origin_s(past: Sequence[Past]) -> float | None:
    """Return the beginning of the first recording (s).

    None if recordings of a source overlap, so that they have no common clock.
    """
    spans: dict[str, list[tuple[float, float]]] = {}
    for p in past:
        spans.setdefault(p.source, []).append((float(p.conditions.t_s[0]), float(p.conditions.t_s[-1])))
    for own in spans.values():
        own.sort()
        if any(later[0] < earlier[1] for earlier, later in pairwise(own)):
            return None
    return min(span[0] for own in spans.values() for span in own)


def _foreseen_conditions(script: Script, past: Sequence[Past], gimbals: Sequence[str], site: Site | None) -> list[Past]:
    """Return the predicted conditions of each source during ``script``, beginning 15 s after its last recording.

    The temperature goes on as it was; the noise and prior are those of that recording. The table begins at home.
    """
    planned = planned_motion(script, gimbals, _PERIOD_S)
    runs = []
    for source in dict.fromkeys(p.source for p in past):
        own = [p for p in past if p.source == source]  # a source that was cut in two has parts of other names
        last = max(own, key=lambda p: float(p.conditions.t_s[-1]))
        motion = replace(planned, t_s=planned.t_s + (float(last.conditions.t_s[-1]) + _PAUSE_S))
        conditions = motion.conditions(_temperature(last.conditions, motion.t_s), site)
        runs.append(replace(last, conditions=conditions))
    return runs


def _temperature(last: Conditions, t_s: Floats) -> Floats | None:
    """Return the predicted temperature (n,) in deg C at ``t_s`` (n,): the exponential that fits best, continued.

    ``last`` are the conditions of the last recording, with the same clock. The time constant is between one minute and
    one hour. None if no temperature was recorded.
    """
    if last.temperature_c is None:
        return None
    since, target = last.t_s - last.t_s[-1], last.temperature_c
    fits = []
    for tau_s in np.geomspace(60.0, 3600.0, 13):
        design = np.column_stack([np.ones(len(since)), np.exp(-since / tau_s)])
        solution, *_ = np.linalg.lstsq(design, target, rcond=None)
        fits.append((float(np.sum((target - design @ solution) ** 2)), tau_s, solution))
    _, tau_s, (end, swing) = min(fits, key=lambda fit: fit[0])
    return np.asarray(end + swing * np.exp(-(t_s - last.t_s[-1]) / tau_s))


def _with_own_bias(gram: Floats, share: float) -> Floats:
    """Return the information of a run whose bias differs from that of other runs by a share of its prior."""
    bias = gram[:, 1]
    return np.asarray(gram - np.outer(bias, bias) * (share**2 / (1 + share**2 * bias[1])))


def _conditions_since(conditions: Conditions, origin_s: float) -> tuple[Conditions, slice]:
    """Return conditions that begin at ``origin_s``, for laws of time, and the slice of the given rows among theirs.

    Two rows at the origin are put before the given ones. If it is not earlier than these, they are returned unchanged.
    """
    if origin_s >= float(conditions.t_s[0]) - conditions.period_s:
        return conditions, slice(None)
    rows = np.concatenate([[0, 0], np.arange(len(conditions.t_s))])
    begun = conditions.rows(rows)
    t_s = begun.t_s.copy()
    t_s[:2] = origin_s, origin_s + conditions.period_s
    return replace(begun, t_s=t_s), slice(2, None)
