"""What the program answers to a case, and how true that is: values that can be stored and counted."""

from __future__ import annotations

import re
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.estimation.runs.making import runs_of
from estimator.estimation.runs.run import Run
from estimator.geometry.model import decode
from estimator.recordings.recording import Recording
from estimator.tracing.augmented import Augmented
from estimator.tracing.investigate import investigate
from estimator.tracing.investigation import Added, GyroErrors, Investigation
from open_worlds.cases import STATES, Case, made, sizes_of
from open_worlds.motion import DEG
from open_worlds.oracle import oracle_of

Floats = NDArray[np.float64]

_SIGMAS = 1.96
_LIKE_ORACLE = 1.5
_RAISED = 1.02  # errors that grow by less are the same error
_BEYOND = 2.0
_WORDS = {
    "temperature": "temperature",
    "thermal": "temperature",
    "warmth": "temperature",
    "time": "time",
    "since": "time",
    "power-on": "time",
    "lagged": "time",
    "angle": "angle",
    "harmonic": "angle",
    "cos": "angle",
    "sin": "angle",
    "acceleration": "acceleration",
    "wdot": "acceleration",
    "gravity": "gravity",
    "force": "gravity",
    "sign": "direction",
    "direction": "direction",
    "play": "direction",
    "rate": "rate",
}
"""What the variables of a constructed law are about, by words of its expression."""


@dataclass(frozen=True, slots=True)
class Addition:
    """An effect that was added.

    ``right``: it says the same as the law; or it is a leading term of it, and all that was added leaves no more than
    an oracle; or it was built, and leaves no more than an oracle or is of what the law depends on. ``part``: it is a
    leading term of the law.
    """

    name: str
    probability: float
    constructed: bool
    expression: str
    right: bool
    part: bool


@dataclass(frozen=True, slots=True)
class Answer:
    """What came of a case. Errors are in rad/s: ``true_*`` on the verification run without noise, ``told_*`` stated.

    ``scales`` counts k, sigma_j, sigma_k (12) whose 95 % interval holds, ``biases`` b (4) at the zero of the effect,
    ``biases_met`` those whose interval meets what the bias really was within the runs. ``raised``: the error is larger
    after than before, by more than the noise of the recordings makes it.
    """

    case: Case
    verdict: str
    reason: str
    added: tuple[Addition, ...]
    rivals: tuple[tuple[str, ...], ...]
    depends_on: str
    true_before: float
    true_after: float
    oracle: float
    chance: float
    told_before: float
    told_after: float
    ratio: float
    low: float
    high: float
    scales: int
    biases: int
    biases_met: int
    raised: bool
    effect: float
    seconds: float

    @property
    def like_oracle(self) -> bool:
        """Whether the error after is below 1.5 times that of an oracle."""
        return self.true_after < _LIKE_ORACLE * self.oracle

    @property
    def says_what_it_depends_on(self) -> bool:
        """Whether the answer names one of the right things: as a law, an effect or a rival, or for what is left."""
        rivals = [name for names in self.rivals for name in names]
        names = [self.depends_on, *(f"{a.name} {a.expression}" for a in self.added), *rivals]
        return bool(dependences(" ".join(names)) & self.case.law.depends_on)

    @property
    def ratio_holds(self) -> bool | None:
        """Whether the stated interval holds the true ratio before : after; None if none is stated."""
        if not np.isfinite(self.ratio):
            return None
        return self.low <= self.true_before / max(self.true_after, 1e-12) <= self.high


def dependences(text: str) -> frozenset[str]:
    """Return what a law or a reason in words is about: of time, rate, direction, angle, acceleration, ..."""
    words = re.findall(r"[a-z-]+", text.lower().replace("_", " "))
    return frozenset(_WORDS[word] for word in words if word in _WORDS)


def answer_of(case: Case) -> Answer:
    """Return what the program answers to a case, judged by the truth."""
    world = made(case)
    began = time.perf_counter()
    found = investigate(list(world.fitted), [world.verification])
    seconds = time.perf_counter() - began
    oracle = oracle_of(case, world)
    before, after = true_errors(found, world.clean)
    ranges = _bias_ranges(case, world.columns)
    scales, biases, met = covered(found, ranges)
    improvement = found.improvement
    solved = after < _LIKE_ORACLE * oracle.error_rps
    unexplained = found.unexplained
    return Answer(
        case,
        str(found.finding),
        found.reason,
        tuple(_addition(case, a, solved) for a in found.added),
        found.rivals,
        "" if unexplained is None else str(unexplained.depends_on),
        before,
        after,
        oracle.error_rps,
        oracle.chance_rps,
        found.before.rms_rps,
        found.after.rms_rps,
        improvement.ratio if improvement else float("nan"),
        improvement.low if improvement else float("nan"),
        improvement.high if improvement else float("nan"),
        scales,
        biases,
        met,
        raised(before, after, oracle.chance_rps) and bool(found.added),
        world.effect_rps,
        seconds,
    )


def raised(before: float, after: float, chance: float) -> bool:
    """Return whether an error grew by more than the doubt that the noise leaves of the states."""
    return after > _RAISED * before and after**2 - before**2 > (_BEYOND * chance) ** 2


def true_errors(found: Investigation, clean: Recording) -> tuple[float, float]:
    """Return the rms (rad/s) that the states alone, and the last model, leave of a recording without noise."""
    run = runs_of(clean, 1 / 100)[0][0]  # every sample: short enough for tones
    assert found.model is not None
    columns = run.state_columns()
    left_before, left_after = [], []
    for gyro, name in enumerate(run.array.names):
        states = _of(found, name).states_before
        left_before.append(run.z_rps[:, gyro] - columns[gyro] @ _encoded(states))
        left_after.append(run.z_rps[:, gyro] - _predicted(found.model, run, gyro))
    return _rms(left_before), _rms(left_after)


def _predicted(model: Augmented, run: Run, gyro: int) -> Floats:
    return np.asarray(model.predict(run, 99, gyro)[0])  # the number of a run that was not fitted


def _rms(left: Sequence[Floats]) -> float:
    return float(np.sqrt(np.mean(np.square(left))))


def _encoded(states: Floats) -> Floats:
    """Return [k, b, s_j, s_k] of decoded states: s = (1 - k) sigma."""
    gain = 1 - states[0]
    return np.array([states[0], states[1], gain * states[2], gain * states[3]])


def _of(found: Investigation, name: str) -> GyroErrors:
    return next(gyro for gyro in found.gyros if gyro.name == name)


def _addition(case: Case, added: Added, solved: bool) -> Addition:
    constructed = bool(getattr(added, "constructed", False))
    expression = str(getattr(added, "expression", ""))
    law = case.law
    if constructed:
        about = dependences(f"{expression} {added.effect}")
        right = solved or (bool(about) and about <= law.depends_on)
    else:
        right = added.effect in law.equivalents or (solved and added.effect in law.parts)
    return Addition(added.effect, added.probability, constructed, expression, right, added.effect in law.parts)


def covered(found: Investigation, ranges: Floats) -> tuple[int, int, int]:
    """Return how many intervals hold k and the tilts, b, and how many meet the range (m, 2) of the true bias."""
    scales = biases = met = 0
    assert found.model is not None
    for gyro, name in enumerate(found.model.names):
        mean, sd = states_of(found, name)
        inside = np.abs(mean - STATES[gyro]) < _SIGMAS * sd
        scales += int(inside[[0, 2, 3]].sum())
        biases += int(inside[1])
        low, high = mean[1] - _SIGMAS * sd[1], mean[1] + _SIGMAS * sd[1]
        met += int(low <= ranges[gyro, 1] and high >= ranges[gyro, 0])
    return scales, biases, met


def states_of(found: Investigation, name: str) -> tuple[Floats, Floats]:
    """Return the states of a gyro after the investigation and their standard deviations, each (4,)."""
    gyro = _of(found, name)
    stated = getattr(gyro, "sd_after", None)
    if stated is not None:
        return gyro.states_after, np.asarray(stated)
    assert found.model is not None
    g = found.model.names.index(name)
    states, covariance = decode(found.model.mean[g, :4], found.model.covariance[g, :4, :4])
    return states, np.sqrt(np.diag(covariance))


def _bias_ranges(case: Case, columns: Sequence[Floats]) -> Floats:
    """Return the least and the largest bias (m, 2) of each gyro: what an effect adds, a bias takes off."""
    added = np.vstack([sizes_of(case) * c for c in columns])
    return np.column_stack([STATES[:, 1] - added.max(axis=0), STATES[:, 1] - added.min(axis=0)])


def in_dph(rate_rps: float) -> float:
    """Return a rate in deg/h."""
    return rate_rps / DEG * 3600
